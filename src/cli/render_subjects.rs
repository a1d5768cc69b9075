//! The runs that `loomtree render` draws: frames, names of their parts, values of their vertices.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use serde_json::Value;

use super::CliError;
use crate::coordinator::RunOptions;
use crate::math::{DVec3, Vec3};
use crate::output::picture::{Coloring, Subject, Target, UpAxis, VertexValues};
use crate::output::{FrameSource, Report, RunDirectory, RunManifest};
use crate::view::Known;

/// Frames per second of a run without a report.
const FPS: f64 = 25.0;

/// Runs that are drawn side by side.
pub(super) struct Runs {
    directories: Vec<RunDirectory>,
    sources: Vec<FrameSource>,
    names: Vec<String>,
}

/// What the names on the command line mean for each run.
pub(super) struct Parts {
    pub(super) target: Target,
    runs: Vec<OfRun>,
}

#[derive(Default)]
struct OfRun {
    hidden: Vec<Range<usize>>,
    hidden_obstacles: Vec<Range<usize>>,
    known: Option<Values>,
    cuts: Vec<f64>,
}

/// The recorded scene of a run; contacts need it for themselves.
struct Values(Mutex<Known>);

impl VertexValues for Values {
    fn values(&self, coloring: Coloring, frame: u32, positions: &[Vec3]) -> Result<Vec<f32>, String> {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match coloring {
            Coloring::Rank => Ok(known.ranks()),
            Coloring::Strain => known.strain(positions),
            _ => known.contact(positions, frame),
        }
    }
}

impl Runs {
    /// Opens the runs; all are drawn about the local origin of the first.
    pub(super) fn open(paths: &[PathBuf]) -> Result<Runs, CliError> {
        let mut runs = Runs { directories: Vec::new(), sources: Vec::new(), names: Vec::new() };
        let mut origin_m = None;
        for path in paths {
            let directory = RunDirectory::open(path).map_err(CliError::bad_input)?;
            let source = FrameSource::open_with_coarse(&directory).map_err(CliError::bad_input)?;
            let origin_m = *origin_m.get_or_insert_with(|| recorded_origin(&directory));
            runs.sources.push(source.about(origin_m));
            runs.directories.push(directory);
            runs.names.push(path.display().to_string());
        }
        Ok(runs)
    }

    /// Frames that all of them have, ascending.
    pub(super) fn numbers(&self) -> Vec<u32> {
        let mut numbers = self.sources[0].numbers();
        for source in &self.sources[1..] {
            let other = source.numbers();
            numbers.retain(|number| other.binary_search(number).is_ok());
        }
        numbers
    }

    pub(super) fn is_coarse(&self, frame: u32) -> bool {
        self.sources.iter().any(|source| source.is_coarse(frame))
    }

    pub(super) fn up(&self) -> UpAxis {
        recorded_up(&self.directories[0])
    }

    pub(super) fn origin_m(&self) -> DVec3 {
        recorded_origin(&self.directories[0])
    }

    pub(super) fn pictures(&self) -> PathBuf {
        self.directories[0].pictures()
    }

    /// Frames per second of the first run's time.
    pub(super) fn frames_per_second(&self) -> f64 {
        let header = Report::load(&self.directories[0].report()).map(|report| report.header);
        let frame_s = header.map_or(0.0, |header| header.step_s * f64::from(header.steps_per_frame));
        if frame_s > 0.0 { 1.0 / frame_s } else { FPS }
    }

    /// Resolves the names of the command line and what its coloring needs.
    pub(super) fn parts(&self, hide: &[String], target: &str, coloring: Coloring) -> Result<Parts, CliError> {
        let plain = plain_target(target)?;
        let needs_scene = !hide.is_empty() || plain.is_none() || coloring.needs_scene();
        let mut parts = Parts { target: plain.clone().unwrap_or_default(), runs: Vec::new() };
        for (i, directory) in self.directories.iter().enumerate() {
            let mut own = OfRun::default();
            if coloring == Coloring::Segment {
                own.cuts = cuts(directory);
            }
            if needs_scene {
                let known = Known::load(directory).map_err(|what| {
                    CliError::bad_input(format!("{}: the recorded scene is needed for that: {what}", self.names[i]))
                })?;
                let names = known.names();
                for name in hide {
                    match find(&names, name).ok_or_else(|| unknown("--hide", name, &names, &self.names[i]))? {
                        Found::Piece(range) => own.hidden.push(range),
                        Found::Obstacle(range) => own.hidden_obstacles.push(range),
                    }
                }
                if plain.is_none() && i == 0 {
                    parts.target = match find(&names, target) {
                        Some(Found::Piece(range)) => Target::Piece(range),
                        Some(Found::Obstacle(range)) => Target::Obstacle(self.vertices(i, range)?),
                        None => return Err(unknown("--target", target, &names, &self.names[i])),
                    };
                }
                own.known = Some(Values(Mutex::new(known)));
            }
            parts.runs.push(own);
        }
        Ok(parts)
    }

