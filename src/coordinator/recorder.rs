//! Writes the files of a run directory during the run: frames, report, trace, recipe, checkpoints.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::time::Instant;

use thiserror::Error;

use super::options::RunOptions;
use super::plan::RunPlan;
use super::session::StepDone;
use crate::impact_zone::ZoneCounts;
use crate::model::State;
use crate::os::console::note;
use crate::output::{
    BeyondLimits, Checkpoint, Existing, FrameRecord, FrameWriter, LetGoRecord, OpenSeam, QueryRecord, RankEvents,
    ReportHeader, ReportWriter, RunDirectory, RunManifest, SeamGap, StageRecord, Status, StepRecord, Straightened,
    TraceWriter, checkpoint, scene_fingerprint, take_up_formats,
};
use crate::protocol::WorkerReady;
use crate::scene::Obstacles;
use crate::step::StageSeconds;

/// Input and output paths of a run.
#[derive(Clone, Debug)]
pub struct RunPlaces {
    /// Scene file.
    pub scene: PathBuf,
    /// Run directory.
    pub out: PathBuf,
    /// Treatment of an existing run.
    pub existing: Existing,
}

/// Error of writing or resuming.
#[derive(Debug, Error)]
pub enum RecordError {
    /// Refused before any file was written.
    #[error("{0}")]
    BadInput(String),
    /// A file could not be written.
    #[error("{0}")]
    Write(String),
}

fn ms_since(started: Instant) -> f64 {
    1e3 * started.elapsed().as_secs_f64()
}

fn write_error(error: impl Display) -> RecordError {
    RecordError::Write(error.to_string())
}

pub(super) struct Recorder {
    directory: RunDirectory,
    made: MadeFolders,
    manifest: Option<RunManifest>,
    options: RunOptions,
    /// Of the scene of later states, and of the one at the start.
    fingerprint: u64,
    first_fingerprint: u64,
    /// Number of the mesh of later states, from 0.
    mesh: usize,
    first: Option<Checkpoint>,
    frames: Option<FrameWriter>,
    obstacles: Obstacles,
    report: Option<ReportWriter>,
    trace: Option<TraceWriter>,
    /// By session: the clocks of its ranks.
    epochs: BTreeMap<usize, Vec<u64>>,
    /// The first missing frame, and the frames written after it.
    next_frame: u32,
    ahead: BTreeSet<u32>,
    last: Option<Checkpoint>,
}

impl Recorder {
    /// Prepares the run directory. With [`Existing::Resume`] it also returns the checkpoint to continue from.
    pub(super) fn open(
        plan: &RunPlan,
        options: &RunOptions,
        places: &RunPlaces,
    ) -> Result<(Recorder, Option<Checkpoint>), RecordError> {
        let fingerprint = scene_fingerprint(&plan.scene);
        let vertices = plan.scene.mesh.positions.len();
        let is_of_plan =
            |found: &Checkpoint| found.fingerprint == fingerprint && found.state.positions.len() == vertices;
        Recorder::open_stages(plan, fingerprint, options, places, &mut |found| is_of_plan(found).then_some(0))
    }

