//! `loomtree run`: coordinator in this process, workers as its children.

use std::path::PathBuf;

use clap::ValueEnum;

use super::CliError;
use super::start_state::{Places, untangled_line};
use crate::coordinator::{KeepStates, Launch, PlanError, RunError, RunOptions, RunPlaces, RunPlan};
use crate::interconnect::ScheduleKind;
use crate::os::console::note;
use crate::os::signals;
use crate::output::{Existing, FrameFormat, RunDirectory, RunManifest, parse_formats};
use crate::protocol::{BindCores, ExecutorChoice};
use crate::scene::PreconditionerKind;
use crate::solver::ExchangeMode;
use crate::transport::{RANKS_MAX, check_descriptors, remove_dead_runs};

/// Arguments of `loomtree run`.
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    /// Scene file (.toml, or ARCSim's .json); with --resume it may be left out
    #[arg(required_unless_present = "resume")]
    pub scene: Option<PathBuf>,
    /// Worker processes, each with its own device and row block [default: 1; with --resume as before]
    #[arg(long, short = 'n', value_name = "N")]
    pub workers: Option<usize>,
    /// Topology file; workers sit on its first GPUs [default: a balanced binary tree]
    #[arg(long, value_name = "FILE")]
    pub topology: Option<PathBuf>,
    /// Hold messages back until the clock says that they have arrived over the links of --topology: a run as slow as there
    #[arg(long)]
    pub emulate_links: bool,
    /// What runs the kernels; auto = a hardware GPU where there is one, else cpu
    #[arg(long, value_enum)]
    pub executor: Option<ExecutorArg>,
    /// Adapter of the gpu executor (numbers: loomtree doctor) [default: rank modulo adapters]
    #[arg(long, value_name = "I")]
    pub adapter: Option<usize>,
    /// Threads of each worker on the cpu executor [default: cores / workers]
    #[arg(long, value_name = "T", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Whether workers of one thread that share cores evenly (more workers than cores) keep to one core each; never = the
    /// system decides [default: auto]
    #[arg(long, value_enum)]
    pub bind_cores: Option<BindCoresArg>,
    /// Frames to write after frame 0 [default: the scene's]
    #[arg(long, value_name = "N")]
    pub frames: Option<u32>,
    /// Triangles of the scene's procedural sheets (for example 30000, 500K or 1.2M) [default: the scene's]
    #[arg(long, value_name = "TRIANGLES", value_parser = super::count)]
    pub resolution: Option<u64>,
    /// Run directory [default: out/<scene>]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Untangle a start state that crosses, as far as it goes, instead of refusing it
    #[arg(long)]
    pub untangle: bool,
    /// What a matrix-vector product exchanges: halo = only the rows that are read, full = whole sub-vectors (P-Cloth)
    #[arg(long, value_enum)]
    pub exchange: Option<ExchangeArg>,
    /// Order of the transfers; auto = the cheapest by the modelled cost
    #[arg(long)]
    pub schedule: Option<ScheduleKind>,
    /// Memory for the collision tables of each worker; what does not fit is done in batches (for example 500M, 2G) [default: what --topology's GPUs have beside the solver]
    #[arg(long, value_name = "BYTES", value_parser = bytes)]
    pub memory_limit: Option<u64>,
    /// Preconditioner of the solver; auto = the fastest for the executor and size [default: the scene's, which is auto]
    #[arg(long, value_enum)]
    pub preconditioner: Option<PreconditionerArg>,
    /// Write a checkpoint every K frames (one is always left at the end, at Ctrl-C and after a failure) [default: 10]
    #[arg(long, value_name = "K")]
    pub checkpoint_every: Option<u32>,
    /// Keep states for good, as states/step_%08d.ltc (positions and velocities): that of every frame, or of every K steps
    #[arg(long, value_name = "frames|K")]
    pub keep_states: Option<KeepStates>,
    /// Go on from the newest checkpoint in the run directory, on any number of workers
    #[arg(long, conflicts_with = "overwrite")]
    pub resume: bool,
    /// Replace a run that is in the run directory
    #[arg(long)]
    pub overwrite: bool,
    /// Frame files: any of obj, ply, pc2, separated by commas [default: ply]
    #[arg(long, value_name = "LIST", value_parser = FormatList::parse)]
    pub format: Option<FormatList>,
    /// Seconds without a sign of life after which a worker counts as hung [default: 10]
    #[arg(long, value_name = "S", value_parser = positive_seconds)]
    pub heartbeat: Option<f64>,
    /// Steps whose events are kept in trace.json [default: 20]
    #[arg(long, value_name = "N")]
    pub trace_steps: Option<u32>,
}

