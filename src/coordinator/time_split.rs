//! A shot that is split in time [Liang and Lin 2018], on sessions side by side: the coarse run, the segments from its
//! states, the seams between them.
//!
//! Every job writes a run directory of its own: `preview/` (the coarse run), `segments/NNN/`, `segments/NNN/seam/` and
//! `segments/NNN/sweep_KKK/`.
//! When the frames of a segment are final they move to `frames/`, in any order, and the report gets its steps. What is
//! done is never made again, so a resumed run makes what is missing.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Instant;

use super::options::{KeepStates, RunOptions};
use super::progress::times;
use super::recorder::{RecordError, Recorder, RunPlaces};
use super::seams::kept_state;
use super::session::{SessionError, StepDone};
use super::shot::{self, Ended, News, ShotError, Told};
use super::time_job::{Job, Scope, Stage, Table};
use super::time_options::{PartitionRule, TimeOptions};
use super::time_plan::{Counts, TimePlan, options_of_coarse};
use super::time_report::SplitReport;
use super::time_schedule::{Schedule, newest};
use super::{CrewError, Launch, RunError, RunSummary};
use crate::model::State;
use crate::os::console::note;
use crate::output::{Existing, FormatList, FrameFormat, Report, RunDirectory, RunManifest, Status};

fn is_done(folder: &Path) -> bool {
    let report = RunDirectory::open(folder).ok().and_then(|directory| Report::load(&directory.report()).ok());
    report.is_some_and(|report| report.header.status == Status::Done)
}

/// Formats of the frames of a job. Frames of a point cache follow each other, so it is written when they are all there.
fn job_formats(options: &RunOptions) -> Vec<FrameFormat> {
    let mut formats = options.formats.0.clone();
    formats.retain(|format| *format != FrameFormat::Pc2);
    if formats.is_empty() {
        formats.push(FrameFormat::Ply);
    }
    formats
}

/// The work under way on a job.
struct Under {
    recorder: Recorder,
    session: usize,
    begun: Instant,
    busy_s: f64,
    steps: u32,
    last: Option<StepDone>,
}

/// Hears of all jobs and writes their files.
struct Listener<'a, 'b> {
    schedule: &'b Schedule<'a>,
    options: RunOptions,
    /// The scene file that the jobs' recipes name.
    scene: PathBuf,
    under_way: BTreeMap<usize, Under>,
    /// None while others may write to the run directory: a segment that is made by itself.
    whole: Option<Whole>,
    steps: u32,
    substeps: u64,
    seconds: f64,
}

/// The files of the run itself.
struct Whole {
    report: SplitReport,
    manifest: RunManifest,
    directory: RunDirectory,
}