    /// As [`Recorder::open`] for a run of several stages, of which `plan` is the first. `mesh_of`: the number of the
    /// mesh of the stage that a checkpoint belongs to.
    pub(super) fn open_stages(
        plan: &RunPlan,
        first_fingerprint: u64,
        options: &RunOptions,
        places: &RunPlaces,
        mesh_of: &mut dyn FnMut(&Checkpoint) -> Option<usize>,
    ) -> Result<(Recorder, Option<Checkpoint>), RecordError> {
        let (mut mesh, mut fingerprint) = (0, first_fingerprint);
        let made = MadeFolders::for_run(&places.out);
        let directory = RunDirectory::create(&places.out, places.existing)
            .map_err(|error| RecordError::BadInput(error.to_string()))?;
        let (mut resumed, mut manifest) = (None, None);
        if places.existing == Existing::Resume {
            let latest = checkpoint::latest(&directory.checkpoints());
            latest.notes.iter().for_each(|note| tracing::warn!("{note}"));
            let Some((path, found)) = latest.found else {
                return Err(RecordError::BadInput(format!(
                    "{} holds no valid checkpoint to resume from",
                    directory.checkpoints().display()
                )));
            };
            if let Some(of_checkpoint) = mesh_of(&found) {
                (mesh, fingerprint) = (of_checkpoint, found.fingerprint);
            } else {
                return Err(RecordError::BadInput(format!(
                    "{} belongs to another scene, resolution or setting; resume with those of run.toml",
                    path.display()
                )));
            }
            resumed = Some(found);
            // The next --resume continues with these options. A program without a command line may have no recipe.
            if let Ok(mut recipe) = RunManifest::load(&directory) {
                recipe.set_flags(options).map_err(write_error)?;
                manifest = Some(recipe);
            }
        } else {
            let text = std::fs::read_to_string(&places.scene).map_err(write_error)?;
            manifest = Some(RunManifest::new(&places.scene, &text, options).map_err(write_error)?);
        }
        if let (Some(manifest), Some(_)) = (&mut manifest, &plan.steering) {
            let name = directory.changes().file_name().map(|name| name.to_string_lossy().into_owned());
            manifest.changes_file = name;
        }
        let recorder = Recorder {
            directory,
            made,
            manifest,
            options: options.clone(),
            fingerprint,
            first_fingerprint,
            mesh,
            first: resumed.clone(),
            frames: None,
            obstacles: Obstacles::new(&plan.scene.obstacles),
            report: None,
            trace: None,
            epochs: BTreeMap::new(),
            next_frame: resumed.as_ref().map_or(0, |from| from.frame + 1),
            ahead: BTreeSet::new(),
            last: None,
        };
        Ok((recorder, resumed))
    }

    /// Whether the run does not go on from a checkpoint.
    pub(super) fn is_new(&self) -> bool {
        self.first.is_none()
    }

    /// Later states are of a scene with this fingerprint and the mesh of now.
    pub(super) fn scene_is(&mut self, fingerprint: u64) {
        self.fingerprint = fingerprint;
    }

    /// `run_changes.toml`.
    pub(super) fn changes(&self) -> PathBuf {
        self.directory.changes()
    }

    /// For a segment of a shot: frames up to the one at or before `step`, where it starts, are made by others.
    pub(super) fn start_at(&mut self, step: u32, steps_per_frame: u32) {
        self.next_frame = self.next_frame.max(step / steps_per_frame + 1);
    }

    /// Call it when the workers of a session are set up. The first call starts recipe, report, trace and frames; no
    /// file is written before it.
    pub(super) fn begin(&mut self, plan: &RunPlan, session: usize, ready: &[WorkerReady]) -> Result<(), RecordError> {
        if self.report.is_some() {
            return self.begin_trace(session, ready);
        }
        self.made.0.clear();
        if let Some(manifest) = &mut self.manifest {
            manifest.save(&self.directory).map_err(write_error)?;
        }
        let scene = &plan.scene;
        if self.is_new() && self.options.start_from.is_some() {
            let (fingerprint, state) = (self.first_fingerprint, State::start_of(scene));
            let start = Checkpoint { fingerprint, state, ..Checkpoint::default() };
            checkpoint::write_to(&self.directory.start(), &start).map_err(write_error)?;
        }
        let header = report_header(plan, &self.options, ready);
        let path = self.directory.report();
        let report = match &self.first {
            Some(from) => ReportWriter::resume(&path, header, from.step, from.frame),
            None => ReportWriter::create(&path, header),
        };
        self.report = Some(report.map_err(write_error)?);
        let first_frame = self.first.as_ref().map_or(0, |from| from.frame + 1);
        let since = (self.mesh > 0).then(|| self.mesh_since(first_frame));
        if first_frame > 0 {
            let formats = &self.options.formats.0;
            let sentences =
                take_up_formats(&self.directory, formats, &scene.mesh, since, first_frame).map_err(write_error)?;
            sentences.iter().for_each(note);
        }
        self.frames = Some(self.writer(plan, since, first_frame)?);
        if self.options.keep_states.is_some() {
            std::fs::create_dir_all(self.directory.states()).map_err(write_error)?;
        }
        self.begin_trace(session, ready)
    }

