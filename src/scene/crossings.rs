//! What is known of a start state that crosses: the sentence of its refusal, and what untangling did.

use std::fmt;
use std::path::PathBuf;

use crate::math::Vec3;
use crate::mesh::MOST_PAIRS;

/// Pairs that meet, and where they are.
#[derive(Clone, Debug, PartialEq)]
pub struct Crossings {
    /// The triangles of the first pair, such as "triangle 1 of `flag`", counting from 1.
    pub first: [String; 2],
    /// Pairs that have been found; the search ends at about 10,000.
    pub pairs: usize,
    /// Positions of the triangles that meet, three each, metres.
    pub positions: Vec<Vec3>,
    /// The command that writes a mesh of them.
    pub command: String,
    /// A file that holds a mesh of them, if there is one already.
    pub written: Option<PathBuf>,
    /// What splits them, if it is a seam of a mesh that has its vertices twice.
    pub doubled: Option<Doubled>,
    /// How far untangling went, if it was asked for: then all of the above is about its best state.
    pub best: Option<BestState>,
}

/// A piece of cloth that has vertices at the place of other ones: exporters split seams of texture and of parts so.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Doubled {
    /// Name of the piece.
    pub cloth: String,
    /// Its vertices that lie exactly at the place of an earlier one.
    pub vertices: usize,
    /// Pairs of triangles that meet there.
    pub pairs: usize,
}

/// What untangling that failed has reached.
#[derive(Clone, Debug, PartialEq)]
pub struct BestState {
    /// Pairs that met at the start.
    pub pairs_before: usize,
    /// Positions of the cloth, metres.
    pub positions: Vec<Vec3>,
    /// Triangles of the cloth.
    pub triangles: Vec<[u32; 3]>,
    /// A file that holds this mesh, if there is one already.
    pub written: Option<PathBuf>,
}

/// A start state that was untangled.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Untangling {
    /// Pairs of triangles that met before; the search ends at 10,000.
    pub pairs: usize,
    /// Rounds of pushing.
    pub rounds: usize,
    /// Vertices that were moved.
    pub vertices_moved: usize,
    /// Longest way that a vertex was moved, metres.
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
            // The search ends with a full list.
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
    /// The triangles that meet as vertex indices of [`Crossings::positions`].
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        (0..self.positions.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect()
    }
}