impl<'a> Listener<'a, '_> {
    fn hear(&mut self, told: Told) -> Result<(), RecordError> {
        let job = Job::of_number(told.segment);
        let plan = self.schedule.plan;
        let level = self.schedule.level(job);
        match told.news {
            News::Ready(ready) => {
                let mut under = self.open(job, told.session)?;
                if let Some(whole) = &mut self.whole {
                    whole.report.ready(job, &ready);
                }
                let is_new = under.recorder.is_new();
                under.recorder.begin(level, 0, &ready)?;
                if is_new && matches!(job, Job::Coarse | Job::Segment(0)) {
                    under.recorder.state(level, 0, State::start_of(&level.scene))?;
                }
                self.under_way.insert(told.segment, under);
            }
            News::Step(done) => {
                let Some(under) = self.under_way.get_mut(&told.segment) else { return Ok(()) };
                under.recorder.step(level, 0, &done)?;
                (under.busy_s, under.steps) = (under.busy_s + done.wall_s, under.steps + 1);
                (self.steps, self.seconds) = (self.steps + 1, self.seconds + done.wall_s);
                self.substeps += u64::from(done.ranks[0].substeps);
                under.last = Some(done);
            }
            News::State { step, state } => {
                let Some(under) = self.under_way.get_mut(&told.segment) else { return Ok(()) };
                let hash = under.recorder.state(level, step, state)?;
                if job == Job::Coarse {
                    self.schedule.table().coarse_step = step * plan.step_ratio;
                    self.schedule.changed.notify_all();
                }
                let settings = &level.scene.settings;
                let (frame, every) = (step / settings.steps_per_frame, self.options.checkpoint_every);
                if let (Some(hash), Some(done)) = (hash, &under.last) {
                    if every > 0 && frame.is_multiple_of(every) {
                        under.recorder.keep_last_state()?;
                    }
                    // How long a seam takes is not known before it has closed.
                    let last_step = settings.frames * settings.steps_per_frame;
                    let end = match job {
                        Job::Coarse => last_step,
                        Job::Segment(j) => self.schedule.table().cuts.get(j + 1).copied().unwrap_or(last_step),
                        Job::Seam(_) | Job::Again { .. } => step,
                    };
                    let times = times(under.begun.elapsed(), under.steps, end.saturating_sub(step));
                    let (stats, each_ms) = (&done.ranks[0], under.busy_s / f64::from(under.steps) * 1e3);
                    note(format_args!(
                        "{}: frame {frame}/{} (step {step}): {} iterations, {} contacts, {each_ms:.1} ms/step, \
                         {times}, state {hash}",
                        job.name(),
                        settings.frames,
                        stats.iterations,
                        stats.contacts
                    ));
                }
            }
            News::Ended => self.ended(job)?,
        }
        Ok(())
    }

    /// The run directory of a job, and its recorder.
    fn open(&self, job: Job, session: usize) -> Result<Under, RecordError> {
        let plan = self.schedule.plan;
        let out = job.folder(self.schedule.run);
        let existing = match newest(&out, job) {
            Some(_) => Existing::Resume,
            None => Existing::Overwrite,
        };
        let formats = job_formats(&self.options);
        let options = RunOptions {
            keep_states: Some(KeepStates::Every(std::num::NonZeroU32::MIN)),
            formats: FormatList(formats, Vec::new()),
            trace_steps: self.schedule.trace_steps(job),
            ..self.options.clone()
        };
        let level = self.schedule.level(job);
        let places = RunPlaces { scene: self.scene.clone(), out, existing };
        let (mut recorder, _) = Recorder::open(level, &options, &places)?;
        let cuts = self.schedule.table().cuts.clone();
        if let Job::Segment(j) | Job::Seam(j) | Job::Again { segment: j, .. } = job
            && j > 0
        {
            recorder.start_at(cuts[j], plan.fine.scene.settings.steps_per_frame);
        }
        Ok(Under { recorder, session, begun: Instant::now(), busy_s: 0.0, steps: 0, last: None })
    }

    /// A job has come to its end: what depends on it may begin, and what is final moves to its place.
    fn ended(&mut self, job: Job) -> Result<(), RecordError> {
        let Some(under) = self.under_way.remove(&job.number()) else { return Ok(()) };
        let arrived = under.last.as_ref().and_then(|done| done.ranks[0].arrived) == Some(true);
        let (took_s, busy_s) = (under.begun.elapsed().as_secs_f64(), under.busy_s);
        under.recorder.finish(Status::Done)?;
        if let Some(whole) = &mut self.whole {
            whole.report.job(job, under.session, busy_s, under.begun, under.steps);
        }
        note(format_args!("{} done: {} steps in {took_s:.1} s", job.name(), under.steps));
        let plan = self.schedule.plan;
        let mut table = self.schedule.table();
        match job {
            Job::Seam(j) => table.end_seam(j, arrived),
            _ => {
                table.stages.insert(job, Stage::Done);
            }
        }
        let is_uncut = job == Job::Coarse && table.cuts.is_empty();
        drop(table);
        if is_uncut {
            self.cut(plan.cuts(&self.work_of_coarse_run()?))?;
        }
        self.settle()?;
        self.schedule.changed.notify_all();
        Ok(())
    }

    /// Counted work of all coarse steps, from the report of the coarse run.
    fn work_of_coarse_run(&self) -> Result<Vec<f64>, RecordError> {
        let rows = self.schedule.plan.coarse.partition.rows();
        let path = Job::Coarse.folder(self.schedule.run).join("report.json");
        let report = Report::load(&path).map_err(|error| RecordError::Write(error.to_string()))?;
        Ok(report.steps.iter().map(|record| Counts::of(record, rows).work()).collect())
    }

    /// Takes the cuts and writes them down.
    fn cut(&mut self, cuts: Vec<u32>) -> Result<(), RecordError> {
        note(format_args!("cut at the steps {cuts:?}"));
        self.options.time.cuts = cuts.clone();
        let fault = |error: crate::output::ManifestError| RecordError::Write(error.to_string());
        if let Some(Whole { manifest, directory, .. }) = &mut self.whole {
            manifest.set_flags(&self.options).map_err(fault)?;
            manifest.save(directory).map_err(fault)?;
        }
        self.schedule.table().take_cuts(cuts, self.schedule.plan.options.hands_over());
        Ok(())
    }

    /// Moves the frames of segments that are final to their place.
    fn settle(&mut self) -> Result<(), RecordError> {
        let (done, cuts, all) = {
            let table = self.schedule.table();
            let handed_over = self.schedule.plan.options.hands_over();
            // The figures of a seam need both of its sides.
            let is_joined = |j: usize| table.is_swept(j - 1) && (!handed_over || table.is_handed_over(j));
            let is_final = |&j: &usize| table.is_swept(j) && (j == 0 || is_joined(j));
            let all = (0..table.cuts.len()).map(|j| table.last(j)).collect::<Vec<_>>();
            ((0..table.cuts.len()).filter(is_final).collect::<Vec<_>>(), table.cuts.clone(), all)
        };
        let Some(Whole { report, directory, .. }) = &mut self.whole else { return Ok(()) };
        for j in done {
            report.settle(self.schedule.plan, directory, &cuts, &all, j, self.options.keep_states)?;
        }
        Ok(())
    }
}