    /// Call it when a session holds a level of the run with another mesh, that of number `mesh`, which goes on from the
    /// state after `step`. `straightened`: what welding has straightened.
    pub(super) fn begin_mesh(
        &mut self,
        plan: &RunPlan,
        mesh: usize,
        step: u32,
        straightened: Option<Straightened>,
    ) -> Result<(), RecordError> {
        let scene = &plan.scene;
        let first_frame = step / scene.settings.steps_per_frame + 1;
        self.mesh = mesh;
        let (triangles, vertices) = (scene.mesh.triangles.len(), scene.mesh.positions.len());
        let record = StageRecord { step: u64::from(step), first_frame, triangles, vertices, straightened };
        if let Some(report) = &mut self.report {
            report.stage(record);
        }
        self.frames = Some(self.writer(plan, Some(first_frame), first_frame)?);
        Ok(())
    }

    /// The writer of the frames of a mesh. `since`: as [`FrameWriter::of_stage`] takes it.
    fn writer(&self, plan: &RunPlan, since: Option<u32>, first_frame: u32) -> Result<FrameWriter, RecordError> {
        let (scene, formats) = (&plan.scene, &self.options.formats.0);
        let (mesh, parts) = (&scene.mesh, &scene.parts);
        FrameWriter::of_stage(&self.directory, formats, mesh, parts, scene.origin_m, since, first_frame)
            .map_err(write_error)
    }

    /// The first frame of the mesh of now, which is not the first one, if `first_frame` is the next one to be written.
    fn mesh_since(&self, first_frame: u32) -> u32 {
        let stages = self.report.as_ref().map(|report| &report.report().header.stages);
        stages.and_then(|stages| stages.last()).map_or(first_frame, |stage| stage.first_frame)
    }

    /// Leaves the trace of the start before as it is, for a start that makes no step.
    pub(super) fn leave_trace(&mut self) {
        self.options.trace_steps = 0;
    }

    /// Tracks for the ranks of a session.
    fn begin_trace(&mut self, session: usize, ready: &[WorkerReady]) -> Result<(), RecordError> {
        if self.options.trace_steps == 0 {
            return Ok(());
        }
        let epochs: Vec<u64> = ready.iter().map(|worker| worker.epoch_unix_ns).collect();
        let devices: Vec<String> = ready.iter().map(|worker| worker.device.clone()).collect();
        match &mut self.trace {
            Some(trace) => trace.add_session(session, &devices).map_err(write_error)?,
            None => {
                let base = epochs.iter().copied().min().unwrap_or(0);
                let trace = TraceWriter::create(&self.directory.trace(), &devices, base);
                self.trace = Some(trace.map_err(write_error)?);
            }
        }
        self.epochs.insert(session, epochs);
        Ok(())
    }

