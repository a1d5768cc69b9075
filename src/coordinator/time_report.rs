//! The report of a split shot, and the places of its final files.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use super::options::{KeepStates, RunOptions};
use super::recorder::{RecordError, report_header};
use super::seams::{distances_m, inner_jumps_m, kept_state, medians, second_differences_m};
use super::time_job::Job;
use super::time_plan::TimePlan;
use super::time_trace::{self, Span};
use crate::math::Vec3;
use crate::model::State;
use crate::output::{
    Existing, FrameFormat, FrameSource, FrameWriter, Report, RunDirectory, SeamRecord, SegmentRecord, Status,
};
use crate::protocol::WorkerReady;

fn write_error(error: impl std::fmt::Display) -> RecordError {
    RecordError::Write(error.to_string())
}

/// What a session did for a job.
#[derive(Clone, Copy, Debug, Default)]
struct Made {
    session: usize,
    busy_s: f64,
}

/// Report and final files of a split shot.
pub(super) struct SplitReport {
    path: PathBuf,
    report: Report,
    made: BTreeMap<Job, Made>,
    spans: Vec<Span>,
    settled: BTreeSet<usize>,
    seams: BTreeMap<usize, SeamRecord>,
    begun: Instant,
}

impl SplitReport {
    /// A report for `plan`; after a resumption with what is there.
    pub(super) fn open(
        plan: &TimePlan,
        options: &RunOptions,
        directory: &RunDirectory,
        existing: Existing,
    ) -> Result<SplitReport, RecordError> {
        let path = directory.report();
        let header = report_header(&plan.fine, options, &[]);
        let mut report = Report { header, ..Report::default() };
        if existing == Existing::Resume
            && let Ok(old) = Report::load(&path)
        {
            report.header.started_unix_s = old.header.started_unix_s;
            report.header.devices = old.header.devices;
            report.segments = old.segments;
        }
        report.save(&path).map_err(write_error)?;
        let (made, settled, seams) = (BTreeMap::new(), BTreeSet::new(), BTreeMap::new());
        Ok(SplitReport { path, report, made, spans: Vec::new(), settled, seams, begun: Instant::now() })
    }

    /// The workers of a job.
    pub(super) fn ready(&mut self, job: Job, ready: &[WorkerReady]) {
        if job == Job::Coarse {
            return;
        }
        let header = &mut self.report.header;
        header.devices = ready.iter().map(|worker| worker.device.clone()).collect();
        header.executor = ready.first().map_or_else(String::new, |worker| worker.executor.clone());
        header.preconditioner = ready.first().map_or_else(String::new, |worker| worker.preconditioner.name().into());
    }

    /// A job that began at `begun` has ended.
    pub(super) fn job(&mut self, job: Job, session: usize, busy_s: f64, begun: Instant, steps: u32) {
        let made = self.made.entry(job).or_default();
        *made = Made { session, busy_s: made.busy_s + busy_s };
        let [begun_s, ended_s] = [begun.duration_since(self.begun), self.begun.elapsed()].map(|t| t.as_secs_f64());
        self.spans.push(Span { job, session, begun_s, ended_s, steps });
    }

    /// Whether the hand-over in `folder` has met its segment.
    pub(super) fn has_met(folder: &Path) -> bool {
        Report::load(&folder.join("report.json")).is_ok_and(|report| arrival(&report).is_some())
    }