/// Makes the jobs of a split shot that `scope` holds.
///
/// # Errors
/// Bad input, a failed job, or a stop during the setup.
pub fn run_split(
    plan: &TimePlan,
    options: &RunOptions,
    places: &RunPlaces,
    scope: Scope,
    launch: &Launch,
) -> Result<RunSummary, RunError> {
    let sessions = match scope {
        Scope::All | Scope::Join => sessions(plan, options, launch),
        Scope::Coarse | Scope::Segment(_) => 1,
    };
    if matches!(launch, Launch::Await) && sessions > 1 {
        let what = "workers that are started one by one make one session: leave out --sessions";
        return Err(RunError::BadInput(what.into()));
    }
    for level in [&plan.fine, &plan.coarse] {
        launch.machine().check_transfers(level.partition.ranks(), level.message_values())?;
    }
    let bad_input = |error: &dyn std::fmt::Display| RunError::BadInput(error.to_string());
    if places.existing == Existing::Resume
        && let Some(what) = unfit_to_resume(plan, options, &places.out)
    {
        return Err(RunError::BadInput(what));
    }
    let run = places.out.clone();
    let directory = match scope {
        Scope::Segment(_) => RunDirectory::open(&run),
        _ => RunDirectory::create(&run, places.existing),
    };
    let directory = directory.map_err(|error| bad_input(&error))?;
    let failed = |error: &dyn std::fmt::Display| RunError::Failed(error.to_string());
    let mut manifest = match places.existing {
        Existing::Resume => RunManifest::load(&directory).map_err(|error| bad_input(&error))?,
        _ => {
            let text = fs::read_to_string(&places.scene).map_err(|error| bad_input(&error))?;
            RunManifest::new(&places.scene, &text, options).map_err(|error| failed(&error))?
        }
    };
    if is_done(directory.path()) {
        let frames = plan.fine.scene.settings.frames + 1;
        note(format_args!("nothing is left to do: the run has all its {frames} frames"));
        return Ok(RunSummary { frames, steps: 0, substeps: 0, seconds_per_step: 0.0, stopped: false });
    }
    let mut table = known_jobs(plan, options, directory.path());
    let unknown = |j: usize| table.cuts.get(j).is_none() || !table.is_done(Job::Coarse);
    if let Scope::Segment(j) = scope
        && unknown(j)
    {
        let what = match table.cuts.len() {
            0 => format!("{}: the coarse run must be done first (--coarse-only)", run.display()),
            count => format!("--only-segment {j}: {} has the segments 0 to {}", run.display(), count - 1),
        };
        return Err(RunError::BadInput(what));
    }
    let missing: Vec<String> =
        (0..table.cuts.len()).filter(|&j| !table.is_done(Job::Segment(j))).map(|j| j.to_string()).collect();
    if scope == Scope::Join && (table.cuts.is_empty() || !missing.is_empty()) {
        let what = match table.cuts.is_empty() {
            true => "the coarse run is not done".to_string(),
            false => format!("of its segments {} are not done (--only-segment)", missing.join(", ")),
        };
        return Err(RunError::BadInput(format!("{}: {what}", run.display())));
    }
    let whole = match scope {
        Scope::Segment(_) => None,
        _ => {
            manifest.set_flags(options).map_err(|error| failed(&error))?;
            manifest.save(&directory).map_err(|error| failed(&error))?;
            Some(SplitReport::open(plan, options, &directory, places.existing).map_err(RunError::from)?)
        }
    };
    let scene = directory.path().join(&manifest.scene_file);
    if let (Some(upper), Scope::All | Scope::Coarse) = (&plan.upper, scope)
        && !table.is_done(Job::Coarse)
    {
        let out = directory.preview();
        let existing = if RunDirectory::open(&out).is_ok() { Existing::Resume } else { Existing::Overwrite };
        let formats = FormatList(job_formats(options), Vec::new());
        let own = RunOptions { formats, trace_steps: 0, ..options_of_coarse(options) };
        let recorded = RunDirectory::open(&out).ok().and_then(|there| RunManifest::load(&there).ok());
        let cuts = recorded.and_then(|there| there.flags::<RunOptions>().ok()).map(|there| there.time.cuts);
        let time = TimeOptions { cuts: cuts.unwrap_or_default(), ..own.time.clone() };
        note(format_args!("the coarse run is split in time, too"));
        let made = run_split(
            upper,
            &RunOptions { time, ..own },
            &RunPlaces { scene: scene.clone(), out, existing },
            Scope::All,
            launch,
        )?;
        if made.stopped {
            return Ok(made);
        }
        table = known_jobs(plan, options, directory.path());
    }
    let (cuts, coarse_done) = (table.cuts.clone(), table.is_done(Job::Coarse));
    let schedule = Schedule {
        plan,
        run: &run,
        table: Mutex::new(table),
        changed: Condvar::new(),
        fault: Mutex::new(None),
        keep: options.keep_states,
        trace_steps: options.trace_steps,
        scope,
    };
    let mut listener = Listener {
        schedule: &schedule,
        options: options.clone(),
        scene,
        under_way: BTreeMap::new(),
        whole: whole.map(|report| Whole { report, manifest, directory }),
        steps: 0,
        substeps: 0,
        seconds: 0.0,
    };
    if listener.whole.is_some() && (coarse_done || !cuts.is_empty()) {
        let cuts = match cuts.is_empty() {
            true => plan.cuts(&listener.work_of_coarse_run().map_err(RunError::from)?),
            false => cuts,
        };
        listener.cut(cuts).and_then(|()| listener.settle()).map_err(RunError::from)?;
    }
    let played = shot::play_from(&schedule, sessions, &options.session(), launch, &mut |told| listener.hear(told));
    finish(listener, &schedule, plan, played)
}

