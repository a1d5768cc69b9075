//! `loomtree run`: runs the coordinator in this process and starts workers as child processes.

use std::path::{Path, PathBuf};

use super::CliError;
use super::convert::{Target, export};
use super::launcher::LauncherArgs;
use super::run_lines::{Made, conclude, introduce, stopped};
use super::start_state::Places;
use super::sweep;
use super::view::{PageArgs, serve};
use crate::coordinator::plan::scene_text;
use crate::coordinator::{
    GivenOptions, Launch, PlanError, RunOptions, RunPlaces, RunPlan, Scope, Steering, TimeOptions,
};
use crate::os::console::note;
use crate::os::signals;
use crate::output::{Existing, FrameFormat, RunDirectory, RunManifest};
use crate::scene::{
    Change, Overrides, ParsedScene, fields_of_fps, read, read_changes, read_str, read_time_table, runs_of_fields,
};
use crate::transport::RANKS_MAX;

/// Arguments of `loomtree run`.
#[derive(Clone, Debug, clap::Args)]
#[allow(rustdoc::invalid_html_tags, reason = "doc comments are the texts of --help")]
pub struct RunArgs {
    /// Scene file (.toml, or ARCSim's .json); with --resume it may be left out
    #[arg(required_unless_present_any = ["resume", "only_segment"])]
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
    /// With --segments: make the coarse run and the cuts, and stop there
    #[arg(long, conflicts_with = "only_segment")]
    pub coarse_only: bool,
    /// Make segment J (from 0) of the shot in --out, whose coarse run is there, on this machine or another one, then
    /// `loomtree join`
    #[arg(long, value_name = "J", conflicts_with_all = ["resume", "overwrite"])]
    pub only_segment: Option<usize>,
    /// Frames per second: as many steps in a frame as fit, as long as the scene's or a little shorter or longer, and as
    /// many frames as keep the length of the shot
    #[arg(long, value_name = "F", value_parser = frames_per_second, conflicts_with_all = ["resume", "only_segment"])]
    pub fps: Option<f64>,
    /// Take changes while it runs: pause, step, wind, gravity, friction, fabrics, pins (loomtree live RUN --help)
    #[arg(long, conflicts_with_all = ["coarse_only", "only_segment"])]
    pub live: bool,
    /// With --live: stand still before the first step
    #[arg(long, requires = "live")]
    pub paused: bool,
    /// Make the changes of a live run again: its run_changes.toml
    #[arg(long, value_name = "FILE", conflicts_with_all = ["resume", "coarse_only", "only_segment"])]
    pub replay: Option<PathBuf>,
    /// Show the run in the browser while it goes on; the page stays until Ctrl-C
    #[arg(long)]
    pub view: bool,
    /// Where the page is served.
    #[command(flatten)]
    pub page: PageArgs,
    /// Who starts the workers.
    #[command(flatten)]
    pub launcher: LauncherArgs,
    /// Everything that run.toml keeps.
    #[command(flatten)]
    pub options: GivenOptions,
}

/// Runs the command.
///
/// # Errors
/// Bad input, a failed run, or a run that a signal has stopped (exit code 128 + its number).
pub fn run(args: RunArgs, launch: Launch) -> Result<(), CliError> {
    let runs = runs_of_fields(&args.options.options.set).map_err(CliError::bad_input)?;
    if runs.len() > 1 {
        return run_all(&args, runs, &launch);
    }
    run_one(&args, &launch)?.answer()
}

/// Makes the runs that lists of `--set` ask for, in folders of their own.
fn run_all(args: &RunArgs, runs: Vec<Vec<String>>, launch: &Launch) -> Result<(), CliError> {
    let alone = [
        (args.resume, "--resume"),
        (args.only_segment.is_some(), "--only-segment"),
        (args.coarse_only, "--coarse-only"),
        (args.view, "--view"),
        (args.live, "--live"),
        (args.replay.is_some(), "--replay"),
    ];
    if let Some((_, flag)) = alone.iter().find(|(given, _)| *given) {
        return Err(CliError::bad_input(format!(
            "{flag} is for one run, but the lists of --set ask for {}",
            runs.len()
        )));
    }
    let Some(scene) = &args.scene else {
        return Err(CliError::bad_input("a scene file is needed: loomtree run SCENE"));
    };
    let base = args.out.clone().unwrap_or_else(|| PathBuf::from("out").join(scene.file_stem().unwrap_or_default()));
    let planned = sweep::planned(runs, &base, args.overwrite)?;
    sweep::make(&planned, &base, |run| {
        let mut own = args.clone();
        own.options.options.set = run.set.clone();
        own.out = Some(run.out.clone());
        let made = run_one(&own, launch)?;
        if made.is_by_signal { Err(stopped()) } else { Ok(()) }
    })
}

