//! The coordinator of a run: it starts the workers, sends them their parts, drives them step by step, collects frames
//! and writes report, trace and checkpoints. It does not compute any simulation math.
//!
//! `plan` has the inputs of a run, `session` a crew that can be loaded and stepped, `shot` assigns segments of steps to
//! sessions, `recorder` writes their results, `solve` gives a linear system to a session instead of a scene.
//!
//! With `loomtree run` the coordinator is part of that process and only the workers are children;
//! `loomtree-coordinator` runs the same code by itself. A third process would add no protection: workers watch the
//! coordinator's process, leave when it ends, and the last worker removes the files of the run from the machine.
//! One case is not covered: a coordinator that is killed before it has started a worker leaves a few files, which the
//! next run removes.

pub mod crew;
pub mod live;
mod open_seams;
pub mod options;
pub mod plan;
mod progress;
mod recorder;
mod recovery;
mod seams;
pub mod session;
pub mod shot;
pub mod solve;
mod stage_source;
mod stages;
mod start_from;
pub mod steering;
mod time_job;
mod time_options;
pub mod time_plan;
mod time_report;
mod time_schedule;
mod time_split;
mod time_trace;
mod watch;
mod welding;

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use thiserror::Error;

pub use crew::{Crew, CrewError, Launch};
use live::{Desk, LiveServer, Record};
pub use options::{GivenOptions, KeepStates, RunOptions, SessionOptions};
pub use plan::{PlanError, RunPlan};
use progress::Progress;
use recorder::Recorder;
pub use recorder::{RecordError, RunPlaces};
pub use session::{Session, SessionError, SessionPlace};
use shot::{Ended, News, ShotError, Told};
use stage_source::{StageSource, Steered};
use stages::{Attempt, Begin, Stage, Stages};
pub use start_from::StartFrom;
pub use steering::Steering;
pub use time_job::Scope;
pub use time_options::{PartitionRule, Recovery, SeamRule, TimeOptions};
pub use time_plan::{TimeError, TimePlan};
pub use time_split::run_split;

use crate::model::State;
use crate::os::console::note;
use crate::os::signals;
use crate::output::{Checkpoint, Status, Straightened};
use crate::scene::{Change, Edit};
use crate::step::StepStats;
use crate::transport::MachineError;

/// Error that ends a run.
#[derive(Debug, Error)]
pub enum RunError {
    /// The user can correct it before the run starts.
    #[error("{0}")]
    BadInput(String),
    /// The run failed.
    #[error("{0}")]
    Failed(String),
    /// A signal requested a stop during the setup of the workers.
    #[error("{0}")]
    Stopped(String),
}

