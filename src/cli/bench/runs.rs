//! Runs of a scene with real worker processes, for the benchmarks that measure whole steps.

use std::path::PathBuf;

use super::common::{Common, median, worker_counts};
use crate::cli::CliError;
use crate::cli::predict::RecordedRun;
use crate::coordinator::{Launch, RunOptions, RunPlaces, RunPlan};
use crate::interconnect::{KernelTimes, Replay, ScheduleKind, Topology, plan};
use crate::os::console::note;
use crate::output::{Existing, Report, StepRecord};
use crate::scene::{PreconditionerKind, Scene};
use crate::solver::ExchangeMode;

/// Arguments of benchmarks of whole steps.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ScenesBench {
    /// Scenes to run, separated by commas or each with a --scene of its own; of several, each has its tables, and files
    /// named after it
    #[arg(long, value_delimiter = ',', default_value = "scenes/flag.toml")]
    pub scene: Vec<PathBuf>,
    /// Steps before the counted ones, for scenes whose contacts come late: one number for all scenes, or one for each
    /// [default: a fifth of --steps]
    #[arg(long, value_delimiter = ',', value_name = "N")]
    pub skip: Vec<u32>,
    #[command(flatten)]
    pub settings: Settings,
}

/// Options that all scenes of a benchmark share.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct Settings {
    #[command(flatten)]
    pub common: Common,
    /// Triangles of each scene
    #[arg(long, default_value_t = 50_000, value_parser = crate::cli::count)]
    pub resolution: u64,
    /// Numbers of worker processes, measured in turn
    #[arg(long, value_delimiter = ',', default_value = "1,2,4,8", value_parser = worker_counts)]
    pub workers: Vec<usize>,
    /// Steps per run; those of --skip are not counted
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(2..))]
    pub steps: u32,
    /// Rounds: every number of workers is run this many times, interleaved
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    pub rounds: u32,
    /// What a product exchanges
    #[arg(long, value_enum, default_value = "halo")]
    pub exchange: ExchangeMode,
    /// Preconditioner of the solver [default: the scene's]; auto takes schwarz from a size on, which weak scaling may
    /// cross
    #[arg(long, value_enum)]
    pub preconditioner: Option<PreconditionerKind>,
}

impl ScenesBench {
    /// The scenes one by one.
    ///
    /// # Errors
    /// The numbers of `--skip` do not fit the scenes, or the files of two scenes would have the same names.
    pub(super) fn each(&self, launch: &Launch) -> Result<Vec<SceneBench>, CliError> {
        let (scenes, skips) = (self.scene.len(), self.skip.len());
        if skips > 1 && skips != scenes {
            return Err(CliError::bad_input(format!(
                "--skip: {skips} numbers for {scenes} scene(s); expected one for all or one for each"
            )));
        }
        let stem =
            |path: &PathBuf| path.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
        let stems: Vec<String> = self.scene.iter().map(stem).collect();
        if let Some(twice) = stems.iter().enumerate().find_map(|(i, stem)| stems[..i].contains(stem).then_some(stem)) {
            return Err(CliError::bad_input(format!("--scene: two scenes are called '{twice}'; run them one by one")));
        }
        let mut settings = self.settings.clone();
        if let Some(ranks) = launch.ranks() {
            settings.workers = within(&settings.workers, ranks)?;
        }
        let one = |(i, scene): (usize, &PathBuf)| SceneBench {
            scene: scene.clone(),
            skip: self.skip.get(i).or(self.skip.first()).copied(),
            step_s: None,
            suffix: if scenes > 1 { format!("_{}", stems[i]) } else { String::new() },
            settings: settings.clone(),
            launch: launch.clone(),
            sewn: None,
        };
        Ok(self.scene.iter().enumerate().map(one).collect())
    }
}

/// The benchmark of one scene.
#[derive(Clone, Debug)]
pub(super) struct SceneBench {
    /// Scene file.
    pub scene: PathBuf,
    /// Steps before the counted ones, if they come on top of those.
    skip: Option<u32>,
    /// Ending of the names of its tables.
    suffix: String,
    /// Length of a step, if not that of the scene, seconds.
    step_s: Option<f64>,
    /// Options that all scenes share.
    pub settings: Settings,
    /// Who starts the workers.
    launch: Launch,
    /// The scene once its seams are closed, in place of that of the file.
    sewn: Option<Scene>,
}

