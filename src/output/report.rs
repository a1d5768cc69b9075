//! `report.json`: description of a run, with costs and results of every step and frame.
//!
//! The file is replaced as a whole, at most once a second, before every checkpoint and at the end. After a crash it is
//! still valid, says `running`, and lacks at most the records after the newest checkpoint.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use thiserror::Error;

use super::atomic::{WriteError, write_atomically};
use super::machine::Machine;
use super::sewing::{OpenSeam, SeamGap, StageRecord};
use super::stretch::BeyondLimits;
use crate::impact_zone::ZoneCounts;
use crate::model::LetGo;
use crate::scene::Untangling;
use crate::step::{Guidance, LetGoCounts, LimitCounts, QueryStats, StageSeconds};

/// State of a run.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub enum Status {
    /// The run is in progress or its process was killed.
    #[default]
    Running,
    /// All frames are written.
    Done,
    /// The user stopped the run after a step.
    Stopped,
    /// The run failed with this message.
    Failed(String),
}

impl Serialize for Status {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Status::Running => serializer.serialize_str("running"),
            Status::Done => serializer.serialize_str("done"),
            Status::Stopped => serializer.serialize_str("stopped"),
            Status::Failed(why) => serializer.collect_str(&format_args!("failed: {why}")),
        }
    }
}

impl<'de> Deserialize<'de> for Status {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Status, D::Error> {
        let text = String::deserialize(deserializer)?;
        match text.as_str() {
            "running" => Ok(Status::Running),
            "done" => Ok(Status::Done),
            "stopped" => Ok(Status::Stopped),
            _ => match text.strip_prefix("failed: ") {
                Some(why) => Ok(Status::Failed(why.to_string())),
                None => Err(serde::de::Error::custom(format!(
                    "status {text:?} is none of running, done, stopped, failed: REASON"
                ))),
            },
        }
    }
}

/// Data that do not change during a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportHeader {
    /// Name of the scene.
    pub scene: String,
    /// Version of the program.
    pub version: String,
    /// Number of ranks.
    pub workers: usize,
    /// `cpu` or `gpu`.
    pub executor: String,
    /// Device of every rank.
    pub devices: Vec<String>,
    /// `halo` or `full`.
    pub exchange: String,
    /// Schedule of the transfers.
    pub schedule: String,
    /// Preconditioner of the solver.
    pub preconditioner: String,
    /// Topology file, or the description of a default topology.
    pub topology: String,
    /// Triangles of the mesh.
    pub triangles: usize,
    /// Vertices of the mesh.
    pub vertices: usize,
    /// Length of a step, seconds.
    pub step_s: f64,
    /// Steps per frame.
    pub steps_per_frame: u32,
    /// Number of frames to write, in addition to frame 0.
    pub frames_wanted: u32,
    /// Local origin that the states of the run are relative to, meters; omitted if it is zero. Frames are in world
    /// coordinates.
    #[serde(skip_serializing_if = "is_zero_point")]
    pub local_origin_m: [f64; 3],
    /// Gravity, m/s^2.
    pub gravity_m_s2: [f64; 3],
    /// `y` or `z`: the axis against gravity.
    pub up_axis: String,
    /// Machine of the run.
    pub machine: Machine,
    /// Seconds since 1970.
    pub started_unix_s: u64,
    /// Seconds since 1970, once the run has ended.
    pub ended_unix_s: Option<u64>,
    /// State of the run.
    pub status: Status,
    /// Points at which the run was resumed.
    pub resumed: Vec<Resumption>,
    /// Meshes after the first one, in a run that sews; omitted if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub stages: Vec<StageRecord>,
    /// Seams that were open when the run ended; omitted if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub open_seams: Vec<OpenSeam>,
    /// Figures of the untangling of the start state, if there was one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub untangled: Option<Untangling>,
}

impl ReportHeader {
    /// A header with version, machine and start time filled in.
    pub fn now() -> ReportHeader {
        ReportHeader {
            version: env!("CARGO_PKG_VERSION").to_string(),
            machine: Machine::here(),
            started_unix_s: unix_s(),
            ..ReportHeader::default()
        }
    }

    /// Sets the time of the end to now.
    pub fn ended(&mut self) {
        self.ended_unix_s = Some(unix_s());
    }

    /// Sets gravity and derives the up axis of pictures from it.
    pub fn set_gravity(&mut self, gravity_m_s2: [f64; 3]) {
        self.gravity_m_s2 = gravity_m_s2;
        let [_, y, z] = gravity_m_s2.map(f64::abs);
        self.up_axis = if y > z { "y" } else { "z" }.to_string();
    }
}

