//! `loomtree run`: runs the coordinator in this process and starts workers as child processes.

use std::path::PathBuf;

use super::CliError;
use super::far::far_line;
use super::start_state::{Places, untangled_line};
use crate::coordinator::{GivenOptions, Launch, PlanError, RunError, RunOptions, RunPlaces, RunPlan};
use crate::model::stiffness_ratio;
use crate::os::console::note;
use crate::os::signals;
use crate::output::{Existing, FrameFormat, RunDirectory, RunManifest};
use crate::scene::Substeps;
use crate::step::parts_of_step;
use crate::transport::RANKS_MAX;

/// Arguments of `loomtree run`.
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    /// Scene file (.toml, or ARCSim's .json); with --resume it may be left out
    #[arg(required_unless_present = "resume")]
    pub scene: Option<PathBuf>,
    /// Run directory [default: out/<scene>]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Go on from the newest checkpoint in the run directory, on any number of workers
    #[arg(long, conflicts_with = "overwrite")]
    pub resume: bool,
    /// Replace a run that is in the run directory
    #[arg(long)]
    pub overwrite: bool,
    /// Everything that run.toml keeps.
    #[command(flatten)]
    pub options: GivenOptions,
}

/// Runs the command.
///
/// # Errors
/// Bad input, a failed run, or a run that a signal has stopped (exit code 128 + its number).
pub fn run(args: RunArgs, launch: Launch) -> Result<(), CliError> {
    let Resolved { places, options, recorded_scene } = resolve(&args)?;
    // Checked before the plan is made, which can take a while. Too many workers are refused there.
    launch.machine().prepare(options.workers.min(RANKS_MAX))?;
    let plan = match &recorded_scene {
        Some(text) => RunPlan::of_text(text, &places.scene, &options),
        None => RunPlan::new(&places.scene, &options),
    };
    let plan = plan.map_err(|error| match error {
        PlanError::Scene(mut error) => CliError::bad_input(Places::beside(&places.out).refuse(&mut error)),
        other => CliError::bad_input(other),
    })?;
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
    // Until here a signal ends the process in the default way.
    signals::listen().map_err(|error| CliError::failed(format!("cannot listen for signals: {error}")))?;
    let summary = crate::coordinator::run(plan, &options, &places, &launch).map_err(|error| match error {
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
    let how = if summary.stopped { "stopped; continue with --resume" } else { "done" };
    note(format_args!(
        "{how}: {} steps, {:.2} ms/step, frames 0..={} in {}",
        summary.steps,
        summary.seconds_per_step * 1e3,
        summary.frames - 1,
        places.out.join("frames").display()
    ));
    if summary.stopped { Err(stopped()) } else { Ok(()) }
}

/// The result of a run that a signal has stopped. Its message is empty, because it has already been printed.
fn stopped() -> CliError {
    let exit_code = signals::stop_requested().map_or(1, |signal| signal.exit_code());
    CliError { exit_code, message: String::new() }
}

/// Resolved arguments of the command.
struct Resolved {
    places: RunPlaces,
    options: RunOptions,
    /// The scene's text from the run directory, if the run continues with it.
    recorded_scene: Option<String>,
}

/// Resolves the scene, run directory and options. A resumed run takes missing options from `run.toml` and uses the
/// recorded scene, because the original file can have moved, changed or disappeared.
fn resolve(args: &RunArgs) -> Result<Resolved, CliError> {
    let existing = match (args.resume, args.overwrite) {
        (true, _) => Existing::Resume,
        (_, true) => Existing::Overwrite,
        _ => Existing::Refuse,
    };
    if !args.resume {
        let scene =
            args.scene.clone().ok_or_else(|| CliError::bad_input("a scene file is needed: loomtree run SCENE"))?;
        let stem = scene.file_stem().unwrap_or_default();
        let out = args.out.clone().unwrap_or_else(|| PathBuf::from("out").join(stem));
        if scene.to_str().is_none() {
            let sentence = "its name is not UTF-8, which run.toml needs: rename the file, or give a link to it";
            return Err(CliError::bad_input(format!("{}: {sentence}", scene.display())));
        }
        let (places, options) = (RunPlaces { scene, out, existing }, args.options.options.clone());
        return Ok(Resolved { places, options, recorded_scene: None });
    }
    let out = match (&args.out, &args.scene) {
        (Some(out), _) => out.clone(),
        (None, Some(scene)) => PathBuf::from("out").join(scene.file_stem().unwrap_or_default()),
        (None, None) => return Err(CliError::bad_input("--resume needs the run directory: --out DIR")),
    };
    let directory = RunDirectory::open(&out).map_err(CliError::bad_input)?;
    let manifest = RunManifest::load(&directory).map_err(CliError::bad_input)?;
    for sentence in manifest.changed_inputs() {
        note(format_args!("warning: {sentence}"));
    }
    let recorded: RunOptions = manifest.flags().map_err(CliError::bad_input)?;
    let (scene, recorded_scene) = match &args.scene {
        Some(scene) => (scene.clone(), None),
        None => {
            let now = std::fs::read_to_string(&manifest.scene_path);
            if now.is_ok_and(|now| now != manifest.scene_text) {
                let file = manifest.scene_path.display();
                note(format_args!(
                    "warning: {file} has changed since the run was started, which goes on with it as it was"
                ));
            }
            let text = manifest.text_to_read();
            (manifest.scene_path, Some(text))
        }
    };
    let options = args.options.over(&recorded).map_err(CliError::bad_input)?;
    let places = RunPlaces { scene, out, existing };
    Ok(Resolved { places, options, recorded_scene })
}