    /// Vertices of these triangles of a run's obstacles, which are numbered one obstacle after the other.
    fn vertices(&self, run: usize, triangles: Range<usize>) -> Result<Range<usize>, CliError> {
        let source = &self.sources[run];
        let first = source.numbers().first().copied().unwrap_or(0);
        let mesh = source.read_obstacle(first).map_err(CliError::bad_input)?.unwrap_or_default();
        let corners = || mesh.triangles.get(triangles.clone()).unwrap_or_default().iter().flatten();
        match corners().min().zip(corners().max()) {
            Some((low, high)) => Ok(*low as usize..*high as usize + 1),
            None => Ok(0..0),
        }
    }

    /// What is drawn.
    pub(super) fn subjects<'a>(&'a self, parts: &'a Parts) -> Vec<Subject<'a>> {
        let runs = self.sources.iter().zip(&self.names).zip(&parts.runs);
        let subject = |((source, name), own): ((&'a FrameSource, &String), &'a OfRun)| Subject {
            source,
            name: name.clone(),
            hidden: own.hidden.clone(),
            hidden_obstacles: own.hidden_obstacles.clone(),
            cuts: own.cuts.clone(),
            known: own.known.as_ref().map(|known| known as &dyn VertexValues),
        };
        runs.map(subject).collect()
    }
}

/// Where the segments of a split shot begin, in frames; the first is not among them.
fn cuts(directory: &RunDirectory) -> Vec<f64> {
    let options = RunManifest::load(directory).ok().and_then(|manifest| manifest.flags::<RunOptions>().ok());
    let report = Report::load(&directory.report()).ok();
    let steps = report.map_or(1, |report| report.header.steps_per_frame.max(1));
    let cuts = options.map(|options| options.time.cuts).unwrap_or_default();
    cuts.into_iter().filter(|cut| *cut > 0).map(|cut| f64::from(cut) / f64::from(steps)).collect()
}

enum Found {
    /// Vertices of the cloth.
    Piece(Range<usize>),
    /// Triangles of the obstacles.
    Obstacle(Range<usize>),
}

fn find(names: &Value, wanted: &str) -> Option<Found> {
    let of = |kind: &str| {
        let found = names[kind].as_array()?.iter().find(|part| part["name"] == wanted)?;
        Some(found["from"].as_u64()? as usize..found["to"].as_u64()? as usize)
    };
    of("pieces").map(Found::Piece).or_else(|| of("obstacles").map(Found::Obstacle))
}

fn unknown(flag: &str, name: &str, names: &Value, run: &str) -> CliError {
    let of = |kind: &str| {
        let parts = names[kind].as_array().into_iter().flatten();
        let names: Vec<&str> = parts.filter_map(|part| part["name"].as_str()).collect();
        if names.is_empty() { "none".to_string() } else { names.join(", ") }
    };
    let (pieces, obstacles) = (of("pieces"), of("obstacles"));
    CliError::bad_input(format!(
        "{flag} {name}: {run} has no part of this name; its pieces: {pieces}; its obstacles: {obstacles}"
    ))
}

/// The local origin from the report; zero if there is no report.
pub(super) fn recorded_origin(directory: &RunDirectory) -> DVec3 {
    Report::load(&directory.report()).map_or(DVec3::ZERO, |report| DVec3::from_array(report.header.local_origin_m))
}

/// The up axis from the report; z if there is no report.
pub(super) fn recorded_up(directory: &RunDirectory) -> UpAxis {
    let report = Report::load(&directory.report()).ok();
    report.and_then(|r| r.header.up_axis.parse().ok()).unwrap_or_default()
}

/// The target that is not a name; none for a name.
fn plain_target(text: &str) -> Result<Option<Target>, CliError> {
    match text {
        "auto" => return Ok(Some(Target::Auto)),
        "cloth" => return Ok(Some(Target::Cloth)),
        "all" => return Ok(Some(Target::All)),
        _ => {}
    }
    let numbers: Vec<Option<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    match numbers[..] {
        [Some(x), Some(y), Some(z)] if [x, y, z].iter().all(|v| v.is_finite()) => {
            Ok(Some(Target::Point(DVec3::new(x, y, z))))
        }
        _ if numbers.len() > 1 => Err(CliError::bad_input(format!("--target {text}: a point is X,Y,Z in meters"))),
        _ => Ok(None),
    }
}