/// The jobs of a shot as far as they are known before it starts, with what an earlier start has done.
fn known_jobs(plan: &TimePlan, options: &RunOptions, run: &Path) -> Table {
    let mut table = Table::new(plan.options.sweeps as usize);
    let cuts = match (options.time.cuts.is_empty(), plan.options.partition) {
        (false, _) => options.time.cuts.clone(),
        (true, PartitionRule::Counted) => Vec::new(),
        (true, _) => plan.cuts(&[]),
    };
    if !cuts.is_empty() {
        table.take_cuts(cuts, plan.options.hands_over());
    }
    let jobs: Vec<Job> = table.stages.keys().copied().collect();
    for job in jobs {
        let folder = job.folder(run);
        match job {
            _ if !is_done(&folder) => {}
            // Jobs are in the order of their segments, so what is known of the seam before holds.
            Job::Seam(j) if !starts_there(&table, j, run) => {}
            Job::Seam(j) => table.end_seam(j, SplitReport::has_met(&folder)),
            _ => {
                table.stages.insert(job, Stage::Done);
            }
        }
    }
    table
}

/// Whether the hand-over to segment `j` on disk started from the end that the segment before has now.
fn starts_there(table: &Table, j: usize, run: &Path) -> bool {
    let start = kept_state(&Job::Seam(j).folder(run), table.cuts[j]);
    let end = kept_state(&table.end_of(j - 1).folder(run), table.cuts[j]);
    matches!((start, end), (Ok(start), Ok(end)) if start == end)
}