impl From<PlanError> for RunError {
    fn from(error: PlanError) -> RunError {
        RunError::BadInput(error.to_string())
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

impl From<RecordError> for RunError {
    fn from(error: RecordError) -> RunError {
        match error {
            RecordError::BadInput(text) => RunError::BadInput(text),
            RecordError::Write(text) => RunError::Failed(text),
        }
    }
}

/// Result of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunSummary {
    /// Frames written, frame 0 included.
    pub frames: u32,
    /// Steps done in this start.
    pub steps: u32,
    /// Sub-steps of these steps.
    pub substeps: u64,
    /// Mean wall time of a step, measured by the coordinator, seconds.
    pub seconds_per_step: f64,
    /// True if the user stopped the run.
    pub stopped: bool,
}

/// Runs a plan to its end, as one segment on one session.
pub fn run(plan: RunPlan, options: &RunOptions, places: &RunPlaces, launch: &Launch) -> Result<RunSummary, RunError> {
    let steering = plan.steering.clone();
    let stages = Stages::new(plan, options)?;
    for plan in stages.levels() {
        launch.machine().check_transfers(plan.partition.ranks(), plan.message_values())?;
    }
    let first = stages.first();
    let mut stage = Arc::clone(first);
    let mut mesh_of = |checkpoint: &Checkpoint| {
        stage = stages.locate(checkpoint)?;
        Some(stage.mesh)
    };
    let (mut recorder, resumed) = Recorder::open_stages(&first.plan, first.fingerprint, options, places, &mut mesh_of)?;
    // The scene stays as it is at time 0, because the order of vertices and the pins come from it.
    let (start, first_step) = match &resumed {
        Some(Checkpoint { state, step, .. }) => (Some(state), *step as u32),
        None => (None, 0),
    };
    let plan = Arc::clone(&stage.plan);
    let settings = &plan.scene.settings;
    let last_step = settings.frames * settings.steps_per_frame;
    if let Some(from) = resumed.as_ref().filter(|_| first_step >= last_step) {
        note(format_args!(
            "nothing is left to do: the newest checkpoint is of frame {}, and the run has {} frames (--frames)",
            from.frame, settings.frames
        ));
        recorder.leave_trace();
    }
    let wants_state = |step: u32| {
        let keep = options.keep_states.is_some_and(|keep| keep.wants(step, settings.steps_per_frame));
        step.is_multiple_of(settings.steps_per_frame) || keep
    };
    let begin = stages.begin(&stage, first_step, last_step, start.cloned()).map_err(RunError::Failed)?;
    let (steered, server) = match steering {
        Some(steering) => steer(*steering, &recorder, &begin, !Arc::ptr_eq(&begin.0, &stage), &places.out)?,
        None => (None, None),
    };
    let desk = steered.as_ref().and_then(|steered| steered.desk.clone());
    let record = steered.as_ref().map(|steered| Arc::clone(&steered.record));
    let source = StageSource::new(&stages, begin, last_step, options.trace_steps, Arc::new(wants_state), steered);
    let mut listener = Listener {
        stages: &stages,
        stage: Arc::clone(&stage),
        options,
        recorder,
        record,
        progress: None,
        is_new: resumed.is_none(),
        first_step,
        last_step,
        done: StepStats { step: first_step, ..StepStats::default() },
        substeps: 0,
        seconds: 0.0,
        sewing: Vec::new(),
    };
    let session = options.session();
    let played = shot::play_from(&source, 1, &session, launch, &mut |told| listener.hear(told));
    // The socket goes before anything else is said.
    drop(server);
    if played.is_ok() {
        listener.tell_open_seams().map_err(RunError::Failed)?;
    }
    let plan = Arc::clone(&listener.stage.plan);
    let Listener { mut recorder, progress, done: StepStats { step: done, .. }, substeps, seconds, .. } = listener;
    let played = played.and_then(|ended| recorder.keep_last_state().map(|_| ended).map_err(ShotError::Listener));
    let is_asked = desk.is_some_and(|desk| desk.is_stopped()) || signals::stop_requested().is_some();
    let error = match played {
        Ok(_) if let Some(why) = source.fault() => RunError::Failed(why),
        Ok(ended) => {
            if let Some(progress) = &progress {
                progress.end();
            }
            // A run that stands still is stopped between two steps.
            let stopped = ended == Ended::Stopped || (is_asked && done < last_step);
            let steps = done - first_step;
            recorder.finish(if stopped { Status::Stopped } else { Status::Done })?;
            let frames = done / settings.steps_per_frame + 1;
            let seconds_per_step = seconds / steps.max(1) as f64;
            return Ok(RunSummary { frames, steps, substeps, seconds_per_step, stopped });
        }
        Err(ShotError::Session { error: SessionError::Crew(stopped @ CrewError::Stopped(_)), .. }) => {
            RunError::Stopped(stopped.to_string())
        }
        Err(ShotError::Session { error, .. }) => {
            let text = error.sentence(&|vertex| plan.scene.vertex_name(vertex));
            if error.is_bad_input() { RunError::BadInput(text) } else { RunError::Failed(text) }
        }
        Err(ShotError::Listener(error)) => RunError::Failed(error.to_string()),
    };
    let text = error.to_string();
    let kept = recorder.keep_last_state();
    let status = match &error {
        RunError::Stopped(_) => Status::Stopped,
        _ => Status::Failed(text.clone()),
    };
    let _ = recorder.finish(status);
    let kept = kept.map_err(|error| RunError::Failed(format!("{text}; and {error}")))?;
    Err(match error {
        RunError::BadInput(text) => RunError::BadInput(text),
        RunError::Failed(text) => RunError::Failed(format!("{text}{kept}")),
        RunError::Stopped(text) => RunError::Stopped(format!("{text}{kept}")),
    })
}

/// Records the events of a run.
struct Listener<'a> {
    stages: &'a Stages,
    /// The stage that is under way.
    stage: Arc<Stage>,
    options: &'a RunOptions,
    recorder: Recorder,
    /// Of a run that is changed while it goes on.
    record: Option<Arc<Mutex<Record>>>,
    progress: Option<Progress>,
    /// The run starts from the scene's start state, which is frame 0.
    is_new: bool,
    first_step: u32,
    last_step: u32,
    /// Of rank 0 in the last step done.
    done: StepStats,
    /// Of all steps done.
    substeps: u64,
    seconds: f64,
    /// The last two frames' states with their steps, the newest last; empty without seams and once they are sewn.
    sewing: Vec<(u32, State)>,
}