/// The numbers of workers that `ranks` processes of a launcher allow.
fn within(workers: &[usize], ranks: usize) -> Result<Vec<usize>, CliError> {
    let (kept, left): (Vec<usize>, Vec<usize>) = workers.iter().partition(|&&workers| workers <= ranks);
    if kept.is_empty() {
        return Err(CliError::bad_input(format!(
            "--workers: {ranks} processes were started, and every number is above"
        )));
    }
    if !left.is_empty() {
        note(format_args!("{ranks} processes were started, so {left:?} workers are left out"));
    }
    Ok(kept)
}

/// The counted steps of all rounds with one number of workers.
#[derive(Default)]
pub(super) struct Runs {
    pub workers: usize,
    pub steps: Vec<StepRecord>,
    /// Everything before and after the steps of the last round: reading, splitting, starting, leaving; seconds.
    pub start_s: f64,
}

impl Runs {
    /// Values of a figure over the counted steps.
    pub(super) fn values(&self, figure: impl Fn(&StepRecord) -> f64) -> Vec<f64> {
        self.steps.iter().map(figure).collect()
    }

    /// Median of a figure over the counted steps.
    pub(super) fn median(&self, figure: impl Fn(&StepRecord) -> f64) -> f64 {
        median(&mut self.values(figure))
    }

    /// Mean of a figure over the counted steps.
    pub(super) fn mean(&self, figure: impl Fn(&StepRecord) -> f64) -> f64 {
        self.values(figure).iter().sum::<f64>() / self.steps.len().max(1) as f64
    }

    /// Largest value of a figure over the counted steps.
    pub(super) fn most(&self, figure: impl Fn(&StepRecord) -> f64) -> f64 {
        self.values(figure).into_iter().fold(0.0, f64::max)
    }
}

/// Triangles and vertices of a scene.
#[derive(Clone, Copy, Default)]
pub(super) struct Size {
    pub triangles: usize,
    pub vertices: usize,
}

impl SceneBench {
    /// The benchmark of one scene, with steps of `step_s` seconds if that is given.
    ///
    /// # Errors
    /// The launcher has started too few processes for every number of workers.
    pub(super) fn alone(
        scene: PathBuf,
        skip: u32,
        step_s: Option<f64>,
        mut settings: Settings,
        launch: &Launch,
    ) -> Result<SceneBench, CliError> {
        if let Some(ranks) = launch.ranks() {
            settings.workers = within(&settings.workers, ranks)?;
        }
        let (skip, suffix, launch) = (Some(skip), String::new(), launch.clone());
        Ok(SceneBench { scene, skip, suffix, step_s, settings, launch, sewn: None })
    }

    /// Length of a step, seconds.
    pub(super) fn step_s(&self) -> Result<f64, CliError> {
        let of_scene = || crate::scene::read(&self.scene).map(|scene| scene.step_s()).map_err(CliError::bad_input);
        self.step_s.map_or_else(of_scene, Ok)
    }

    /// Runs every number of workers `rounds` times, interleaved.
    pub(super) fn run(&self) -> Result<(Size, Vec<Runs>), CliError> {
        let mut all: Vec<Runs> =
            self.settings.workers.iter().map(|&workers| Runs { workers, ..Runs::default() }).collect();
        let mut size = Size::default();
        for _ in 0..self.settings.rounds {
            for runs in &mut all {
                size = self.run_once(runs)?;
            }
        }
        Ok((size, all))
    }

    /// Name of a table.
    pub(super) fn name(&self, table: &str) -> String {
        format!("{table}{}", self.suffix)
    }

    /// Title of a table.
    pub(super) fn title(&self, size: Size) -> String {
        format!(
            "{}: {} triangles, {} vertices, {} thread(s) per worker",
            self.scene.display(),
            size.triangles,
            size.vertices,
            self.settings.common.threads
        )
    }

