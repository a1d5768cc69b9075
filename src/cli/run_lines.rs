//! What `loomtree run` says before a run and after it.

use std::path::PathBuf;

use serde_json::json;

use super::far::far_line;
use super::start_state::untangled_line;
use super::{CliError, print};
use crate::coordinator::{RunError, RunOptions, RunPlaces, RunPlan, RunSummary};
use crate::model::stiffness_ratio;
use crate::os::console::{is_json, note};
use crate::os::signals;
use crate::output::{FrameFormat, Report};
use crate::scene::Substeps;
use crate::step::parts_of_step;

/// What a user should know of a run before it starts.
pub(super) fn introduce(plan: &RunPlan, options: &RunOptions) {
    if let Some(line) = &plan.started {
        note(line);
    }
    if let Some(done) = &plan.untangled {
        note(untangled_line(done));
    }
    if let Some(line) = far_line(&plan.scene) {
        note(format_args!("far: {line}"));
    }
    for line in &plan.scene.warnings {
        note(format_args!("warning: {line}"));
    }
    let (ratio, parts) = (stiffness_ratio(&plan.scene), parts_of_step(stiffness_ratio(&plan.scene)));
    if parts > 1 && plan.scene.settings.substeps == Substeps::Auto {
        note(format_args!(
            "every step is made in {parts} parts: the cloth is too stiff or its cells are too small for single \
             precision (k dt^2 / (rho h^2) = {ratio:.1e})"
        ));
    }
    for line in &plan.scene.left_out {
        note(format_args!("left out: {line}"));
    }
    if !plan.scene.parts.is_empty() && options.formats.0 == [FrameFormat::Ply] {
        note("PLY frames do not hold the objects and groups of the meshes; `--format obj` keeps them");
    }
    let (triangles, vertices) = (plan.scene.mesh.triangles.len(), plan.scene.mesh.positions.len());
    note(format_args!(
        "{}: {triangles} triangles, {vertices} vertices, {} workers, schedule {}",
        plan.scene.name,
        options.workers,
        plan.transfers.kind.name()
    ));
}

/// What a run has made.
pub(super) struct Made {
    summary: RunSummary,
    /// Whether a signal has stopped it.
    pub(super) is_by_signal: bool,
    out: PathBuf,
}

impl Made {
    /// The result of the command: on stdout with `--json`, else nothing, because it was said on stderr.
    pub(super) fn answer(self) -> Result<(), CliError> {
        let Made { summary, is_by_signal, out } = self;
        if is_json() {
            let report = Report::load(&out.join("report.json")).unwrap_or_default();
            let last = report.frames.iter().max_by_key(|frame| frame.frame);
            let document = json!({
                "run": out,
                "scene": report.header.scene,
                "status": if summary.stopped { "stopped" } else { "done" },
                "workers": report.header.workers,
                "triangles": report.header.triangles,
                "vertices": report.header.vertices,
                "frames": summary.frames,
                "steps": summary.steps,
                "substeps": summary.substeps,
                "seconds_per_step": summary.seconds_per_step,
                "last_frame": last.map(|frame| frame.frame),
                "state_hash": last.map(|frame| &frame.state_hash),
                "stages": report.header.stages,
                "open_seams": report.header.open_seams,
            });
            print(&format!("{document}\n"))?;
        }
        if is_by_signal { Err(stopped()) } else { Ok(()) }
    }
}

/// Says how a run has ended, or makes an error of it.
pub(super) fn conclude(result: Result<RunSummary, RunError>, places: &RunPlaces) -> Result<Made, CliError> {
    let summary = result.map_err(|error| match error {
        RunError::BadInput(text) => CliError::bad_input(text),
        RunError::Failed(text) => CliError::failed(text),
        RunError::Stopped(text) => {
            note(text);
            stopped()
        }
    })?;
    if summary.substeps > u64::from(summary.steps) {
        note(format_args!("{} steps were made in {} sub-steps (simulation.substeps)", summary.steps, summary.substeps));
    }
    // A client that steers a run may end it, too, which is what it is for.
    let is_by_signal = summary.stopped && signals::stop_requested().is_some();
    let how = if summary.stopped { "stopped; continue with --resume" } else { "done" };
    let mut line = format!("{how}: {} steps, {:.2} ms/step", summary.steps, summary.seconds_per_step * 1e3);
    // A part of a shot that is split in time has no frames.
    if summary.frames > 0 {
        line += &format!(", frames 0..={} in {}", summary.frames - 1, places.out.join("frames").display());
    }
    note(line);
    Ok(Made { summary, is_by_signal, out: places.out.clone() })
}

/// The result of a run that a signal has stopped. Its message is empty, because it has already been printed.
pub(super) fn stopped() -> CliError {
    let exit_code = signals::stop_requested().map_or(1, |signal| signal.exit_code());
    CliError { exit_code, message: String::new() }
}