/// A continuation of the run from a checkpoint.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Resumption {
    /// Step of the checkpoint.
    pub step: u64,
    /// Frame of the checkpoint.
    pub frame: u32,
    /// Number of ranks from this point on.
    pub workers: usize,
    /// Seconds since 1970.
    pub unix_s: u64,
}

/// A written frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Number of the frame, from 0.
    pub frame: u32,
    /// Simulated time, seconds.
    pub time_s: f64,
    /// [`crate::model::State::hash`] of the state.
    pub state_hash: String,
    /// What the state has let go, by obstacle; omitted if nothing.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub let_go: Vec<LetGoRecord>,
    /// Triangles more than 0.5 % of strain beyond their limits; omitted if there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beyond_limits: Option<BeyondLimits>,
    /// How far the seams are open; omitted without seams, and once they are sewn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seams: Option<SeamGap>,
}

/// Vertices that pass through an obstacle, because they had no room between it and one that overlaps it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LetGoRecord {
    /// Name of the obstacle.
    pub obstacle: String,
    /// The side of the obstacle that the cloth came from, and on which it is taken up again: `outside` or `inside`.
    pub side: String,
    /// Vertices of the mesh, ascending.
    pub vertices: Vec<u32>,
}

impl LetGoRecord {
    /// The records of a state; `name`: that of an obstacle.
    pub fn of(let_go: &[LetGo], name: impl Fn(usize) -> String) -> Vec<LetGoRecord> {
        let mut groups: BTreeMap<(u32, u32), Vec<u32>> = BTreeMap::new();
        let_go.iter().for_each(|one| groups.entry((one.obstacle, one.inside)).or_default().push(one.vertex));
        let record = |((obstacle, inside), vertices): ((u32, u32), Vec<u32>)| {
            let side = if inside == 0 { "outside" } else { "inside" };
            LetGoRecord { obstacle: name(obstacle as usize), side: side.to_string(), vertices }
        };
        groups.into_iter().map(record).collect()
    }
}

/// Figures of the collision queries of one kind in a step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct QueryRecord {
    /// Sum over all ranks.
    #[serde(flatten)]
    pub total: QueryStats,
    /// Triangle-triangle tests of every rank.
    pub tests_per_rank: Vec<u64>,
    /// Bytes of tables and buffers of every rank.
    pub bytes_per_rank: Vec<u64>,
}

impl QueryRecord {
    /// Collects the figures of all ranks, given in rank order.
    pub fn of<'a>(ranks: impl Iterator<Item = (&'a QueryStats, u64)>) -> QueryRecord {
        let mut record = QueryRecord::default();
        for (rank, bytes) in ranks {
            record.total.add_rank(rank);
            record.tests_per_rank.push(rank.tests);
            record.bytes_per_rank.push(bytes);
        }
        record
    }
}

/// Record of a step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct StepRecord {
    /// Number of the step, from 1.
    pub step: u64,
    /// Session that made the step; omitted if it is 0, as in a run with one session.
    #[serde(skip_serializing_if = "is_zero")]
    pub session: usize,
    /// Frame that the step leads to.
    pub frame: u32,
    /// Simulated time after the step, seconds.
    pub time_s: f64,
    /// Sub-steps that the step was made in.
    pub substeps: u32,
    /// How the step was drawn toward a guide, at a seam of a shot that is split in time; omitted in other steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub guidance: Option<Guidance>,
    /// Whether a seam was closed by this step, which leads straight to a state of the later segment; omitted in others.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub arrived: Option<bool>,
    /// Iterations of the solver.
    pub iterations: u32,
    /// Relative residual reached (`null` in the file if it is no number).
    #[serde(deserialize_with = "number_or_null")]
    pub residual: f64,
    /// True if the requested residual was reached.
    pub converged: bool,
    /// Solves that broke off; omitted if none did. `halvings` also counts the steps that were halved for this reason.
    #[serde(skip_serializing_if = "is_none")]
    pub breakdowns: u32,
    /// Seconds per stage of the slowest rank. `total` is measured by the coordinator.
    pub stage_seconds: StageSeconds,
    /// Bytes moved between ranks, summed over all ranks.
    pub bytes_moved: u64,
    /// Bytes moved between ranks per matrix-vector product, summed over all ranks.
    pub bytes_per_spmv: u64,
    /// Contacts in the matrix.
    pub contacts: u64,
    /// Impact zones. Iterations are summed over all ranks.
    #[serde(flatten)]
    pub zones: ZoneCounts,
    /// Pairs of vertices and obstacles that are let go; omitted if there are none and were none. The frames list them.
    #[serde(skip_serializing_if = "are_none")]
    pub let_go: LetGoCounts,
    /// What strain limits asked for; omitted if nothing. The frames name the triangle that is farthest beyond.
    #[serde(skip_serializing_if = "LimitCounts::are_none")]
    pub limits: LimitCounts,
    /// Proximity query.
    pub proximity: QueryRecord,
    /// Continuous queries.
    pub continuous: QueryRecord,
    /// Bytes of mesh and positions that every rank holds for collision queries.
    pub collision_mesh_bytes_per_rank: Vec<u64>,
    /// Device memory of every rank, bytes.
    pub memory_bytes_per_rank: Vec<u64>,
    /// Peak resident memory of every worker process, bytes (0 if the system does not report it).
    #[serde(default)]
    pub resident_bytes_per_rank: Vec<u64>,
    /// Smallest gap between two parts of the cloth, meters, if it was measured.
    pub smallest_gap_m: Option<f64>,
}