/// Executor on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ExecutorArg {
    Auto,
    Gpu,
    Cpu,
}

impl From<ExecutorArg> for ExecutorChoice {
    fn from(arg: ExecutorArg) -> ExecutorChoice {
        match arg {
            ExecutorArg::Auto => ExecutorChoice::Auto,
            ExecutorArg::Gpu => ExecutorChoice::Gpu,
            ExecutorArg::Cpu => ExecutorChoice::Cpu,
        }
    }
}

/// Core binding on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BindCoresArg {
    Auto,
    Never,
}

impl From<BindCoresArg> for BindCores {
    fn from(arg: BindCoresArg) -> BindCores {
        match arg {
            BindCoresArg::Auto => BindCores::Auto,
            BindCoresArg::Never => BindCores::Never,
        }
    }
}

/// Exchange mode on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ExchangeArg {
    Halo,
    Full,
}

impl From<ExchangeArg> for ExchangeMode {
    fn from(arg: ExchangeArg) -> ExchangeMode {
        match arg {
            ExchangeArg::Halo => ExchangeMode::Halo,
            ExchangeArg::Full => ExchangeMode::Full,
        }
    }
}

/// Preconditioner on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PreconditionerArg {
    Auto,
    Jacobi,
    Schwarz,
}

impl From<PreconditionerArg> for PreconditionerKind {
    fn from(arg: PreconditionerArg) -> PreconditionerKind {
        match arg {
            PreconditionerArg::Auto => PreconditionerKind::Auto,
            PreconditionerArg::Jacobi => PreconditionerKind::Jacobi,
            PreconditionerArg::Schwarz => PreconditionerKind::Schwarz,
        }
    }
}

/// A list of frame formats.
#[derive(Clone, Debug)]
pub struct FormatList(Vec<FrameFormat>);

impl FormatList {
    fn parse(text: &str) -> Result<FormatList, String> {
        parse_formats(text).map(FormatList).map_err(|error| error.to_string())
    }
}

pub(super) fn positive_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds > 0.0 && seconds <= 1e9 => Ok(seconds),
        _ => Err("expected a number of seconds above 0, at most 1e9".to_string()),
    }
}

/// A number of bytes with K, M or G (powers of 1000) behind it, or nothing.
fn bytes(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match &text[digits.len()..] {
        "" => 1.0,
        "K" | "k" | "KB" => 1e3,
        "M" | "MB" => 1e6,
        "G" | "GB" => 1e9,
        _ => f64::NAN,
    };
    let bytes = digits.parse::<f64>().unwrap_or(f64::NAN) * unit;
    if (1e6..1e18).contains(&bytes) {
        Ok(bytes as u64)
    } else {
        Err("expected at least 1M, for example 500M or 2G".into())
    }
}