    /// Steps before the counted ones, and all steps of a run.
    fn steps(&self) -> (u32, u32) {
        let steps = self.settings.steps;
        self.skip.map_or((steps.div_ceil(5), steps), |skip| (skip, steps.saturating_add(skip)))
    }

    /// Modeled seconds of the counted steps on `topology`, with schedule `best`: a run of its own records events, which
    /// costs time, and is re-timed as `loomtree predict` does it.
    pub(super) fn predict(&self, workers: usize, topology: &Topology) -> Result<Vec<f64>, CliError> {
        let (skip, steps) = self.steps();
        let launched = self.launch(workers, steps)?;
        let recorded = RecordedRun::read(&launched.folder.path().join(RUN))?;
        let rows = recorded.rows()?;
        let plan =
            plan(ScheduleKind::Best, topology, rows.div_ceil(workers) as f64 * 12.0).map_err(CliError::failed)?;
        let how = Replay { topology, plan: &plan, exchange: recorded.exchange(), kernels: KernelTimes::Device, rows };
        let steps = recorded.replay(&how)?;
        Ok(steps.iter().filter(|step| step.step > skip).map(|step| step.total_s).collect())
    }

    /// The benchmark of `scene`, if there is one, in place of that of the file.
    pub(super) fn in_place(self, scene: Option<Scene>) -> SceneBench {
        SceneBench { sewn: scene, ..self }
    }

    fn run_once(&self, runs: &mut Runs) -> Result<Size, CliError> {
        let (skip, steps) = self.steps();
        let Launched { size, wall_s, mut report, .. } = self.launch(runs.workers, 0)?;
        runs.start_s = wall_s - report.steps.iter().map(|step| step.stage_seconds.total).sum::<f64>();
        if report.steps.len() <= skip as usize {
            return Err(CliError::bad_input(format!("--skip {skip} leaves none of {steps} steps to count")));
        }
        runs.steps.extend(report.steps.drain(skip as usize..));
        Ok(size)
    }

    fn launch(&self, workers: usize, trace_steps: u32) -> Result<Launched, CliError> {
        let folder = tempfile::tempdir()
            .map_err(|error| CliError::failed(format!("cannot make a temporary folder: {error}")))?;
        let options = RunOptions {
            workers,
            executor: self.settings.common.executor,
            threads: Some(self.settings.common.threads as usize),
            resolution: Some(self.settings.resolution),
            frames: Some(1),
            exchange: self.settings.exchange,
            preconditioner: self.settings.preconditioner,
            checkpoint_every: 0,
            heartbeat_s: 600.0,
            trace_steps,
            ..RunOptions::default()
        };
        let mut plan = match &self.sewn {
            Some(scene) => RunPlan::of_scene(scene.clone(), &options).map_err(CliError::bad_input)?,
            None => RunPlan::new(&self.scene, &options).map_err(CliError::bad_input)?,
        };
        // One frame at the end, so that frames are not part of what is measured.
        plan.scene.settings.frames = 1;
        plan.scene.settings.steps_per_frame = self.steps().1;
        plan.scene.settings.step_s = self.step_s.unwrap_or(plan.scene.settings.step_s);
        let size = Size { triangles: plan.scene.mesh.triangles.len(), vertices: plan.scene.mesh.positions.len() };
        let out = folder.path().join(RUN);
        let places = RunPlaces { scene: self.scene.clone(), out, existing: Existing::Refuse };
        let start = std::time::Instant::now();
        crate::coordinator::run(plan, &options, &places, &self.launch)
            .map_err(|error| CliError::failed(error.to_string()))?;
        let wall_s = start.elapsed().as_secs_f64();
        let report = Report::load(&places.out.join("report.json")).map_err(CliError::failed)?;
        Ok(Launched { folder, size, wall_s, report })
    }
}

/// Run directory inside the temporary folder.
const RUN: &str = "run";

/// A run that has ended; its files go with it.
struct Launched {
    folder: tempfile::TempDir,
    size: Size,
    wall_s: f64,
    report: Report,
}
