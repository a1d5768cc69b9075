//! The coordinator of a run: starts the workers, gives them their parts, drives them step by step, collects frames and
//! keeps report, trace and checkpoints. It never does simulation maths.
//!
//! With `loomtree run` it lives in that process and only the workers are children; `loomtree-coordinator` is the same code
//! on its own. A coordinator in a third process would protect nothing more: workers watch the coordinator's process
//! whatever its name, leave by themselves when it is gone, and the last one removes what the run has put on the machine.
//! Not covered: a coordinator killed before it has started a worker leaves a few empty files (`loomtree doctor --clean`),
//! and a worker that hangs while it is being set up is only noticed after [`SETUP_LIMIT`].

pub mod crew;
pub mod plan;
mod progress;
mod recorder;

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use thiserror::Error;

pub use crew::{Crew, CrewError, Launch};
pub use plan::{PlanError, RunOptions, RunPlan};
use progress::Progress;
pub use recorder::RecordError;
use recorder::Recorder;

use crate::model::{NotFinite, RankModel, RankState, State};
use crate::output::{Checkpoint, Status};
use crate::protocol::{ToCoordinator, ToWorker, WorkerReady, WorkerSetup};
use crate::scene::Scene;
use crate::step::{ExchangePlan, Failure, StepStats};
use crate::telemetry::Event;
use crate::transport::{MachineError, STAMP_VALUES};

/// Setting up may take a worker much longer than any later sign of life.
const SETUP_LIMIT: Duration = Duration::from_secs(300);

/// Set by the first Ctrl-C: the run stops after the current step.
pub static STOP_REQUESTED: AtomicBool = AtomicBool::new(false);

/// Why a run did not end as it should.
#[derive(Debug, Error)]
pub enum RunError {
    /// The user can fix it before the run starts.
    #[error("{0}")]
    BadInput(String),
    /// It went wrong.
    #[error("{0}")]
    Failed(String),
}

impl From<PlanError> for RunError {
    fn from(error: PlanError) -> RunError {
        RunError::BadInput(error.to_string())
    }
}