    /// Records a step that all ranks of a session have done.
    pub(super) fn step(&mut self, plan: &RunPlan, session: usize, done: &StepDone) -> Result<(), RecordError> {
        let settings = &plan.scene.settings;
        let StepDone { ranks, events, wall_s, .. } = done;
        let first = ranks[0];
        let slowest = ranks.iter().map(|rank| rank.seconds).fold(StageSeconds::default(), StageSeconds::max);
        let spmv_bytes: u64 = ranks.iter().map(|rank| rank.spmv_bytes).sum();
        let record = StepRecord {
            step: first.step as u64,
            session,
            frame: first.step.div_ceil(settings.steps_per_frame),
            time_s: first.step as f64 * settings.step_s,
            substeps: first.substeps,
            guidance: first.guidance,
            arrived: first.arrived,
            iterations: first.iterations,
            residual: first.residual,
            converged: first.converged,
            breakdowns: first.breakdowns,
            stage_seconds: StageSeconds { total: *wall_s, ..slowest },
            bytes_moved: spmv_bytes + ranks.iter().map(|rank| rank.state_bytes).sum::<u64>(),
            bytes_per_spmv: spmv_bytes / first.products.max(1) as u64,
            contacts: first.contacts,
            smallest_gap_m: first.smallest_gap_m.map(f64::from),
            zones: ZoneCounts { iterations: ranks.iter().map(|rank| rank.zones.iterations).sum(), ..first.zones },
            let_go: first.let_go,
            limits: first.limits,
            proximity: QueryRecord::of(ranks.iter().map(|rank| (&rank.proximity, rank.query_bytes[0]))),
            continuous: QueryRecord::of(ranks.iter().map(|rank| (&rank.continuous, rank.query_bytes[1]))),
            collision_mesh_bytes_per_rank: ranks.iter().map(|rank| rank.collision_mesh_bytes).collect(),
            memory_bytes_per_rank: ranks.iter().map(|rank| rank.memory_bytes).collect(),
            resident_bytes_per_rank: ranks.iter().map(|rank| rank.resident_bytes).collect(),
        };
        tracing::debug!(
            "step {}: {} iterations to {:.2e}, {} contacts, {} zones in {} rounds, {:.2} ms (solve {:.2}), {} bytes",
            record.step,
            record.iterations,
            record.residual,
            record.contacts,
            record.zones.zones,
            record.zones.rounds,
            1e3 * record.stage_seconds.total,
            1e3 * record.stage_seconds.solve,
            record.bytes_moved
        );
        tracing::trace!("step {}: slowest rank by stage, s: {:?}", record.step, record.stage_seconds);
        for (rank, stats) in ranks.iter().enumerate() {
            tracing::trace!(
                "step {}, rank {rank}: {} products, {} B of products, {} B of state, {} B of memory",
                record.step,
                stats.products,
                stats.spmv_bytes,
                stats.state_bytes,
                stats.memory_bytes
            );
        }
        if first.breakdowns > 0 {
            tracing::warn!(
                "step {}: the solve broke off {} times, the step was made in {} parts",
                first.step,
                first.breakdowns,
                first.zones.halvings + 1
            );
        }
        if !first.converged {
            tracing::warn!(
                "step {}: the solver stopped at {} iterations with a relative residual of {:.2e}",
                first.step,
                first.iterations,
                first.residual
            );
        }
        if let Some(report) = &mut self.report {
            report.step(record);
        }
        if let Some(trace) = &mut self.trace {
            let epochs = self.epochs.get(&session).into_iter().flatten();
            let first_track = session * ranks.len();
            let ranks: Vec<RankEvents> = (first_track..)
                .zip(epochs.zip(events))
                .map(|(rank, (&epoch_unix_ns, events))| RankEvents { rank, epoch_unix_ns, events })
                .collect();
            trace.append(&ranks).map_err(write_error)?;
        }
        Ok(())
    }

    /// Accepts the state after a step, in any order. It writes the state as a frame if one ends there (then it returns
    /// the hash), keeps it if requested, and stores it as the last good state if no earlier frame is missing.
    pub(super) fn state(&mut self, plan: &RunPlan, step: u32, state: State) -> Result<Option<String>, RecordError> {
        self.state_with(plan, step, state, None)
    }

    /// As [`Recorder::state`], with how far the seams are open.
    pub(super) fn state_with(
        &mut self,
        plan: &RunPlan,
        step: u32,
        state: State,
        seams: Option<SeamGap>,
    ) -> Result<Option<String>, RecordError> {
        let settings = &plan.scene.settings;
        let frame = step / settings.steps_per_frame;
        let time_s = step as f64 * settings.step_s;
        let mut hash = None;
        if step.is_multiple_of(settings.steps_per_frame) {
            let started = Instant::now();
            hash = Some(self.frame(plan, frame, time_s, &state, seams)?);
            tracing::debug!("step {step}: frame {frame} written in {:.1} ms", ms_since(started));
            self.ahead.insert(frame);
            while self.ahead.remove(&self.next_frame) {
                self.next_frame += 1;
            }
        }
        let fingerprint = self.fingerprint;
        let reached = Checkpoint { frame, step: step as u64, time_s, fingerprint, state };
        if self.options.keep_states.is_some_and(|keep| keep.wants(step, settings.steps_per_frame)) {
            checkpoint::keep(&self.directory.states(), &reached).map_err(write_error)?;
            tracing::debug!("step {step}: state kept in {}", self.directory.states().display());
        }
        if frame < self.next_frame && self.last.as_ref().is_none_or(|last| last.step <= reached.step) {
            self.last = Some(reached);
        }
        Ok(hash)
    }