/// Why a split run cannot go on as asked: what is made already would have been made otherwise.
fn unfit_to_resume(plan: &TimePlan, options: &RunOptions, out: &Path) -> Option<String> {
    let directory = RunDirectory::open(out).ok()?;
    let recorded: RunOptions = RunManifest::load(&directory).ok()?.flags().ok()?;
    let [there, asked] = [&recorded, options].map(|all| TimeOptions { sessions: None, ..all.time.clone() });
    if there != asked {
        return Some(format!(
            "{} is split in time in another way; resume it with the options of its run.toml, of which only \
             --sessions and --workers may change",
            out.display()
        ));
    }
    let report = Report::load(&directory.report()).ok()?;
    (report.header.frames_wanted != plan.fine.scene.settings.frames).then(|| {
        let frames = report.header.frames_wanted;
        format!("{} is a shot of {frames} frames that is split in time; its --frames cannot change", out.display())
    })
}

/// Sessions side by side: those asked for, or as many as the cores allow, never more than there are segments.
fn sessions(plan: &TimePlan, options: &RunOptions, launch: &Launch) -> usize {
    let cores = launch.machine().cores() / options.workers.max(1);
    plan.options.sessions.unwrap_or(cores).clamp(1, plan.options.segments as usize)
}

fn finish(
    mut listener: Listener<'_, '_>,
    schedule: &Schedule<'_>,
    plan: &TimePlan,
    played: Result<Ended, ShotError<RecordError>>,
) -> Result<RunSummary, RunError> {
    // Sweeps that need not be made have no end that would have been heard of.
    let settled = listener.settle();
    let Listener { under_way, whole, options, steps, substeps, seconds, .. } = listener;
    let end = |status: Status, cuts: &[u32]| match whole {
        Some(Whole { report, directory, .. }) => report.end(plan, &directory, cuts, &options, status),
        None => Ok(0),
    };
    let mut kept = Ok(());
    for (_, under) in under_way {
        let mut recorder = under.recorder;
        kept = kept.and(recorder.keep_last_state().map(|_| ()));
        let _ = recorder.finish(Status::Stopped);
    }
    let fault = schedule.fault.lock().unwrap_or_else(PoisonError::into_inner).take();
    let error = match (played, fault) {
        (_, Some(why)) => RunError::Failed(why),
        (Ok(ended), None) => {
            let table = schedule.table();
            let stopped = ended == Ended::Stopped || !schedule.scope.is_complete(&table);
            let done = Scope::All.is_complete(&table);
            let cuts = table.cuts.clone();
            drop(table);
            let status = if done { Status::Done } else { Status::Stopped };
            let frames = end(status, &cuts)?;
            kept.and(settled)?;
            let seconds_per_step = seconds / f64::from(steps.max(1));
            return Ok(RunSummary { frames, steps, substeps, seconds_per_step, stopped });
        }
        (Err(ShotError::Session { error: SessionError::Crew(stopped @ CrewError::Stopped(_)), .. }), None) => {
            RunError::Stopped(format!("{stopped}; continue with --resume"))
        }
        (Err(ShotError::Session { error, segment }), None) => {
            let job = Job::of_number(segment);
            let scene = &schedule.level(job).scene;
            let text = format!("{}: {}", job.name(), error.sentence(&|vertex| scene.vertex_name(vertex)));
            if error.is_bad_input() { RunError::BadInput(text) } else { RunError::Failed(text) }
        }
        (Err(ShotError::Listener(error)), None) => RunError::Failed(error.to_string()),
    };
    let status = match &error {
        RunError::Stopped(_) => Status::Stopped,
        other => Status::Failed(other.to_string()),
    };
    let cuts = schedule.table().cuts.clone();
    let _ = end(status, &cuts);
    Err(error)
}