/// Where a run reads and writes.
#[derive(Clone, Debug)]
pub struct RunPlaces {
    /// Scene file.
    pub scene: PathBuf,
    /// Run directory.
    pub out: PathBuf,
    /// What to do with a run that is there.
    pub existing: crate::output::Existing,
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunSummary {
    /// Frames written, frame 0 included.
    pub frames: u32,
    /// Steps done in this start.
    pub steps: u32,
    /// Mean wall time of a step as the coordinator saw it, seconds.
    pub seconds_per_step: f64,
    /// True if it was stopped by the user.
    pub stopped: bool,
}

/// Runs a plan to its end.
pub fn run(plan: RunPlan, options: &RunOptions, places: &RunPlaces, launch: &Launch) -> Result<RunSummary, RunError> {
    launch.machine().check_transfers(plan.partition.ranks(), message_values(&plan))?;
    let failed = |error: CrewError| RunError::Failed(error.to_string());
    let (mut recorder, resumed) = Recorder::open(&plan, options, places).map_err(|error| match error {
        RecordError::BadInput(text) => RunError::BadInput(text),
        RecordError::Write(text) => RunError::Failed(text),
    })?;
    // The scene stays what it is at time 0: order of vertices and pins come from there.
    let (state, first_step) = match &resumed {
        Some(Checkpoint { state, step, .. }) => (state.clone(), *step as u32),
        None => (State::start_of(&plan.scene), 0),
    };
    let mut crew = Crew::assemble(options.workers, launch, options.heartbeat()).map_err(failed)?;
    let mut driver = Driver {
        plan: &plan,
        options,
        recorder: &mut recorder,
        original_from_global: Vec::new(),
        state,
        done: first_step,
        seconds: 0.0,
    };
    let result = driver.drive(&mut crew, first_step, resumed.as_ref());
    let (done, seconds, original_from_global) =
        (driver.done, driver.seconds, std::mem::take(&mut driver.original_from_global));
    match result {
        Ok(stopped) => {
            crew.dismiss();
            let frames = done / plan.scene.settings.steps_per_frame + 1;
            recorder
                .finish(if stopped { Status::Stopped } else { Status::Done })
                .map_err(|error| RunError::Failed(error.to_string()))?;
            let steps = done - first_step;
            Ok(RunSummary { frames, steps, seconds_per_step: seconds / steps.max(1) as f64, stopped })
        }
        Err(error) => {
            drop(crew);
            let text = error.explain(&plan.scene, &original_from_global);
            let kept = recorder.keep_last_state();
            let _ = recorder.finish(Status::Failed(text.clone()));
            let kept = kept.map_err(|error| RunError::Failed(format!("{text}; and {error}")))?;
            Err(if error.is_bad_input() { RunError::BadInput(text) } else { RunError::Failed(format!("{text}{kept}")) })
        }
    }
}

impl From<MachineError> for RunError {
    fn from(error: MachineError) -> RunError {
        match error {
            MachineError::TooSmall(text) => RunError::BadInput(text),
            MachineError::Unreadable(text) => RunError::Failed(text),
        }
    }
}

/// Longest message between ranks: positions and velocities of a whole row block.
fn message_values(plan: &RunPlan) -> usize {
    // A single rank has nobody to send to.
    let stamp = if plan.emulated.is_some() { STAMP_VALUES } else { 0 };
    if plan.partition.ranks() == 1 { 0 } else { plan.partition.sub_vector_rows() * 6 + stamp }
}

/// Why driving ended early.
#[derive(Debug, Error)]
enum DriveError {
    #[error(transparent)]
    Crew(#[from] CrewError),
    #[error(transparent)]
    Record(#[from] RecordError),
    /// Seen in the collected state; what a solve runs into is seen by a worker.
    #[error(transparent)]
    State(Failure),
}

impl DriveError {
    fn is_bad_input(&self) -> bool {
        matches!(self, DriveError::Crew(error) if error.is_bad_input())
    }

    /// The sentence for the user, with vertices by their piece and their number in it.
    fn explain(&self, scene: &Scene, original_from_global: &[u32]) -> String {
        let name = |row: u32| scene.vertex_name(original_from_global.get(row as usize).copied().unwrap_or(row));
        match self {
            DriveError::Crew(error) => error.sentence(&name),
            DriveError::State(failure) => failure.sentence(&name),
            DriveError::Record(error) => error.to_string(),
        }
    }
}

/// Drives the workers of one run.
struct Driver<'a> {
    plan: &'a RunPlan,
    options: &'a RunOptions,
    recorder: &'a mut Recorder,
    original_from_global: Vec<u32>,
    state: State,
    done: u32,
    seconds: f64,
}

impl Driver<'_> {
    /// True if the user stopped the run.
    fn drive(&mut self, crew: &mut Crew, first_step: u32, resumed: Option<&Checkpoint>) -> Result<bool, DriveError> {
        let settings = &self.plan.scene.settings;
        let ready = self.set_up(crew)?;
        self.recorder.begin(self.plan, &ready)?;
        if resumed.is_none() {
            self.recorder.frame(self.plan, 0, 0, &self.state)?;
        }
        let last_step = settings.frames * settings.steps_per_frame;
        let progress = Progress::new(settings.frames, first_step / settings.steps_per_frame);
        for step in first_step + 1..=last_step {
            let record = step <= first_step.saturating_add(self.options.trace_steps);
            let start = std::time::Instant::now();
            crew.broadcast(&ToWorker::Step { step, record })?;
            let (stats, events) = self.collect_step(crew)?;
            self.seconds += start.elapsed().as_secs_f64();
            self.done = step;
            self.recorder.step(self.plan, &stats, &events, start.elapsed().as_secs_f64())?;
            let stop = STOP_REQUESTED.load(Ordering::Relaxed);
            let frame_ends = step.is_multiple_of(settings.steps_per_frame);
            if frame_ends || stop {
                self.collect_state(crew)?;
                self.check_state(step)?;
            }
            let frame = step / settings.steps_per_frame;
            if frame_ends {
                let hash = self.recorder.frame(self.plan, frame, step, &self.state)?;
                let every = self.options.checkpoint_every;
                if every > 0 && frame.is_multiple_of(every) && step != last_step {
                    self.recorder.keep_last_state()?;
                }
                progress.frame(frame, step, &stats[0], &hash, self.seconds / (step - first_step) as f64);
            }
            if stop {
                self.recorder.remember(frame, step, &self.state, self.plan);
                self.recorder.keep_last_state()?;
                progress.end();
                return Ok(true);
            }
        }
        self.recorder.keep_last_state()?;
        progress.end();
        Ok(false)
    }

