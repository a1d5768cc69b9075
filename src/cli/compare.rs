//! `loomtree compare`: how far two runs of one mesh are apart, frame by frame.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;

use super::{CliError, print};
use crate::math::Vec3;
use crate::os::console::{is_json, note};
use crate::output::checkpoint::Checkpoint;
use crate::output::plot::{Series, line_chart};
use crate::output::{FrameMesh, FrameSource, Report, RunDirectory, check_writable, write_atomically};
use crate::time_parallel::{Comparison, rms};

/// Compare two runs of one mesh frame by frame.
///
/// Distances are those of B from A: of vertices, the same after the best rigid motion, and the relative difference of
/// curvature [Liang and Lin 2018, Eq. 17]. Velocities are compared where both runs kept the state of a frame
/// (run --keep-states frames).
#[derive(Args, Clone, Debug)]
pub struct CompareArgs {
    /// Run directory of the first run.
    pub a: PathBuf,
    /// Run directory of the second run.
    pub b: PathBuf,
    /// A third run, for comparison: what a small disturbance does to A. Its distance from A is the floor below which
    /// distances mean nothing.
    #[arg(long, value_name = "RUN")]
    pub floor: Option<PathBuf>,
    /// Print JSON in place of the table.
    #[arg(long)]
    pub json: bool,
    /// Also write the table as CSV.
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
    /// Also draw rms distance over time as SVG.
    #[arg(long, value_name = "FILE")]
    pub svg: Option<PathBuf>,
}

/// Distance of a frame. A figure that is not finite is null in JSON and empty in CSV.
#[derive(Clone, Debug, Serialize)]
struct FrameDistance {
    /// Number of the frame.
    frame: u32,
    /// Root mean square distance of the vertices, meters.
    rms_m: f64,
    /// Largest distance of a vertex, meters.
    max_m: f64,
    /// The vertex of the largest distance, from 0.
    max_vertex: usize,
    /// `rms_m` after the best rigid motion.
    aligned_rms_m: f64,
    /// Eq. 17 with dihedral angles.
    eq17_theta: f64,
    /// Eq. 17 with theta l / a.
    eq17_curvature: f64,
    /// Root mean square difference of velocities; none where a run has no kept state.
    velocity_rms_m_s: Option<f64>,
    /// `rms_m` of the floor from A.
    #[serde(skip_serializing_if = "Option::is_none")]
    floor_rms_m: Option<f64>,
    /// `eq17_theta` of the floor.
    #[serde(skip_serializing_if = "Option::is_none")]
    floor_eq17_theta: Option<f64>,
    /// `eq17_curvature` of the floor.
    #[serde(skip_serializing_if = "Option::is_none")]
    floor_eq17_curvature: Option<f64>,
}

/// What is printed.
#[derive(Clone, Debug, Serialize)]
struct Findings {
    /// True if both runs have the same frames with the same bits, of velocities too where the reports hold state
    /// hashes.
    equal_bits: bool,
    /// The first frame that differs in a bit or that one of the runs lacks.
    first_difference: Option<u32>,
    /// Frames that both runs have.
    frames: Vec<FrameDistance>,
    /// Seams of runs split in time. No run has any yet.
    seams: [(); 0],
}

/// A run that was opened for reading.
struct Run {
    directory: RunDirectory,
    frames: FrameSource,
    report: Option<Report>,
}

impl Run {
    fn open(path: &Path) -> Result<Run, CliError> {
        let directory = RunDirectory::open(path).map_err(CliError::bad_input)?;
        let frames = FrameSource::open(&directory).map_err(CliError::bad_input)?;
        let report = directory.report();
        let report = report.is_file().then(|| Report::load(&report)).transpose().map_err(CliError::bad_input)?;
        Ok(Run { directory, frames, report })
    }

    fn triangles(&self) -> Result<Vec<[u32; 3]>, CliError> {
        let first = self.frames.numbers().first().copied().unwrap_or(0);
        Ok(self.frames.read(first).map_err(CliError::bad_input)?.triangles)
    }

    fn read(&self, frame: u32) -> Result<FrameMesh, CliError> {
        self.frames.read(frame).map_err(CliError::bad_input)
    }

    /// Positions of a frame; another mesh than that of the first run at this frame is refused.
    fn positions(&self, frame: u32, mesh: &[[u32; 3]]) -> Result<Vec<Vec3>, CliError> {
        let read = self.read(frame)?;
        if read.triangles != mesh {
            let place = self.directory.path().display();
            return Err(CliError::bad_input(format!("{place}: frame {frame} has another mesh than in the first run")));
        }
        Ok(read.positions)
    }

