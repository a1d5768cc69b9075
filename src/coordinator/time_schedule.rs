//! Hands the jobs of a split shot to sessions, with their start states and ways.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::options::KeepStates;
use super::plan::RunPlan;
use super::recovery::{Iterated, WarmUp};
use super::seams::{HandOver, kept_state};
use super::shot::{Segment, Source};
use super::time_job::{Job, Scope, Stage, Table};
use super::time_plan::TimePlan;
use crate::os::signals;
use crate::output::Checkpoint;

/// Everything that sessions and listener share.
pub(super) struct Schedule<'a> {
    pub plan: &'a TimePlan,
    pub run: &'a Path,
    pub table: Mutex<Table>,
    pub changed: Condvar,
    /// Why a job could not be started.
    pub fault: Mutex<Option<String>>,
    /// States that the run is to keep.
    pub keep: Option<KeepStates>,
    /// First steps of the shot and of its coarse run whose events are recorded.
    pub trace_steps: u32,
    pub scope: Scope,
}

impl<'a> Schedule<'a> {
    pub(super) fn table(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The level that a job simulates.
    pub(super) fn level(&self, job: Job) -> &'a RunPlan {
        if job == Job::Coarse { &self.plan.coarse } else { &self.plan.fine }
    }

    /// First steps of a job whose events are recorded: one job of each level shows what its steps do.
    pub(super) fn trace_steps(&self, job: Job) -> u32 {
        if matches!(job, Job::Coarse | Job::Segment(0)) { self.trace_steps } else { 0 }
    }

    /// Last step of a job, in steps of its own level.
    fn last_step(&self, job: Job, cuts: &[u32]) -> u32 {
        let end = |j: usize| cuts.get(j + 1).copied().unwrap_or(self.plan.steps());
        match job {
            Job::Coarse => self.plan.steps() / self.plan.step_ratio,
            Job::Segment(j) | Job::Seam(j) | Job::Again { segment: j, .. } => end(j),
        }
    }

    /// Input of a job; none if it need not be made. Reading and refining its start state is done by the session that
    /// takes it.
    fn segment(&self, job: Job) -> Result<Option<Segment<'a>>, String> {
        let (plan, run) = (self.plan, self.run);
        let cuts = self.table().cuts.clone();
        let last_step = self.last_step(job, &cuts);
        let resumed = newest(&job.folder(run), job);
        let tells_start = resumed.is_none();
        let trace_steps = self.trace_steps(job);
        let mut segment = Segment { tells_start, trace_steps, ..Segment::plain(self.level(job), last_step) };
        if job == Job::Coarse {
            segment.wants_state = Arc::new(|_| true);
        }
        if let Some(Checkpoint { step, state, .. }) = resumed {
            (segment.first_step, segment.start) = (step as u32, Some(Arc::new(state)));
        }
        match job {
            Job::Coarse => {}
            Job::Segment(j) => {
                let start = cuts[j];
                let recovery = plan.recovery_of(start);
                if segment.start.is_none() && j > 0 {
                    let first = start - recovery;
                    segment.start = Some(Arc::new(match &plan.options.start_states {
                        Some(run) => kept_state(run, first)?,
                        None => {
                            let coarse = kept_state(&Job::Coarse.folder(run), first / plan.step_ratio)?;
                            plan.upsampled(&coarse, first)?
                        }
                    }));
                    segment.first_step = first;
                }
                if tells_start && plan.iterates(start) {
                    segment.preparation = Some(Arc::new(Iterated::new(plan, run, start)?));
                }
                if j > 0 && recovery > 0 {
                    segment.way = Some(Arc::new(WarmUp::new(plan, run, start)));
                }
                segment.wants_state = self.wanted_of_segment(start, last_step);
            }
            Job::Again { sweep, segment: j } => {
                let [earlier, own] = self.table().before_sweep(sweep, j);
                let start = cuts[j];
                let end = kept_state(&earlier.folder(run), start)?;
                if end == kept_state(&own.folder(run), start)? {
                    return Ok(None);
                }
                if segment.start.is_none() {
                    (segment.first_step, segment.start) = (start, Some(Arc::new(end)));
                }
                segment.wants_state = self.wanted_of_segment(start, last_step);
            }
            Job::Seam(j) => {
                let earlier = self.table().end_of(j - 1);
                let end = kept_state(&earlier.folder(run), cuts[j])?;
                let over = HandOver::new(plan, run, j, cuts[j], last_step, &end)?;
                segment.first_step = cuts[j];
                segment.start = Some(Arc::new(end));
                segment.way = Some(Arc::new(over));
                segment.wants_state = Arc::new(|_| true);
            }
        }
        Ok(Some(segment))
    }

    /// The states of a segment that are needed: frames, those near its seams, those that the user asks for.
    fn wanted_of_segment(&self, start: u32, last_step: u32) -> Arc<dyn Fn(u32) -> bool + Send + Sync> {
        let kept = start + self.plan.handover_kept();
        let (per_frame, keep) = (self.plan.fine.scene.settings.steps_per_frame, self.keep);
        Arc::new(move |step| {
            let near_a_seam = (start..=kept).contains(&step) || step + 2 >= last_step;
            let asked = keep.is_some_and(|keep| keep.wants(step, per_frame));
            step >= start && (near_a_seam || asked || step.is_multiple_of(per_frame))
        })
    }
}

impl<'a> Source<'a> for Schedule<'a> {
    fn next(&self, _session: usize, halt: &AtomicBool) -> Option<(usize, Segment<'a>)> {
        let mut table = self.table();
        loop {
            let stop = halt.load(Ordering::Relaxed) || signals::stop_requested().is_some();
            if stop || self.scope.is_complete(&table) {
                return None;
            }
            let Some(job) = table.ready(self.scope) else {
                // Others end their jobs, and the listener tells; a stop is noticed after a moment.
                let waited = self.changed.wait_timeout(table, Duration::from_millis(100));
                table = waited.unwrap_or_else(PoisonError::into_inner).0;
                continue;
            };
            table.stages.insert(job, Stage::UnderWay);
            drop(table);
            match self.segment(job) {
                Ok(Some(segment)) => return Some((job.number(), segment)),
                Ok(None) => {
                    table = self.table();
                    table.leave(job);
                    self.changed.notify_all();
                }
                Err(why) => {
                    self.fault.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(why);
                    halt.store(true, Ordering::Relaxed);
                    return None;
                }
            }
        }
    }
}

/// The state that a job was interrupted at; seams start anew.
pub(super) fn newest(folder: &Path, job: Job) -> Option<Checkpoint> {
    if matches!(job, Job::Seam(_)) {
        return None;
    }
    crate::output::checkpoint::latest(&folder.join("checkpoint")).found.map(|(_, found)| found)
}
