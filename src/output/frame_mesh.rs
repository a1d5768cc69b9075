//! The mesh of a frame as its file holds it, and why bytes are none.

use thiserror::Error;

use crate::math::Vec3;

/// A mesh as a frame holds it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameMesh {
    /// World positions, metres.
    pub positions: Vec<Vec3>,
    /// Vertex indices, all valid.
    pub triangles: Vec<[u32; 3]>,
}

impl FrameMesh {
    /// The mesh, if all its vertex indices are valid.
    pub(super) fn checked(self) -> Result<FrameMesh, ReadError> {
        let vertices = self.positions.len();
        match self.triangles.iter().position(|t| t.iter().any(|i| *i as usize >= vertices)) {
            Some(triangle) => Err(ReadError::Index { triangle, vertices }),
            None => Ok(self),
        }
    }
}

/// Why bytes are not a frame that `output` wrote.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum ReadError {
    /// A PLY header of another layout.
    #[error("{0}")]
    Header(&'static str),
    /// Fewer bytes than announced.
    #[error("it is cut off: shorter than its {vertices} vertices and {triangles} triangles need")]
    Truncated {
        /// Vertices announced.
        vertices: usize,
        /// Triangles announced.
        triangles: usize,
    },
    /// A bad line of an OBJ.
    #[error("line {line} {problem}")]
    Line {
        /// Counted from 1.
        line: usize,
        /// What is wrong with it.
        problem: &'static str,
    },
    /// A triangle names a vertex that does not exist.
    #[error("triangle {triangle} (from 0) names a vertex beyond the {vertices} there are")]
    Index {
        /// Triangle, from 0.
        triangle: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
}