fn run_one(args: &RunArgs, launch: &Launch) -> Result<Made, CliError> {
    let Resolved { places, mut options, recorded_scene, recorded } = resolve(args)?;
    // Checked before the plan is made, which can take a while. Too many workers are refused there.
    let is_split = options.time.segments > 1 && !args.coarse_only && args.only_segment.is_none();
    if let Some(ranks) = launch.ranks() {
        share_ranks(ranks, is_split, &args.options, &mut options);
        if options.emulate_links {
            let what = "--emulate-links models links on one machine, between workers that this program starts";
            return Err(CliError::bad_input(what));
        }
    }
    let sessions = if is_split { options.time.sessions.unwrap_or(1) } else { 1 };
    launch.machine().prepare((sessions * options.workers).min(RANKS_MAX))?;
    let scope = match (args.coarse_only, args.only_segment) {
        (true, _) => Scope::Coarse,
        (false, Some(segment)) => Scope::Segment(segment),
        (false, None) => Scope::All,
    };
    if args.view {
        serve(std::slice::from_ref(&places.out), &args.page)?;
    } else if args.page.open || args.page.port != 0 {
        return Err(CliError::bad_input("--port and --open go with --view"));
    }
    let changes = Changes { live: args.live, paused: args.paused, recorded };
    let made = make(recorded_scene.as_deref(), &options, &places, changes, scope, launch);
    let made = if scope == Scope::All { with_caches(made, &options, &places.out) } else { made };
    if args.view && made.as_ref().is_ok_and(|made| !made.is_by_signal) {
        note("the page stays until Ctrl-C");
        signals::wait_for_stop();
    }
    made
}

/// Makes the caches that `--format` asks for from the frames that there are, also of a run that was stopped or failed.
fn with_caches(made: Result<Made, CliError>, options: &RunOptions, out: &Path) -> Result<Made, CliError> {
    let caches: Vec<Target> = options.formats.1.iter().map(|&format| format.into()).collect();
    // What was refused has written nothing.
    let has_begun = made.as_ref().map_or_else(|error| error.exit_code != 2, |_| true);
    if caches.is_empty() || !has_begun {
        return made;
    }
    match (export(out, &caches, None), made) {
        (Ok((files, _)), made) => {
            files.lines().for_each(|file| note(format_args!("written: {file}")));
            made
        }
        (Err(error), Ok(_)) => Err(error),
        (Err(error), Err(first)) => {
            note(format_args!("no caches: {}", error.message));
            Err(first)
        }
    }
}

/// What changes a run while it goes on, besides what its scene says.
struct Changes {
    live: bool,
    paused: bool,
    /// Of a record; none if there is none.
    recorded: Option<Vec<Change>>,
}

/// Makes the run.
fn make(
    recorded_scene: Option<&str>,
    options: &RunOptions,
    places: &RunPlaces,
    changes: Changes,
    scope: Scope,
    launch: &Launch,
) -> Result<Made, CliError> {
    let can_change = changes.live || changes.recorded.is_some();
    if options.time.segments > 1 && can_change {
        return Err(CliError::bad_input(
            "--live and --replay change a run while it goes on, not a shot that is split (--segments)",
        ));
    }
    if options.time.segments > 1 {
        return super::run_split::run(recorded_scene, options, places, scope, launch);
    }
    if scope != Scope::All {
        let what = "--coarse-only and --only-segment need a shot that is split in time (--segments)";
        return Err(CliError::bad_input(what));
    }
    let parsed = match recorded_scene {
        Some(text) => read_str(text, &places.scene),
        None if options.set.is_empty() => read(&places.scene),
        None => scene_text(&places.scene, &options.set).and_then(|text| read_str(&text, &places.scene)),
    };
    // A resumed run has kept what it took from the run that it started from.
    let kept = (places.existing == Existing::Resume).then(|| places.out.join("start.ltc"));
    let planned = |parsed: ParsedScene| -> Result<RunPlan, PlanError> {
        let mut plan = RunPlan::of_parsed(&parsed, options, kept.as_deref())?;
        if can_change {
            let overrides = Overrides { resolution: options.resolution, frames: options.frames };
            let steering = Steering::new(&parsed, &overrides)?;
            let (live, paused, recorded) = (changes.live, changes.paused, changes.recorded.unwrap_or_default());
            let steering = Steering { live, paused, recorded, ..steering };
            // What a run has recorded was checked when it was asked for.
            if places.existing != Existing::Resume {
                steering.check(&plan.scene).map_err(|what| PlanError::Start(what))?;
            }
            plan.steering = Some(Box::new(steering));
        }
        Ok(plan)
    };
    let plan = parsed.map_err(PlanError::from).and_then(planned);
    let plan = plan.map_err(|error| match error.blaming_set(&places.scene, options) {
        PlanError::Scene(mut error) => CliError::bad_input(Places::beside(&places.out).refuse(&mut error)),
        other => CliError::bad_input(other),
    })?;
    let steering = plan.steering.as_deref();
    if options.formats.0.contains(&FrameFormat::Pc2) && steering.is_some_and(|one| one.live || one.changes_mesh()) {
        let what = "--format pc2 holds one mesh, and the mesh of this run may change: use ply, then `loomtree convert`";
        return Err(CliError::bad_input(what));
    }
    introduce(&plan, options);
    // Until here a signal ends the process in the default way.
    signals::listen().map_err(|error| CliError::failed(format!("cannot listen for signals: {error}")))?;
    conclude(crate::coordinator::run(plan, options, places, launch), places)
}

