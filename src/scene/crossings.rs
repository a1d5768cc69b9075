//! Report about a start state that crosses itself: the sentence of the refusal and the result of untangling.

use std::fmt;
use std::path::PathBuf;

use crate::math::{DVec3, Vec3};
use crate::mesh::MOST_PAIRS;

/// Pairs of triangles that cross or touch at the start.
#[derive(Clone, Debug, PartialEq)]
pub struct Crossings {
    /// The triangles of the first pair, such as "triangle 1 of `flag`", counting from 1.
    pub first: [String; 2],
    /// Number of pairs found. The search ends at about 10,000.
    pub pairs: usize,
    /// The local origin of the scene, meters.
    pub origin_m: DVec3,
    /// Positions of the triangles that cross, three per triangle, relative to the local origin, meters.
    pub positions: Vec<Vec3>,
    /// A command that writes a mesh of these triangles.
    pub command: String,
    /// File with a mesh of these triangles, once it has been written.
    pub written: Option<PathBuf>,
    /// The split seam that causes crossings, if there is one.
    pub doubled: Option<Doubled>,
    /// Result of an untangling that failed. If it is set, the other fields describe the state that it reached.
    pub best: Option<BestState>,
}

/// A piece of cloth with several vertices at one place, as exporters make them where they split texture seams or parts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Doubled {
    /// Name of the piece.
    pub cloth: String,
    /// Vertices that lie exactly at the place of an earlier vertex.
    pub vertices: usize,
    /// Pairs of triangles that cross there.
    pub pairs: usize,
}

/// Best state that an untangling reached before it gave up.
#[derive(Clone, Debug, PartialEq)]
pub struct BestState {
    /// Pairs that crossed before.
    pub pairs_before: usize,
    /// Positions of the cloth, relative to the local origin, meters.
    pub positions: Vec<Vec3>,
    /// Triangles of the cloth.
    pub triangles: Vec<[u32; 3]>,
    /// File with this mesh, once it has been written.
    pub written: Option<PathBuf>,
}

/// Figures of a successful untangling.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Untangling {
    /// Pairs of triangles that crossed before. The search ends at 10,000.
    pub pairs: usize,
    /// Iterations of the untangling.
    pub rounds: usize,
    /// Vertices that were moved.
    pub vertices_moved: usize,
    /// Largest displacement of a vertex, meters.
    pub largest_m: f64,
}

impl fmt::Display for Crossings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [one, other] = &self.first;
        if let Some(best) = &self.best {
            let (left, before) = (self.pairs, best.pairs_before);
            write!(f, "untangling did not end, {left} of {before} pairs of triangles are left: ")?;
        }
        write!(f, "{one} and {other} cross or touch at the start")?;
        match self.pairs {
            1 => {}
            2 => write!(f, ", and 1 more pair does")?,
            // A full list means that the search ended early.
            pairs if pairs >= MOST_PAIRS => write!(f, ", and at least {} more pairs do", pairs - 1)?,
            pairs => write!(f, ", and {} more pairs do", pairs - 1)?,
        }
        if let Some(Doubled { cloth, vertices, pairs }) = &self.doubled {
            write!(
                f,
                "; {pairs} of these pairs meet where `{cloth}` has {vertices} vertices at the place of others, as an exporter \
                 splits a seam: `weld_m = 1e-6` in its [[cloth]] joins them"
            )?;
            if *pairs == self.pairs {
                return Ok(());
            }
        }
        match &self.written {
            Some(file) => write!(f, "; move them apart ({} holds a mesh of them", file.display())?,
            None => write!(f, "; move them apart (`{}` writes a mesh of them", self.command)?,
        }
        match &self.best {
            Some(BestState { written: Some(file), .. }) => {
                write!(f, ", {} the best state of the cloth)", file.display())
            }
            Some(_) => write!(f, ")"),
            None if self.written.is_some() => write!(f, "), or let `--untangle` try"),
            None => write!(f, ")"),
        }
    }
}

impl Crossings {
    /// Triangles over [`Crossings::positions`].
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        (0..self.positions.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect()
    }
}