fn is_zero_point(point: &[f64; 3]) -> bool {
    *point == [0.0; 3]
}

fn are_none(counts: &LetGoCounts) -> bool {
    *counts == LetGoCounts::default()
}

fn is_none(count: &u32) -> bool {
    *count == 0
}

fn is_zero(number: &usize) -> bool {
    *number == 0
}

/// JSON has no NaN, so serde_json writes null.
fn number_or_null<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

/// A segment of a shot that is split in time.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SegmentRecord {
    /// Number of the segment, from 0.
    pub segment: usize,
    /// Step of its start state.
    pub first_step: u32,
    /// Its last step.
    pub last_step: u32,
    /// Session that made it.
    pub session: usize,
    /// Steps made before its start to recover detail. They are not among the steps of the report.
    pub recovery_steps: u32,
    /// Steps made again at its start to join it to the one before.
    pub handover_steps: u32,
    /// Measured seconds of its steps, those of recovery and hand-over included.
    pub busy_s: f64,
    /// Measured seconds from its end to the end of the run in which its session did nothing else.
    pub idle_s: f64,
    /// Measured seconds of its steps over those of the coarse run for the same stretch: K.
    pub k: f64,
}

/// The seam between two segments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SeamRecord {
    /// Step of the cut.
    pub step: u32,
    /// Largest distance between the end of the earlier segment and the start of the later one, meters.
    pub distance_max_m: f64,
    /// The same as root mean square.
    pub distance_rms_m: f64,
    /// Whether the hand-over has met the later segment; false also for a cut.
    pub met: bool,
    /// Largest second difference of a vertex's positions over one step, from the cut to one step after the hand-over,
    /// meters.
    pub jump_max_m: f64,
    /// Largest root mean square of all vertices of the same.
    pub jump_rms_m: f64,
    /// Median of the same within the segments, the largest vertex of each step.
    pub inner_median_max_m: f64,
    /// Median of the same within the segments, root mean square.
    pub inner_median_rms_m: f64,
    /// What `jump_max_m` is over the same stretch of time in the later segment as it was before the hand-over, from its
    /// third step on.
    pub inner_largest_max_m: f64,
    /// What `jump_rms_m` is there.
    pub inner_largest_rms_m: f64,
}

/// The whole report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Data that do not change during the run.
    #[serde(flatten)]
    pub header: ReportHeader,
    /// Frames written.
    #[serde(default)]
    pub frames: Vec<FrameRecord>,
    /// Steps made.
    #[serde(default)]
    pub steps: Vec<StepRecord>,
    /// Segments of a shot that is split in time; omitted in other runs.
    #[serde(default)]
    pub segments: Vec<SegmentRecord>,
    /// The seams between them.
    #[serde(default)]
    pub seams: Vec<SeamRecord>,
}

/// Why a report cannot be read.
#[derive(Debug, Error)]
pub enum ReportError {
    /// The file cannot be opened.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The report.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The file is not a report.
    #[error("{} is not a report of a run: {source}", path.display())]
    Json {
        /// The report.
        path: PathBuf,
        /// The error with its position.
        source: serde_json::Error,
    },
}

impl Report {
    /// Reads `path`.
    pub fn load(path: &Path) -> Result<Report, ReportError> {
        let text = fs::read(path).map_err(|source| ReportError::Io { path: path.to_path_buf(), source })?;
        serde_json::from_slice(&text).map_err(|source| ReportError::Json { path: path.to_path_buf(), source })
    }