    fn frame(
        &mut self,
        plan: &RunPlan,
        frame: u32,
        time_s: f64,
        state: &State,
        seams: Option<SeamGap>,
    ) -> Result<String, RecordError> {
        let state_hash = state.hash();
        if let Some(frames) = &mut self.frames {
            frames.write(frame, &plan.scene.mesh, &state.positions).map_err(write_error)?;
            if !self.obstacles.is_empty() {
                let mut values = Vec::new();
                self.obstacles.positions_at(time_s, &mut values);
                let positions = bytemuck::cast_slice(&values);
                frames.write_obstacle(frame, positions, self.obstacles.triangles()).map_err(write_error)?;
            }
        }
        if let Some(report) = &mut self.report {
            let name = |obstacle: usize| self.obstacles.name(obstacle).to_string();
            let let_go = LetGoRecord::of(&state.let_go, name);
            let beyond_limits = BeyondLimits::of(&plan.scene, &self.obstacles, state, time_s);
            let record = FrameRecord { frame, time_s, state_hash: state_hash.clone(), let_go, beyond_limits, seams };
            report.frame(record).map_err(write_error)?;
        }
        Ok(state_hash)
    }

    /// Writes the last good state as a checkpoint. Returns its place as the end of a sentence.
    pub(super) fn keep_last_state(&mut self) -> Result<String, RecordError> {
        let Some(last) = &self.last else { return Ok(String::new()) };
        if let Some(report) = &mut self.report {
            report.save().map_err(write_error)?;
        }
        let started = Instant::now();
        let path = checkpoint::write(&self.directory.checkpoints(), last).map_err(write_error)?;
        tracing::debug!("step {}: checkpoint {} in {:.1} ms", last.step, path.display(), ms_since(started));
        Ok(format!("; the last good state (step {}) is kept in {}, continue with --resume", last.step, path.display()))
    }

    /// Notes the seams that are open when the run ends.
    pub(super) fn open_seams(&mut self, seams: Vec<OpenSeam>) {
        if let Some(report) = &mut self.report {
            report.open_seams(seams);
        }
    }

    pub(super) fn finish(self, status: Status) -> Result<(), RecordError> {
        match self.report {
            Some(report) => report.finish(status).map(|_| ()).map_err(write_error),
            None => Ok(()),
        }
    }
}

/// The header of the report of a run whose workers are `ready`.
pub(super) fn report_header(plan: &RunPlan, options: &RunOptions, ready: &[WorkerReady]) -> ReportHeader {
    let scene = &plan.scene;
    let mut header = ReportHeader {
        scene: scene.name.clone(),
        workers: plan.partition.ranks(),
        executor: ready.first().map_or_else(String::new, |worker| worker.executor.clone()),
        devices: ready.iter().map(|worker| worker.device.clone()).collect(),
        exchange: format!("{:?}", options.exchange).to_lowercase(),
        schedule: plan.transfers.kind.name().to_string(),
        preconditioner: ready.first().map_or_else(String::new, |worker| worker.preconditioner.name().into()),
        topology: plan.topology.clone(),
        triangles: scene.mesh.triangles.len(),
        vertices: scene.mesh.positions.len(),
        step_s: scene.settings.step_s,
        steps_per_frame: scene.settings.steps_per_frame,
        frames_wanted: scene.settings.frames,
        local_origin_m: scene.origin_m.to_array(),
        untangled: plan.untangled,
        ..ReportHeader::now()
    };
    let sewn = scene.sewing.as_ref().map(|sewing| sewing.gravity_m_s2);
    header.set_gravity(sewn.unwrap_or(scene.settings.gravity_m_s2).to_array().map(f64::from));
    header
}

/// Folders that this start creates, the innermost first. Those that stay empty are removed again.
struct MadeFolders(Vec<PathBuf>);

impl MadeFolders {
    /// Call it before the folders are created.
    fn for_run(out: &Path) -> MadeFolders {
        let inner = [out.join("frames"), out.join("checkpoint"), out.join("states")];
        let all = inner.iter().map(PathBuf::as_path).chain(out.ancestors());
        MadeFolders(
            all.filter(|folder| !folder.as_os_str().is_empty() && !folder.exists()).map(PathBuf::from).collect(),
        )
    }
}

impl Drop for MadeFolders {
    fn drop(&mut self) {
        for folder in &self.0 {
            // A folder that does not exist or is not empty stays as it is.
            let _ = std::fs::remove_dir(folder);
        }
    }
}