    /// Segment `j` is final; `all`: the jobs that have made the segments. Its frames move to those of the run, and the
    /// states to be kept; its steps and frames go into the report.
    pub(super) fn settle(
        &mut self,
        plan: &TimePlan,
        directory: &RunDirectory,
        cuts: &[u32],
        all: &[Job],
        j: usize,
        keep: Option<KeepStates>,
    ) -> Result<(), RecordError> {
        if !self.settled.insert(j) {
            return Ok(());
        }
        let run = directory.path();
        let (start, end) = (cuts[j], cuts.get(j + 1).copied().unwrap_or(plan.steps()));
        let load = |job: Job| Report::load(&job.folder(run).join("report.json")).map_err(write_error);
        let own = load(all[j])?;
        let seam = if j > 0 && Job::Seam(j).folder(run).is_dir() { Some(load(Job::Seam(j))?) } else { None };
        // Steps up to this one are those of the hand-over.
        let joined = seam.as_ref().map_or(start, |seam| arrival(seam).unwrap_or(end));
        let made_by = |step: u32| if step > start && step <= joined { Job::Seam(j) } else { all[j] };
        let report_of = |step: u32| match (made_by(step), &seam) {
            (Job::Seam(_), Some(seam)) => seam,
            _ => &own,
        };
        let per_frame = plan.fine.scene.settings.steps_per_frame;
        let recorded = RunDirectory::trace_in(&Job::Segment(0).folder(run));
        if j == 0 && recorded.is_file() {
            fs::copy(&recorded, directory.trace_of_steps()).map_err(write_error)?;
        }
        let first_frame = if j == 0 { 0 } else { start / per_frame + 1 };
        for frame in first_frame..=end / per_frame {
            let step = frame * per_frame;
            move_frame(&made_by(step).folder(run).join("frames"), &directory.frames(), frame)?;
            self.report.frames.extend(report_of(step).frames.iter().find(|record| record.frame == frame).cloned());
        }
        for step in start + 1..=end {
            self.report
                .steps
                .extend(report_of(step).steps.iter().find(|record| record.step == u64::from(step)).cloned());
        }
        self.report.frames.sort_by_key(|record| record.frame);
        self.report.steps.sort_by_key(|record| record.step);
        if let Some(keep) = keep {
            fs::create_dir_all(directory.states()).map_err(write_error)?;
            let first = if j == 0 { 0 } else { start + 1 };
            for step in (first..=end).filter(|&step| keep.wants(step, per_frame)) {
                let name = format!("step_{step:08}.ltc");
                let from = made_by(step).folder(run).join("states").join(&name);
                fs::copy(&from, directory.states().join(&name)).map_err(write_error)?;
            }
        }
        if j > 0 {
            let record = self.seam(plan, run, all, j, start, joined, seam.as_ref()).map_err(RecordError::Write)?;
            self.seams.insert(j, record);
        }
        self.report.save(&self.path).map_err(write_error)
    }

    /// The figures of the seam before segment `j`.
    fn seam(
        &self,
        plan: &TimePlan,
        run: &Path,
        all: &[Job],
        j: usize,
        cut: u32,
        joined: u32,
        seam: Option<&Report>,
    ) -> Result<SeamRecord, String> {
        let (own, earlier) = (all[j].folder(run), all[j - 1].folder(run));
        let over = Job::Seam(j).folder(run);
        // A hand-over that went on to the end of the earlier segment has made its last states.
        let last_of_earlier = Job::Seam(j - 1).folder(run);
        let replaced = j > 1 && last_of_earlier.join(format!("states/step_{cut:08}.ltc")).is_file();
        let earlier = if replaced { last_of_earlier } else { earlier };
        let positions = |step: u32| -> Result<Vec<Vec3>, String> {
            let folder = if step <= cut {
                &earlier
            } else if step <= joined {
                &over
            } else {
                &own
            };
            kept_state(folder, step).map(|state| state.positions)
        };
        let end: State = kept_state(&earlier, cut)?;
        let start = kept_state(&own, cut)?;
        let met = seam.is_some_and(|seam| arrival(seam).is_some());
        let last = if met { joined + 1 } else { cut + 1 };
        let [mut jump_max_m, mut jump_rms_m] = [0.0_f64; 2];
        let final_step = plan.steps();
        for step in cut..=last.min(final_step.saturating_sub(1)) {
            if let (Ok(a), Ok(b), Ok(c)) = (positions(step - 1), positions(step), positions(step + 1)) {
                let [max_m, rms_m] = second_differences_m(&a, &b, &c);
                (jump_max_m, jump_rms_m) = (jump_max_m.max(max_m), jump_rms_m.max(rms_m));
            }
        }
        let inner = inner_jumps_m(&own, cut, plan.handover_kept());
        let [inner_median_max_m, inner_median_rms_m] = medians(&inner).unwrap_or_default();
        // Those of the segment itself, over the same stretch of time.
        let same = &inner[..inner.len().min((last - cut) as usize + 1)];
        let [inner_largest_max_m, inner_largest_rms_m] =
            [0, 1].map(|which| same.iter().map(|pair| pair[which]).fold(0.0, f64::max));
        let [distance_max_m, distance_rms_m] = distances_m(&end.positions, &start.positions);
        Ok(SeamRecord {
            step: cut,
            distance_max_m,
            distance_rms_m,
            met,
            jump_max_m,
            jump_rms_m,
            inner_median_max_m,
            inner_median_rms_m,
            inner_largest_max_m,
            inner_largest_rms_m,
        })
    }

