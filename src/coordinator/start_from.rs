//! `run --start-from RUN[:frame]`: where the cloth of a run starts if another run has been there before.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::math::{DVec3, Vec3};
use crate::output::{Checkpoint, FrameSource, Report, RunDirectory, checkpoint};
use crate::scene::{GivenStart, Overrides, ParsedScene, Scene};
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
        Err(format!(
            "--start-from: the cloth of {} has {} triangles and is another mesh than that of the scene, which has {}; \
             it must be the same, or a coarser level of its sheets, as the coarse run of --segments has",
            self.run.display(),
            triangles.len(),
            fine.mesh.triangles.len()
        ))
    }
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
