//! Animations of finished frames in the formats of other programs. `loomtree convert` uses it.

mod alembic;
mod crate_file;
mod glb;
mod mdd;
mod ogawa;
mod usda;
mod usdc;
mod vtu;

use std::io::{self, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::pc2::Pc2Error;
use super::{FrameMesh, FrameSource, FramesError, WriteError, write_atomically};
use crate::math::{Vec2, Vec3};

pub use alembic::write_abc;
pub use glb::write_glb;
pub use mdd::write_mdd;
pub use usda::write_usda;
pub use usdc::write_usdc;
pub use vtu::{write_pvd, write_vtu};

/// A piece of cloth or an obstacle: a mesh whose vertices move and whose triangles stay.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Name in the files.
    pub name: String,
    /// True for an obstacle.
    pub obstacle: bool,
    /// Its vertices among those of all cloth, or of all obstacles.
    pub vertices: Range<usize>,
    /// Its triangles among those of all cloth, or of all obstacles.
    pub triangles: Range<usize>,
    /// Material coordinates of the corners of its triangles, meters; empty if it has none.
    pub uv: Vec<[Vec2; 3]>,
}

/// Why an animation cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// A frame cannot be read.
    #[error(transparent)]
    Frames(#[from] FramesError),
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A point cache cannot be written.
    #[error(transparent)]
    PointCache(#[from] Pc2Error),
    /// A frame does not have the vertices that the run has.
    #[error("frame {frame} in {} has no vertices for `{name}`: it belongs to another run", folder.display())]
    Lacks {
        /// The run.
        folder: PathBuf,
        /// Number of the frame.
        frame: u32,
        /// Piece or obstacle.
        name: String,
    },
    /// The animation is too large for its format.
    #[error("{0}")]
    TooLarge(String),
}

/// The frames of a run with the names of what is in them.
pub struct Animation {
    /// The frames.
    pub source: FrameSource,
    /// The run directory, for messages.
    pub folder: PathBuf,
    /// Frames per second.
    pub frames_per_s: f64,
    /// True: z points up. False: y does.
    pub z_up: bool,
    /// Pieces of cloth, then obstacles.
    pub tracks: Vec<Track>,
    /// Further values of the cloth's vertices, for formats that hold such.
    pub values: Option<Box<VertexValues>>,
}

/// Named values of all vertices of the cloth, of a frame and the positions in it: one or three per vertex.
pub type VertexValues = dyn Fn(u32, &[Vec3]) -> Vec<(&'static str, Vec<f32>)>;

impl Animation {
    /// Numbers of the frames, ascending; at least one.
    pub fn frames(&self) -> Vec<u32> {
        self.source.numbers()
    }

    /// Time of a frame, seconds.
    pub fn time_s(&self, frame: u32) -> f64 {
        f64::from(frame) / self.frames_per_s
    }

    /// The positions of a track in a frame, and its triangles, numbered from its first vertex.
    pub fn mesh(&self, track: &Track, frame: u32) -> Result<FrameMesh, ExportError> {
        let whole = match track.obstacle {
            true => self.source.read_obstacle(frame)?.unwrap_or_default(),
            false => self.source.read(frame)?,
        };
        let first = track.vertices.start as u32;
        let positions = whole.positions.get(track.vertices.clone());
        let triangles = whole.triangles.get(track.triangles.clone());
        let local = |corners: &[u32; 3]| corners.map(|v| v.wrapping_sub(first));
        match (positions, triangles) {
            (Some(positions), Some(triangles)) => {
                let triangles: Vec<[u32; 3]> = triangles.iter().map(local).collect();
                if triangles.iter().flatten().all(|&v| (v as usize) < positions.len()) {
                    return Ok(FrameMesh { positions: positions.to_vec(), triangles });
                }
                Err(self.lacks(track, frame))
            }
            _ => Err(self.lacks(track, frame)),
        }
    }

    /// The positions of all tracks in a frame, in their order.
    pub fn points(&self, frame: u32) -> Result<Vec<Vec<Vec3>>, ExportError> {
        let cloth = self.source.read(frame)?;
        let obstacles = match self.tracks.iter().any(|track| track.obstacle) {
            true => self.source.read_obstacle(frame)?.unwrap_or_default(),
            false => FrameMesh::default(),
        };
        let of = |track: &Track| {
            let whole = if track.obstacle { &obstacles } else { &cloth };
            let own = whole.positions.get(track.vertices.clone());
            own.map(<[Vec3]>::to_vec).ok_or_else(|| self.lacks(track, frame))
        };
        self.tracks.iter().map(of).collect()
    }

    fn lacks(&self, track: &Track, frame: u32) -> ExportError {
        ExportError::Lacks { folder: self.folder.clone(), frame, name: track.name.clone() }
    }
}

/// Why a file that is made of frames is not written: because of the file, or of a frame.
enum Stop {
    File(io::Error),
    Frame(ExportError),
}

impl From<io::Error> for Stop {
    fn from(error: io::Error) -> Stop {
        Stop::File(error)
    }
}

impl From<ExportError> for Stop {
    fn from(error: ExportError) -> Stop {
        Stop::Frame(error)
    }
}

/// Like [`write_atomically`] for content that is made of frames.
fn write_frames(path: &Path, write: impl FnOnce(&mut dyn Write) -> Result<(), Stop>) -> Result<(), ExportError> {
    let mut fault = None;
    let result = write_atomically(path, |out| match write(out) {
        Ok(()) => Ok(()),
        Err(Stop::File(error)) => Err(error),
        Err(Stop::Frame(error)) => {
            fault = Some(error);
            Err(io::Error::other("a frame cannot be read"))
        }
    });
    fault.map_or_else(|| result.map_err(ExportError::Write), Err)
}

/// The names of tracks with the characters that all formats and file systems allow, each once.
pub fn plain_names(tracks: &[Track]) -> Vec<String> {
    let mut names: Vec<String> = Vec::with_capacity(tracks.len());
    for track in tracks {
        let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
        let mut name: String = track.name.chars().map(plain).collect();
        if !name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_') {
            name.insert(0, '_');
        }
        let mut unique = name.clone();
        for number in 2.. {
            if !names.contains(&unique) {
                break;
            }
            unique = format!("{name}_{number}");
        }
        names.push(unique);
    }
    names
}

/// The box around points; zero without points.
fn bounds(points: &[Vec3]) -> [Vec3; 2] {
    let start = points.first().copied().unwrap_or_default();
    points.iter().fold([start; 2], |[low, high], &p| [low.min(p), high.max(p)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_plain_and_differ() {
        let track =
            |name: &str| Track { name: name.into(), obstacle: false, vertices: 0..0, triangles: 0..0, uv: vec![] };
        let tracks = ["cloth 0", "cloth_0", "7", "", "Ärmel"].map(track);
        assert_eq!(plain_names(&tracks), ["cloth_0", "cloth_0_2", "_7", "_", "_rmel"]);
    }
}