    /// Writes the report for the last time, and what needs all frames. Returns the number of frames.
    pub(super) fn end(
        mut self,
        plan: &TimePlan,
        directory: &RunDirectory,
        cuts: &[u32],
        options: &RunOptions,
        status: Status,
    ) -> Result<u32, RecordError> {
        let run = directory.path();
        let done = status == Status::Done;
        let wall_s = self.begun.elapsed().as_secs_f64();
        let coarse = Report::load(&Job::Coarse.folder(run).join("report.json")).unwrap_or_default();
        let busy_of = |session: usize| {
            self.made.values().filter(|made| made.session == session).map(|made| made.busy_s).sum::<f64>()
        };
        let records = (0..cuts.len()).filter(|j| self.settled.contains(j)).map(|j| {
            let (first_step, last_step) = (cuts[j], cuts.get(j + 1).copied().unwrap_or(plan.steps()));
            let made = |job: Job| self.made.get(&job).copied();
            let (Some(own), seam) = (made(Job::Segment(j)), made(Job::Seam(j))) else {
                // Made by an earlier start.
                let old = self.report.segments.iter().find(|record| record.segment == j);
                return old.cloned().unwrap_or(SegmentRecord {
                    segment: j,
                    first_step,
                    last_step,
                    ..Default::default()
                });
            };
            let later = self.made.iter().filter(|(job, made)| made.session == own.session && **job > Job::Segment(j));
            let is_last_of_session = later.filter(|(job, _)| matches!(job, Job::Segment(_))).count() == 0;
            let [first, last] = [first_step, last_step].map(|step| u64::from(step / plan.step_ratio));
            let stretch = coarse.steps.iter().filter(|record| record.step > first && record.step <= last);
            let coarse_s: f64 = stretch.map(|record| record.stage_seconds.total).sum();
            let busy_s = own.busy_s + seam.map_or(0.0, |made| made.busy_s);
            let handover = Report::load(&Job::Seam(j).folder(run).join("report.json"));
            SegmentRecord {
                segment: j,
                first_step,
                last_step,
                session: own.session,
                recovery_steps: if j > 0 { plan.recovery_most().min(first_step) } else { 0 },
                handover_steps: handover.map_or(0, |report| report.steps.len() as u32),
                busy_s,
                idle_s: if is_last_of_session { (wall_s - busy_of(own.session)).max(0.0) } else { 0.0 },
                k: if coarse_s > 0.0 { own.busy_s / coarse_s } else { 0.0 },
            }
        });
        self.report.segments = records.collect();
        self.report.seams = self.seams.values().cloned().collect();
        let frames = self.report.frames.len() as u32;
        if done && options.formats.0.contains(&FrameFormat::Pc2) {
            point_cache(plan, directory, options)?;
        }
        if options.trace_steps > 0 {
            time_trace::write(&directory.trace(), &self.spans).map_err(write_error)?;
        }
        self.report.header.status = status;
        self.report.header.ended();
        self.report.save(&self.path).map_err(write_error)?;
        if done && options.keep_states.is_none() {
            // Everything in them is in frames/ now, or was an intermediate state.
            let _ = fs::remove_dir_all(run.join("segments"));
            for folder in ["states", "segments"] {
                let _ = fs::remove_dir_all(Job::Coarse.folder(run).join(folder));
            }
        }
        Ok(frames)
    }
}

/// Step at which a hand-over has arrived.
fn arrival(seam: &Report) -> Option<u32> {
    seam.steps.iter().find(|record| record.arrived == Some(true)).map(|record| record.step as u32)
}

/// Moves the files of a frame, and of the obstacles at it. Those that were moved before are there already.
fn move_frame(from: &Path, to: &Path, frame: u32) -> Result<(), RecordError> {
    for kind in ["frame", "obstacle"] {
        for extension in ["ply", "obj"] {
            let name = format!("{kind}_{frame:06}.{extension}");
            let file = from.join(&name);
            if file.is_file() {
                fs::rename(&file, to.join(&name)).map_err(write_error)?;
            }
        }
    }
    Ok(())
}

/// Writes the point cache from the frames; without other formats they are removed after that.
fn point_cache(plan: &TimePlan, directory: &RunDirectory, options: &RunOptions) -> Result<(), RecordError> {
    let scene = &plan.fine.scene;
    let mut writer =
        FrameWriter::with_parts(directory, &[FrameFormat::Pc2], &scene.mesh, &scene.parts, scene.origin_m, 0)
            .map_err(write_error)?;
    let source = FrameSource::open(directory).map_err(write_error)?.about(scene.origin_m);
    for frame in 0..=scene.settings.frames {
        let mesh = source.read(frame).map_err(write_error)?;
        writer.write(frame, &scene.mesh, &mesh.positions).map_err(write_error)?;
    }
    if options.formats.0 == [FrameFormat::Pc2] {
        for frame in 0..=scene.settings.frames {
            let _ = fs::remove_file(directory.frames().join(format!("frame_{frame:06}.ply")));
        }
    }
    Ok(())
}