    /// Sends every worker its part and waits until all are connected.
    fn set_up(&mut self, crew: &mut Crew) -> Result<Vec<WorkerReady>, DriveError> {
        let mut model = self.plan.model();
        model.set_state(&self.state);
        let ranks = self.plan.partition.ranks();
        let setup = WorkerSetup {
            executor: self.options.executor,
            adapter: self.options.adapter,
            threads: self.options.threads.unwrap_or_else(|| crew.machine().threads_per_worker(ranks)),
            bind_cores: self.options.bind_cores,
            ranks,
            max_message_values: message_values(self.plan),
            patience_s: 3600.0,
            links: None,
        };
        let links = self.plan.links(&model);
        RankModel::split(&model, &self.plan.partition, |rank, mut part| {
            let exchange =
                ExchangePlan { mode: self.options.exchange, queue: self.plan.transfers.schedule.queues[rank].clone() };
            if let Some(collision) = &mut part.collision {
                collision.memory_limit_bytes = self.options.memory_limit_bytes.or(self.plan.table_bytes);
            }
            // The serializer skips the arrays; they travel beside the message.
            let setup = WorkerSetup { links: links.as_ref().map(|links| links[rank].clone()), ..setup.clone() };
            let message = ToWorker::Simulate { setup, exchange, model: Box::new(part) };
            let ToWorker::Simulate { model, .. } = &message else { unreachable!("made above") };
            crew.send(rank, &message, &model.to_bytes())?;
            // One part at a time in flight: the coordinator's memory stays at one part.
            crew.flush(rank, SETUP_LIMIT)
        })?;
        self.original_from_global = model.original_from_global;
        let mut ready: Vec<Option<WorkerReady>> = vec![None; ranks];
        crew.collect(SETUP_LIMIT, |rank, message, _| match message {
            ToCoordinator::Ready(worker) => {
                ready[rank] = Some(worker);
                true
            }
            _ => false,
        })?;
        Ok(ready.into_iter().flatten().collect())
    }

    fn collect_step(&mut self, crew: &mut Crew) -> Result<(Vec<StepStats>, Vec<Vec<Event>>), DriveError> {
        let ranks = self.plan.partition.ranks();
        let mut stats = vec![StepStats::default(); ranks];
        let mut events = vec![Vec::new(); ranks];
        let limit = self.options.heartbeat();
        crew.collect(limit, |rank, message, arrays| match (message, arrays) {
            (ToCoordinator::StepDone(done), [bytes]) => {
                stats[rank] = *done;
                events[rank] = bytes.chunks_exact(size_of::<Event>()).map(bytemuck::pod_read_unaligned).collect();
                true
            }
            _ => false,
        })?;
        Ok((stats, events))
    }

    fn collect_state(&mut self, crew: &mut Crew) -> Result<(), DriveError> {
        crew.broadcast(&ToWorker::SendState)?;
        let (partition, order, state) = (&self.plan.partition, &self.original_from_global, &mut self.state);
        let limit = self.options.heartbeat();
        crew.collect(limit, |rank, message, arrays| {
            let rows = partition.rows_of(rank);
            let ToCoordinator::State = message else { return false };
            let Ok(part) = RankState::from_bytes(arrays, rows.len()) else { return false };
            state.scatter(&order[rows], &part);
            true
        })?;
        Ok(())
    }

    /// A state that is not finite is neither shown as a frame nor kept as one to go on from.
    fn check_state(&self, step: u32) -> Result<(), DriveError> {
        let Some(NotFinite { vertex, quantity }) = self.state.first_not_finite() else { return Ok(()) };
        let row = self.original_from_global.iter().position(|&original| original == vertex);
        Err(DriveError::State(Failure::NotFinite {
            step,
            row: row.map_or(vertex, |row| row as u32),
            quantity: quantity.into(),
            cause: "after the step".into(),
            suspect: "simulation.step_s, the start velocity or a force".into(),
        }))
    }
}