impl Listener<'_> {
    fn hear(&mut self, told: Told) -> Result<(), RecordError> {
        let Some(stage) = self.stages.of_segment(told.segment) else { return Ok(()) };
        let plan = &*stage.plan;
        let settings = &plan.scene.settings;
        match told.news {
            News::Ready(ready) if self.progress.is_none() => {
                // The first states and the report are those of the stage that the run had come to.
                self.recorder.begin(&self.stage.plan, told.session, &ready)?;
                if let Some(record) = &self.record {
                    let record = record.lock().unwrap_or_else(PoisonError::into_inner);
                    record.begin().map_err(RecordError::Write)?;
                }
                if self.is_new {
                    let panels = Arc::clone(&self.stages.first().plan);
                    self.state(&panels, 0, State::start_of(&panels.scene))?;
                }
                self.progress = Some(Progress::new(settings.frames, self.first_step / settings.steps_per_frame));
                self.begin_stage(stage)?;
            }
            News::Ready(_) => self.begin_stage(stage)?,
            News::Step(done) => {
                (self.done, self.seconds) = (done.ranks[0], self.seconds + done.wall_s);
                self.substeps += u64::from(self.done.substeps);
                self.recorder.step(plan, told.session, &done)?;
            }
            News::Ended => {}
            News::State { step, state } => {
                let hash = self.state(plan, step, state)?;
                let (frame, every) = (step / settings.steps_per_frame, self.options.checkpoint_every);
                if let (Some(hash), Some(progress)) = (hash, &self.progress) {
                    if every > 0 && frame.is_multiple_of(every) && step != self.last_step {
                        self.recorder.keep_last_state()?;
                    }
                    let seconds_per_step = self.seconds / (step - self.first_step) as f64;
                    progress.frame(frame, step, &self.done, &hash, seconds_per_step);
                }
            }
        }
        Ok(())
    }

    fn state(&mut self, plan: &RunPlan, step: u32, state: State) -> Result<Option<String>, RecordError> {
        let gap = self.stage.gap(&state);
        if gap.is_some() {
            let known = self.sewing.len();
            self.sewing.drain(..known.saturating_sub(1));
            self.sewing.push((step, state.clone()));
        }
        self.recorder.state_with(plan, step, state, gap)
    }

    /// A segment has begun, perhaps that of a later stage.
    fn begin_stage(&mut self, stage: Arc<Stage>) -> Result<(), RecordError> {
        if stage.number == self.stage.number {
            return Ok(());
        }
        let (plan, step) = (Arc::clone(&stage.plan), self.done.step);
        self.recorder.scene_is(stage.fingerprint);
        let before = std::mem::replace(&mut self.stage, stage);
        if self.stage.mesh == before.mesh {
            return Ok(());
        }
        self.sewing.clear();
        let straightened = self.stage.straightened;
        self.recorder.begin_mesh(&plan, self.stage.mesh, step, straightened)?;
        let (mesh, origin) = (&plan.scene.mesh, self.stage.origin);
        note(format_args!(
            "{origin} after step {step}: {} vertices, {} triangles",
            mesh.positions.len(),
            mesh.triangles.len()
        ));
        if let Some(Straightened { vertices, farthest_m }) = straightened {
            let farthest_mm = 1e3 * farthest_m;
            note(format_args!(
                "{vertices} vertices of tangled corners were straightened while welding, by up to {farthest_mm:.1} mm"
            ));
        }
        Ok(())
    }

    /// Says which seams are open at the end of the run, and why.
    fn tell_open_seams(&mut self) -> Result<(), String> {
        let Some((step, state)) = self.sewing.last() else { return Ok(()) };
        let Some(gap) = self.stage.gap(state) else { return Ok(()) };
        let widest_mm = 1e3 * gap.widest_m;
        let before = self.sewing.first().filter(|(before, _)| before < step);
        let open = self.stage.open_seams(before.map(|(step, state)| (*step, state)), state, *step)?;
        if open.is_empty() {
            let why = match self.stages.attempt(&self.stage, state, *step)? {
                Attempt::Blocked => "the way of their vertices to each other is not free",
                Attempt::Sewn(..) | Attempt::Open => "the run has ended: one frame more sews them",
            };
            note(format_args!("the seams are closed to {widest_mm:.2} mm, but not sewn: {why}"));
        } else {
            let clauses: Vec<String> = open.iter().map(ToString::to_string).collect();
            note(format_args!(
                "the seams are not sewn: {} places are open by more than weld_m, the widest by {widest_mm:.2} mm: {}",
                gap.open,
                clauses.join("; ")
            ));
        }
        self.recorder.open_seams(open);
        Ok(())
    }
}

/// What a run needs that is changed while it goes on, and its socket if clients may do that. It goes on at `begin`,
/// where its seams may just have been welded.
fn steer(
    steering: Steering,
    recorder: &Recorder,
    begin: &Begin,
    is_welded: bool,
    run: &Path,
) -> Result<(Option<Steered>, Option<LiveServer>), RunError> {
    let Steering { of_scene, recorded, live, paused, .. } = steering;
    let (stage, first_step, _) = begin;
    // A run that nobody could change before has not noted its new mesh.
    let is_unknown = stage.mesh > 0 && !recorded.iter().any(|change| change.edit == Edit::Welded);
    let mut record = Record::new(recorder.changes(), &of_scene, recorded, *first_step);
    if is_welded || is_unknown {
        record.add(Change::welded(*first_step)).map_err(RunError::Failed)?;
    }
    let desk = live.then(|| Arc::new(Desk::new(*first_step, paused)));
    let server = match &desk {
        Some(desk) => {
            let started = LiveServer::start(run, Arc::clone(desk));
            Some(started.map_err(|error| RunError::Failed(error.to_string()))?)
        }
        None => None,
    };
    Ok((Some(Steered { record: Arc::new(Mutex::new(record)), desk }), server))
}