    fn state_hash(&self, frame: u32) -> Option<&str> {
        let record = self.report.as_ref()?.frames.iter().find(|record| record.frame == frame)?;
        Some(&record.state_hash)
    }

    /// Velocities of a frame whose state was kept.
    fn velocities(&self, frame: u32) -> Result<Option<Vec<Vec3>>, CliError> {
        let Some(report) = &self.report else { return Ok(None) };
        let step = u64::from(frame) * u64::from(report.header.steps_per_frame);
        let path = self.directory.states().join(format!("step_{step:08}.ltc"));
        let Ok(bytes) = std::fs::read(&path) else { return Ok(None) };
        let kept = Checkpoint::from_bytes(&bytes);
        let kept = kept.map_err(|error| CliError::bad_input(format!("{}: {error}", path.display())))?;
        Ok(Some(kept.state.velocities))
    }
}

/// Runs the command.
pub fn run(args: CompareArgs) -> Result<(), CliError> {
    for path in [&args.csv, &args.svg].into_iter().flatten() {
        check_writable(path)
            .map_err(|error| CliError::bad_input(format!("{} cannot be written: {error}", path.display())))?;
    }
    let [a, b] = [Run::open(&args.a)?, Run::open(&args.b)?];
    let floor = args.floor.as_deref().map(Run::open).transpose()?;
    let findings = compare(&a, &b, floor.as_ref())?;
    if let Some(path) = &args.csv {
        write_atomically(path, |out| out.write_all(csv(&findings).as_bytes())).map_err(CliError::bad_input)?;
    }
    if let Some(path) = &args.svg {
        draw(path, &args, &findings)?;
    }
    if args.json || is_json() {
        note(table(&findings).trim_end());
        let text = serde_json::to_string_pretty(&findings).map_err(CliError::failed)?;
        return print(&(text + "\n"));
    }
    print(&table(&findings))
}

fn compare(a: &Run, b: &Run, floor: Option<&Run>) -> Result<Findings, CliError> {
    let mesh = a.triangles()?;
    for other in [Some(b), floor].into_iter().flatten() {
        let theirs = other.triangles()?;
        if theirs != mesh {
            let (a, b) = (a.directory.path().display(), other.directory.path().display());
            let (triangles, there) = (mesh.len(), theirs.len());
            return Err(CliError::bad_input(if triangles == there {
                format!("{a} and {b} have different triangles; runs of one mesh can be compared")
            } else {
                format!("{a} has {triangles} triangles and {b} has {there}; runs of one mesh can be compared")
            }));
        }
    }
    let mut mesh = mesh;
    let mut comparison = Comparison::new(mesh.clone());
    let (ours, theirs) = (a.frames.numbers(), b.frames.numbers());
    let lacking = |have: &[u32], other: &[u32]| have.iter().find(|n| other.binary_search(n).is_err()).copied();
    let mut first_difference = [lacking(&ours, &theirs), lacking(&theirs, &ours)].into_iter().flatten().min();
    let mut frames = Vec::new();
    for frame in ours.into_iter().filter(|n| theirs.binary_search(n).is_ok()) {
        let FrameMesh { positions: x, triangles } = a.read(frame)?;
        // A run that sews has another mesh from some frame on.
        if triangles != mesh {
            mesh = triangles;
            comparison = Comparison::new(mesh.clone());
        }
        let y = b.positions(frame, &mesh)?;
        if x.len() != y.len() {
            let (a, b) = (a.directory.path().display(), b.directory.path().display());
            let text = format!("frame {frame} has {} vertices in {a} and {} in {b}", x.len(), y.len());
            return Err(CliError::bad_input(text));
        }
        let hashes_differ = a.state_hash(frame).zip(b.state_hash(frame)).is_some_and(|(one, other)| one != other);
        if hashes_differ || x.iter().zip(&y).any(|(x, y)| bits(*x) != bits(*y)) {
            first_difference = Some(first_difference.map_or(frame, |first| first.min(frame)));
        }
        let distance = comparison.distance(&x, &y);
        let velocities = a.velocities(frame)?.zip(b.velocities(frame)?);
        let velocities = velocities.filter(|(v, w)| v.len() == w.len());
        let floor = match floor.filter(|floor| floor.frames.numbers().binary_search(&frame).is_ok()) {
            Some(floor) => Some(floor.positions(frame, &mesh)?).filter(|z| z.len() == x.len()),
            None => None,
        };
        let floor = floor.map(|z| comparison.distance(&x, &z));
        frames.push(FrameDistance {
            frame,
            rms_m: distance.rms_m,
            max_m: distance.max_m,
            max_vertex: distance.max_vertex,
            aligned_rms_m: distance.aligned_rms_m,
            eq17_theta: distance.eq17_theta,
            eq17_curvature: distance.eq17_curvature,
            velocity_rms_m_s: velocities.map(|(v, w)| rms(&v, &w)),
            floor_rms_m: floor.map(|d| d.rms_m),
            floor_eq17_theta: floor.map(|d| d.eq17_theta),
            floor_eq17_curvature: floor.map(|d| d.eq17_curvature),
        });
    }
    if frames.is_empty() {
        let (a, b) = (a.directory.path().display(), b.directory.path().display());
        return Err(CliError::bad_input(format!("{a} and {b} have no frame in common")));
    }
    Ok(Findings { equal_bits: first_difference.is_none(), first_difference, frames, seams: [] })
}