/// Gives every one of `ranks` processes of a world a place: to as many workers as there are, or to the sessions of a
/// split shot. What the command line says stays, and is checked against the processes later.
fn share_ranks(ranks: usize, is_split: bool, given: &GivenOptions, options: &mut RunOptions) {
    let sessions = &mut options.time.sessions;
    if !is_split {
        if !given.gives("workers") {
            options.workers = ranks;
        }
    } else if given.gives("workers") || sessions.is_none() {
        // Without --sessions every session has one worker.
        options.workers = if given.gives("workers") { options.workers } else { 1 };
        sessions.get_or_insert((ranks / options.workers.max(1)).max(1));
    } else {
        options.workers = (ranks / sessions.unwrap_or(1).max(1)).max(1);
    }
}

fn frames_per_second(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(fps) if (0.01..=1e5).contains(&fps) => Ok(fps),
        _ => Err("expected a number of frames per second, for example 24".into()),
    }
}

/// Resolved arguments of the command.
struct Resolved {
    places: RunPlaces,
    options: RunOptions,
    /// The scene's text from the run directory, if the run continues with it.
    recorded_scene: Option<String>,
    /// Changes that the run has made or is to make; none if nothing can change it.
    recorded: Option<Vec<Change>>,
}

/// Resolves the scene, run directory and options. A resumed run takes missing options from `run.toml` and uses the
/// recorded scene, because the original file can have moved, changed or disappeared.
fn resolve(args: &RunArgs) -> Result<Resolved, CliError> {
    let resume = args.resume || args.only_segment.is_some();
    let existing = match (resume, args.overwrite) {
        (true, _) => Existing::Resume,
        (_, true) => Existing::Overwrite,
        _ => Existing::Refuse,
    };
    if !resume {
        let scene =
            args.scene.clone().ok_or_else(|| CliError::bad_input("a scene file is needed: loomtree run SCENE"))?;
        let stem = scene.file_stem().unwrap_or_default();
        let out = args.out.clone().unwrap_or_else(|| PathBuf::from("out").join(stem));
        if scene.to_str().is_none() {
            let sentence = "its name is not UTF-8, which run.toml needs: rename the file, or give a link to it";
            return Err(CliError::bad_input(format!("{}: {sentence}", scene.display())));
        }
        let mut options = over_scene(&args.options, &scene)?;
        if let Some(fps) = args.fps {
            let wrong = |what: String| CliError::bad_input(format!("{}: {what}", scene.display()));
            let text = scene_text(&scene, &options.set).map_err(CliError::bad_input)?;
            if !scene.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml")) {
                return Err(wrong("--fps is for scenes in TOML".into()));
            }
            options.set.extend(fields_of_fps(&text, fps).map_err(wrong)?);
        }
        let places = RunPlaces { scene, out, existing };
        let mut recorded = None;
        if let Some(file) = &args.replay {
            let unreadable = |error| CliError::bad_input(format!("{}: cannot be read: {error}", file.display()));
            let text = std::fs::read_to_string(file).map_err(unreadable)?;
            let mut changes = read_changes(&text, file).map_err(CliError::bad_input)?;
            changes.retain(|change| !change.edit.is_note());
            recorded = Some(changes);
        }
        return Ok(Resolved { places, options, recorded_scene: None, recorded });
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
    if !args.options.options.set.is_empty() {
        return Err(CliError::bad_input("--set changes the scene, so it cannot go with --resume or --only-segment"));
    }
    let options = args.options.over(&recorded).map_err(CliError::bad_input)?;
    let recorded = match &manifest.changes_file {
        None => None,
        Some(_) => {
            let file = directory.changes();
            // A run that was killed at its start has no record yet.
            let text = std::fs::read_to_string(&file).unwrap_or_default();
            Some(read_changes(&text, &file).map_err(CliError::bad_input)?)
        }
    };
    let places = RunPlaces { scene, out, existing };
    Ok(Resolved { places, options, recorded_scene, recorded })
}

/// The options of the command line over those of the scene's `[time]`.
fn over_scene(given: &GivenOptions, scene: &Path) -> Result<RunOptions, CliError> {
    // What cannot be read is refused by whoever reads the scene, and a pipe can be read only once.
    if !scene.is_file() {
        return Ok(given.options.clone());
    }
    let Ok(text) = std::fs::read_to_string(scene) else { return Ok(given.options.clone()) };
    let table = read_time_table(&text, scene).map_err(CliError::bad_input)?;
    let base = RunOptions { time: TimeOptions::of_scene(&table), ..RunOptions::default() };
    given.over(&base).map_err(CliError::bad_input)
}
