//! `run --start-from RUN[:frame]`: where the cloth of a run starts if another run has been there before.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::math::{DVec3, Vec3};
use crate::mesh::{NearestPoint, extent};
use crate::output::{Checkpoint, FrameSource, Report, RunDirectory, RunManifest, checkpoint};
use crate::scene::{GivenStart, Grip, Overrides, ParsedScene, Scene, read_str};
use crate::time_parallel::Upsampling;

/// A run and a frame of it; without a frame its newest state.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct StartFrom {
    /// The run directory.
    pub run: PathBuf,
    /// The frame.
    pub frame: Option<u32>,
}

impl FromStr for StartFrom {
    type Err = String;

    fn from_str(text: &str) -> Result<StartFrom, String> {
        // A path may have a colon in it, so only a number behind one is a frame.
        let split = text.rsplit_once(':').and_then(|(run, frame)| Some((run, frame.parse().ok()?)));
        match split {
            Some(("", _)) | None if text.is_empty() || split.is_some() => {
                Err(format!("'{text}' names no run; write RUN or RUN:FRAME, such as out/flag:100"))
            }
            Some((run, frame)) => Ok(StartFrom { run: run.into(), frame: Some(frame) }),
            None => Ok(StartFrom { run: text.into(), frame: None }),
        }
    }
}

impl fmt::Display for StartFrom {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.frame {
            Some(frame) => write!(f, "{}:{frame}", self.run.display()),
            None => write!(f, "{}", self.run.display()),
        }
    }
}

impl TryFrom<String> for StartFrom {
    type Error = String;

    fn try_from(text: String) -> Result<StartFrom, String> {
        text.parse()
    }
}

impl From<StartFrom> for String {
    fn from(start: StartFrom) -> String {
        start.to_string()
    }
}

/// Coarser levels that are tried for the mesh of the other run.
const LEVELS: usize = 3;

/// Positions and velocities in another run.
struct Found {
    given: GivenStart,
    /// What was found, as a sentence.
    line: String,
}

impl StartFrom {
    /// Positions and velocities for the cloth of `parsed` at the resolution of `overrides`, and a sentence about where
    /// they are from. A run on coarser levels of the same sheets is taken to the finer ones.
    ///
    /// # Errors
    /// The run cannot be read, has no such frame, or its mesh is another; one sentence.
    pub fn find(&self, parsed: &ParsedScene, overrides: &Overrides) -> Result<(GivenStart, String), String> {
        let directory = RunDirectory::open(&self.run).map_err(|error| format!("--start-from: {error}"))?;
        let report = Report::load(&directory.report()).map_err(|error| format!("--start-from: {error}"))?;
        let origin_m = DVec3::from(report.header.local_origin_m);
        let source = FrameSource::open(&directory).map_err(|error| format!("--start-from: {error}"))?.about(origin_m);
        let numbers = source.numbers();
        if let Some(frame) = self.frame.filter(|frame| !numbers.contains(frame)) {
            let (first, last) = (numbers[0], numbers[numbers.len() - 1]);
            return Err(format!("--start-from: {} has no frame {frame}, only {first} to {last}", self.run.display()));
        }
        let read = |frame| source.read(frame).map_err(|error| format!("--start-from: {error}"));
        let triangles = read(numbers[0])?.triangles;
        let found = match self.kept(&directory, &report, origin_m) {
            Some(found) => found,
            None => {
                let frame = self.frame.unwrap_or(numbers[numbers.len() - 1]);
                let here = read(frame)?.positions;
                let before = numbers.iter().copied().filter(|&other| other < frame).next_back();
                let velocities = match before {
                    Some(before) if read(before)?.positions.len() == here.len() => {
                        let frame_s = report.header.step_s * f64::from(report.header.steps_per_frame);
                        let seconds = (frame_s * f64::from(frame - before)) as f32;
                        read(before)?.positions.iter().zip(&here).map(|(a, b)| (*b - *a) / seconds).collect()
                    }
                    Some(before) => {
                        let run = self.run.display();
                        return Err(format!(
                            "--start-from: frames {before} and {frame} of {run} have different meshes"
                        ));
                    }
                    None => vec![Vec3::ZERO; here.len()],
                };
                let line = format!(
                    "starts from frame {frame} of {}; no state is kept at or before it, so the velocities are {} \
                     (`--keep-states frames` keeps states)",
                    self.run.display(),
                    before.map_or("zero".into(), |before| format!("differences of frames {before} and {frame}"))
                );
                Found { given: GivenStart { positions: here, velocities, origin_m }, line }
            }
        };
        let fine = parsed.unchecked_at(overrides).map_err(|error| error.to_string())?;
        let vertices = found.given.positions.len();
        if fine.mesh.triangles == triangles && fine.mesh.positions.len() == vertices {
            return Ok((found.given, found.line));
        }
        self.finer(parsed, overrides, &fine, &triangles, found)
    }