    /// Writes the report to `path`. The header spans several lines; frames and steps take one line each.
    pub fn save(&self, path: &Path) -> Result<(), WriteError> {
        write_atomically(path, |out| {
            let header = serde_json::to_string_pretty(&self.header)?;
            out.write_all(header.strip_suffix("\n}").unwrap_or(&header).as_bytes())?;
            out.write_all(b",\n  \"frames\": [")?;
            write_lines(out, &self.frames)?;
            out.write_all(b"],\n  \"steps\": [")?;
            write_lines(out, &self.steps)?;
            if !self.segments.is_empty() {
                out.write_all(b"],\n  \"segments\": [")?;
                write_lines(out, &self.segments)?;
                out.write_all(b"],\n  \"seams\": [")?;
                write_lines(out, &self.seams)?;
            }
            out.write_all(b"]\n}\n")
        })
    }
}

fn write_lines<T: Serialize>(out: &mut dyn Write, records: &[T]) -> io::Result<()> {
    for (i, record) in records.iter().enumerate() {
        out.write_all(if i == 0 { b"\n    " } else { b",\n    " })?;
        serde_json::to_writer(&mut *out, record)?;
    }
    if records.is_empty() { Ok(()) } else { out.write_all(b"\n  ") }
}

/// Shortest time between two writes of the report.
const PAUSE: Duration = Duration::from_secs(1);

/// Collects the records of a run and keeps the report file up to date.
pub struct ReportWriter {
    path: PathBuf,
    report: Report,
    written: Instant,
}

impl ReportWriter {
    /// Starts a report and writes the file once.
    pub fn create(path: &Path, header: ReportHeader) -> Result<ReportWriter, WriteError> {
        let report = Report { header, ..Report::default() };
        report.save(path)?;
        Ok(ReportWriter { path: path.to_path_buf(), report, written: Instant::now() })
    }

    /// Continues the report at `path` after a checkpoint. Records after `step` and `frame` are dropped, because they
    /// are made again. The new header is used with the old start time. A missing or damaged report is started anew.
    pub fn resume(path: &Path, mut header: ReportHeader, step: u64, frame: u32) -> Result<ReportWriter, WriteError> {
        let Report { header: old, mut frames, mut steps, .. } = Report::load(path).unwrap_or_default();
        frames.retain(|record| record.frame <= frame);
        steps.retain(|record| record.step <= step);
        let resumption = Resumption { step, frame, workers: header.workers, unix_s: header.started_unix_s };
        header.resumed = old.resumed;
        header.stages = old.stages.into_iter().filter(|stage| stage.step <= step).collect();
        header.resumed.push(resumption);
        if old.started_unix_s > 0 {
            header.started_unix_s = old.started_unix_s;
        }
        let report = Report { header, frames, steps, ..Report::default() };
        report.save(path)?;
        Ok(ReportWriter { path: path.to_path_buf(), report, written: Instant::now() })
    }

    /// Notes that a stage begins. Those of this step and of later ones are dropped, because they are made again.
    pub fn stage(&mut self, record: StageRecord) {
        let stages = &mut self.report.header.stages;
        stages.retain(|stage| stage.step < record.step);
        stages.push(record);
    }

    /// Adds a step. Steps can come in any order.
    pub fn step(&mut self, record: StepRecord) {
        let steps = &mut self.report.steps;
        let place = steps.partition_point(|other| other.step <= record.step);
        steps.insert(place, record);
    }

    /// Adds a frame. Frames can come in any order. Writes the file if the last write was more than a second ago.
    pub fn frame(&mut self, record: FrameRecord) -> Result<(), WriteError> {
        let frames = &mut self.report.frames;
        let place = frames.partition_point(|other| other.frame <= record.frame);
        frames.insert(place, record);
        if self.written.elapsed() < PAUSE {
            return Ok(());
        }
        self.save()
    }

    /// Writes the file now. Called before a checkpoint, so that no record before it is lost if the process dies.
    pub fn save(&mut self) -> Result<(), WriteError> {
        self.report.save(&self.path)?;
        self.written = Instant::now();
        Ok(())
    }

    /// The records so far.
    pub fn report(&self) -> &Report {
        &self.report
    }

    /// Notes the seams that are open when the run ends.
    pub fn open_seams(&mut self, seams: Vec<OpenSeam>) {
        self.report.header.open_seams = seams;
    }

    /// Sets the status and the end time and writes the file.
    pub fn finish(mut self, status: Status) -> Result<Report, WriteError> {
        self.report.header.status = status;
        self.report.header.ended();
        self.report.save(&self.path)?;
        Ok(self.report)
    }
}

fn unix_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}