impl RunArgs {
    /// What the flags say, on top of `base` (defaults, or the options of the run that is resumed).
    fn options(&self, mut base: RunOptions) -> RunOptions {
        base.workers = self.workers.unwrap_or(base.workers);
        base.topology = self.topology.clone().or(base.topology);
        base.emulate_links |= self.emulate_links;
        base.executor = self.executor.map_or(base.executor, Into::into);
        base.adapter = self.adapter.or(base.adapter);
        base.threads = self.threads.map(usize::from).or(base.threads);
        base.bind_cores = self.bind_cores.map_or(base.bind_cores, Into::into);
        base.frames = self.frames.or(base.frames);
        base.resolution = self.resolution.or(base.resolution);
        base.untangle |= self.untangle;
        base.exchange = self.exchange.map_or(base.exchange, Into::into);
        base.schedule = self.schedule.unwrap_or(base.schedule);
        base.memory_limit_bytes = self.memory_limit.or(base.memory_limit_bytes);
        base.preconditioner = self.preconditioner.map(Into::into).or(base.preconditioner);
        base.checkpoint_every = self.checkpoint_every.unwrap_or(base.checkpoint_every);
        base.keep_states = self.keep_states.or(base.keep_states);
        base.formats = self.format.clone().map_or(base.formats, |list| list.0);
        base.heartbeat_s = self.heartbeat.unwrap_or(base.heartbeat_s);
        base.trace_steps = self.trace_steps.unwrap_or(base.trace_steps);
        base
    }
}

/// What a run does unless told otherwise.
pub fn defaults() -> RunOptions {
    RunOptions {
        workers: 1,
        topology: None,
        emulate_links: false,
        executor: ExecutorChoice::Auto,
        adapter: None,
        threads: None,
        bind_cores: BindCores::Auto,
        frames: None,
        resolution: None,
        untangle: false,
        exchange: ExchangeMode::Halo,
        schedule: ScheduleKind::Auto,
        memory_limit_bytes: None,
        preconditioner: None,
        checkpoint_every: 10,
        keep_states: None,
        formats: vec![FrameFormat::Ply],
        heartbeat_s: 10.0,
        trace_steps: 20,
    }
}

/// Runs the command.
///
/// # Errors
/// Bad input, a run that failed, or one that a signal has stopped (exit code 128 + its number).
pub fn run(args: RunArgs, launch: Launch) -> Result<(), CliError> {
    let Resolved { places, options, recorded_scene } = resolve(&args)?;
    // Before a plan is made, which may take a while; more workers than possible are refused there.
    check_descriptors(options.workers.min(RANKS_MAX)).map_err(CliError::bad_input)?;
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
    for line in &plan.scene.warnings {
        note(format_args!("warning: {line}"));
    }
    for line in &plan.scene.left_out {
        note(format_args!("left out: {line}"));
    }
    remove_dead_runs();
    let (triangles, vertices) = (plan.scene.mesh.triangles.len(), plan.scene.mesh.positions.len());
    note(format_args!(
        "{}: {triangles} triangles, {vertices} vertices, {} workers, schedule {}",
        plan.scene.name,
        options.workers,
        plan.transfers.kind.name()
    ));
    // Up to here a signal ends the process as usual.
    signals::listen().map_err(|error| CliError::failed(format!("cannot listen for signals: {error}")))?;
    let summary = crate::coordinator::run(plan, &options, &places, &launch).map_err(|error| match error {
        RunError::BadInput(text) => CliError::bad_input(text),
        RunError::Failed(text) => CliError::failed(text),
        RunError::Stopped(text) => {
            note(text);
            stopped()
        }
    })?;
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

/// The end of a run that a signal has stopped; what there is to say has been said.
fn stopped() -> CliError {
    let exit_code = signals::stop_requested().map_or(1, |signal| signal.exit_code());
    CliError { exit_code, message: String::new() }
}

/// What a command line asks for.
struct Resolved {
    places: RunPlaces,
    options: RunOptions,
    /// The scene's text as the run directory has it, if the run goes on with that.
    recorded_scene: Option<String>,
}

/// Scene, run directory and options; a resumed run takes from `run.toml` what the command line leaves open, and goes on with
/// the scene as it was: its file may have moved, changed or gone since.
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
        let (places, options) = (RunPlaces { scene, out, existing }, args.options(defaults()));
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
            (manifest.scene_path, Some(manifest.scene_text))
        }
    };
    let (places, options) = (RunPlaces { scene, out, existing }, args.options(recorded));
    Ok(Resolved { places, options, recorded_scene })
}