    /// The newest kept state at or before the frame.
    fn kept(&self, directory: &RunDirectory, report: &Report, origin_m: DVec3) -> Option<Found> {
        let steps_per_frame = u64::from(report.header.steps_per_frame);
        let until = self.frame.map_or(u64::MAX, |frame| u64::from(frame) * steps_per_frame);
        let (path, Checkpoint { step, state, .. }) =
            checkpoint::newest_until(&[directory.states(), directory.checkpoints()], until)?;
        let wanted = self.frame.filter(|_| step != until);
        let line = format!(
            "starts from the state in {}{}",
            path.display(),
            wanted.map_or(String::new(), |frame| format!(
                ", after step {step}: the nearest that is kept at or before frame {frame} (step {until})"
            ))
        );
        Some(Found { given: GivenStart { positions: state.positions, velocities: state.velocities, origin_m }, line })
    }

    /// What was found on a coarser level of the same sheets, on the level of `fine`.
    fn finer(
        &self,
        parsed: &ParsedScene,
        overrides: &Overrides,
        fine: &Scene,
        triangles: &[[u32; 3]],
        found: Found,
    ) -> Result<(GivenStart, String), String> {
        for level in 1..=LEVELS {
            let Ok((coarse, refinements)) = parsed.unchecked_coarser_at(overrides, level) else { break };
            if coarse.mesh.triangles != triangles || coarse.mesh.positions.len() != found.given.positions.len() {
                continue;
            }
            let way = Upsampling::new(&coarse, fine, &refinements);
            let GivenStart { positions, velocities, origin_m } = found.given;
            let (positions, velocities) = (way.vectors(&positions), way.vectors(&velocities));
            let line = format!("{}, on sheets with {} times its triangles", found.line, 1 << (2 * level));
            return Ok((GivenStart { positions, velocities, origin_m }, line));
        }
        let from = from_surface(&self.run, triangles, fine, &found.given)
            .map_err(|what| format!("--start-from: {}: {what}", self.run.display()))?;
        let line = format!("{}, of {} triangles, here {}", found.line, triangles.len(), fine.mesh.triangles.len());
        Ok((from, line))
    }
}

/// Largest distance between a vertex and the other mesh of its piece at the start of both scenes, as a share of the
/// piece's extent.
const APART: f64 = 0.05;