fn bits(x: Vec3) -> [u32; 3] {
    x.to_array().map(f32::to_bits)
}

impl FrameDistance {
    /// Columns of the table and the CSV: name, value.
    fn columns(&self) -> Vec<(&'static str, Option<f64>)> {
        let mut columns = vec![
            ("rms_m", Some(self.rms_m)),
            ("max_m", Some(self.max_m)),
            ("aligned_rms_m", Some(self.aligned_rms_m)),
            ("eq17_theta", Some(self.eq17_theta)),
            ("eq17_curvature", Some(self.eq17_curvature)),
            ("velocity_rms_m_s", self.velocity_rms_m_s),
        ];
        if self.floor_rms_m.is_some() {
            columns.push(("floor_rms_m", self.floor_rms_m));
            columns.push(("floor_eq17_theta", self.floor_eq17_theta));
            columns.push(("floor_eq17_curvature", self.floor_eq17_curvature));
        }
        columns
    }
}

/// Column names: those of the frame with the most.
fn heads(findings: &Findings) -> Vec<&'static str> {
    let widest = findings.frames.iter().map(FrameDistance::columns).max_by_key(Vec::len).unwrap_or_default();
    widest.into_iter().map(|(name, _)| name).collect()
}

fn csv(findings: &Findings) -> String {
    let heads = heads(findings);
    let mut text = format!("frame,{}\n", heads.join(","));
    for frame in &findings.frames {
        let columns = frame.columns();
        let value = |name: &&str| columns.iter().find(|(head, _)| head == name).and_then(|(_, value)| *value);
        let cells = heads.iter().map(|head| match value(head).filter(|v| v.is_finite()) {
            Some(value) => format!("{value:e}"),
            None => String::new(),
        });
        let _ = writeln!(text, "{},{}", frame.frame, cells.collect::<Vec<_>>().join(","));
    }
    text
}

fn table(findings: &Findings) -> String {
    let heads = heads(findings);
    let mut text = match findings.first_difference {
        None => "equal bits in all frames\n".to_string(),
        Some(frame) => format!("first difference: frame {frame}\n"),
    };
    let _ = writeln!(text, "frame  {}", heads.join("  "));
    for frame in &findings.frames {
        let columns = frame.columns();
        let _ = write!(text, "{:>5}", frame.frame);
        for head in &heads {
            let value = columns.iter().find(|(name, _)| name == head).and_then(|(_, value)| *value);
            let cell = value.filter(|v| v.is_finite()).map_or("-".to_string(), |v| format!("{v:.3e}"));
            let _ = write!(text, "  {cell:>width$}", width = head.len());
        }
        text.push('\n');
    }
    text
}

fn draw(path: &Path, args: &CompareArgs, findings: &Findings) -> Result<(), CliError> {
    let line = |name: &str, value: &dyn Fn(&FrameDistance) -> Option<f64>| Series {
        name: name.to_string(),
        points: findings.frames.iter().filter_map(|f| Some((f64::from(f.frame), 1e3 * value(f)?))).collect(),
    };
    let mut series = vec![line("B from A", &|f| Some(f.rms_m)), line("B from A, aligned", &|f| Some(f.aligned_rms_m))];
    if args.floor.is_some() {
        series.push(line("floor from A", &|f| f.floor_rms_m));
    }
    let title = format!("A = {}, B = {}", args.a.display(), args.b.display());
    line_chart(path, &title, "frame", "rms distance, mm", &series).map_err(CliError::failed)
}
