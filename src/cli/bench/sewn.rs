//! Scenes with seams for the benchmarks that measure whole steps: their seams are closed first, in a run of its own, so
//! that what is measured is the garment and not its panels.

use std::path::Path;

use super::common::Common;
use crate::cli::CliError;
use crate::coordinator::{Launch, RunOptions, RunPlaces, RunPlan};
use crate::model::Sewn;
use crate::os::console::note;
use crate::output::{Existing, checkpoint};
use crate::scene::{Obstacles, Scene};

/// Time given to the seams over the time in which their threads shorten. Threads are at their firmest after 1.25 of it.
const TIME: f64 = 1.5;

/// The scene of the file `path` as it is once its seams are closed, with about `resolution` triangles; none if it has
/// no seams. It starts at that moment, with its obstacles where they are at the start.
///
/// # Errors
/// The scene cannot start, its seams do not close, or its obstacles have moved by then.
pub(super) fn sewn(path: &Path, resolution: u64, common: &Common, launch: &Launch) -> Result<Option<Scene>, CliError> {
    let options = |resolution: u64| RunOptions {
        executor: common.executor,
        threads: Some(common.threads as usize),
        resolution: Some(resolution),
        heartbeat_s: 600.0,
        ..RunOptions::default()
    };
    let plan = RunPlan::new(path, &options(resolution)).map_err(CliError::bad_input)?;
    let Some(refine) = plan.scene.sewing.as_ref().map(|sewing| sewing.refine) else { return Ok(None) };
    note(format_args!("{}: its seams are closed first", path.display()));
    // Panels have as many triangles as become those that are wanted once they are divided.
    let options = options((resolution >> (2 * refine)).max(1));
    let mut plan = RunPlan::new(path, &options).map_err(CliError::bad_input)?;
    let frame_s = plan.scene.settings.step_s * f64::from(plan.scene.settings.steps_per_frame);
    let sewing = plan.scene.sewing.as_mut().expect("the scene has seams at any resolution");
    sewing.refine = 0;
    let frames = (TIME * sewing.closing.close_s / frame_s).ceil() as u32;
    plan.scene.settings.frames = frames;
    let panels = plan.scene.clone();
    let folder =
        tempfile::tempdir().map_err(|error| CliError::failed(format!("cannot make a temporary folder: {error}")))?;
    let places = RunPlaces { scene: path.into(), out: folder.path().join("run"), existing: Existing::Refuse };
    crate::coordinator::run(plan, &options, &places, launch).map_err(|error| CliError::failed(error.to_string()))?;
    let of = |what: &str| CliError::failed(format!("{}: {what}", path.display()));
    let (_, reached) =
        checkpoint::latest(&places.out.join("checkpoint")).found.ok_or_else(|| of("its run has left no state"))?;
    let (closed, _) = Sewn::of(&panels).ok_or_else(|| of("its seams do not make cloth"))?;
    if reached.state.positions.len() != closed.mesh.positions.len() {
        return Err(of(&format!("its seams are still open after {frames} frames")));
    }
    let obstacles = Obstacles::new(&closed.obstacles);
    let at = |time_s: f64| {
        let mut positions = Vec::new();
        obstacles.positions_at(time_s, &mut positions);
        positions
    };
    if at(0.0) != at(reached.time_s) {
        return Err(of("its obstacles move while the seams are closed; the benchmark needs them to wait"));
    }
    let (mut scene, way) = Sewn::divided(&closed, refine).ok_or_else(|| of("its cloth cannot be divided"))?;
    let state = way.state(&reached.state, &reached.state.positions);
    (scene.mesh.positions, scene.velocities) = (state.positions, state.velocities);
    Ok(Some(scene))
}