/// Every vertex of `fine` where it hangs on the triangle of the other run that it is nearest to when both scenes start,
/// as pins hang on obstacles that they follow, with the mean of the velocities of its corners. Unlike a finer level
/// of a sheet this can cross; whoever takes it as a start has to check that. An error is half a sentence.
fn from_surface(run: &Path, triangles: &[[u32; 3]], fine: &Scene, found: &GivenStart) -> Result<GivenStart, String> {
    let directory = RunDirectory::open(run).map_err(|error| error.to_string())?;
    let manifest = RunManifest::load(&directory).map_err(|error| error.to_string())?;
    /// The options that decide on the mesh.
    #[derive(Default, Deserialize)]
    #[serde(default)]
    struct Size {
        resolution: Option<u64>,
    }
    let size: Size = manifest.flags().map_err(|error| error.to_string())?;
    let parsed = read_str(&manifest.text_to_read(), &manifest.scene_path).map_err(|error| error.to_string())?;
    let overrides = Overrides { resolution: size.resolution, frames: None };
    let other = parsed.unchecked_at(&overrides).map_err(|error| error.to_string())?;
    if other.mesh.triangles != triangles || other.mesh.positions.len() != found.positions.len() {
        return Err("its frames are of another mesh than that of its scene".into());
    }
    let names = |scene: &Scene| scene.cloths.iter().map(|cloth| cloth.name.clone()).collect::<Vec<_>>().join(", ");
    if other.cloths.len() != fine.cloths.len() {
        return Err(format!("it has other pieces of cloth ({}) than the scene ({})", names(&other), names(fine)));
    }
    let shift = fine.origin_m - other.origin_m;
    let values: &[f32] = bytemuck::cast_slice(&found.positions);
    let (mut positions, mut velocities) = (Vec::new(), Vec::new());
    for (theirs, own) in other.cloths.iter().zip(&fine.cloths) {
        let surface = &other.mesh.triangles[theirs.triangles.start as usize..theirs.triangles.end as usize];
        let nearest = NearestPoint::new(&other.mesh.positions, surface);
        let starts = &fine.mesh.positions[own.vertices.start as usize..own.vertices.end as usize];
        let bound = APART * extent(starts);
        let hung: Vec<(DVec3, Vec3, f64)> = starts
            .par_iter()
            .map(|start| {
                let start = start.as_dvec3() + shift;
                let Some(foot) = nearest.to(start) else { return (start, Vec3::ZERO, f64::INFINITY) };
                let corners = surface[foot.triangle];
                let rest = corners.map(|v| other.mesh.positions[v as usize].as_dvec3());
                let place = Grip::new(corners, rest, foot.weights, start).point_of(values);
                let shares = corners.iter().zip(foot.weights);
                let velocity = shares.map(|(&v, share)| found.velocities[v as usize].as_dvec3() * share).sum::<DVec3>();
                (place, velocity.as_vec3(), foot.distance_m)
            })
            .collect();
        if let Some((_, _, apart)) = hung.iter().find(|(_, _, apart)| *apart > bound) {
            return Err(format!(
                "`{}` of the scene starts up to {apart:.3} m away from `{}` there, so it is another cloth or lies \
                 elsewhere",
                own.name, theirs.name
            ));
        }
        positions.extend(hung.iter().map(|(place, _, _)| place.as_vec3()));
        velocities.extend(hung.iter().map(|(_, velocity, _)| *velocity));
    }
    Ok(GivenStart { positions, velocities, origin_m: other.origin_m })
}

/// The start that a run has kept for its resumption.
///
/// # Errors
/// The file cannot be read or is damaged; one sentence.
pub(super) fn kept_start(path: &Path, origin_m: DVec3) -> Result<GivenStart, String> {
    let bytes = std::fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
    let kept = Checkpoint::from_bytes(&bytes).map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(GivenStart { positions: kept.state.positions, velocities: kept.state.velocities, origin_m })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_and_a_frame() {
        let parsed = |text: &str| text.parse::<StartFrom>().map(|start| (start.run, start.frame));
        assert_eq!(parsed("out/flag"), Ok(("out/flag".into(), None)));
        assert_eq!(parsed("out/flag:12"), Ok(("out/flag".into(), Some(12))));
        assert_eq!(parsed("C:out:7"), Ok(("C:out".into(), Some(7))));
        assert_eq!(parsed("a:b"), Ok(("a:b".into(), None)));
        assert!(parsed("").is_err() && parsed(":3").is_err());
        let start: StartFrom = "out/flag:12".parse().unwrap();
        assert_eq!(start.to_string(), "out/flag:12");
    }
}
