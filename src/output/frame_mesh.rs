//! The mesh in the file of a frame, and the errors of reading it.

use thiserror::Error;

use crate::math::Vec3;

/// The mesh of a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameMesh {
    /// World positions or positions relative to a local origin, meters.
    pub positions: Vec<Vec3>,
    /// Vertex indices, all valid.
    pub triangles: Vec<[u32; 3]>,
}

impl FrameMesh {
    /// Returns the mesh if all its vertex indices are valid.
    pub(super) fn checked(self) -> Result<FrameMesh, ReadError> {
        let vertices = self.positions.len();
        match self.triangles.iter().position(|t| t.iter().any(|i| *i as usize >= vertices)) {
            Some(triangle) => Err(ReadError::Index { triangle, vertices }),
            None => Ok(self),
        }
    }
}

/// Why bytes are not a frame written by `output`.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum ReadError {
    /// The PLY header has another layout.
    #[error("{0}")]
    Header(&'static str),
    /// There are fewer bytes than the header announces.
    #[error("it is cut off: shorter than its {vertices} vertices and {triangles} triangles need")]
    Truncated {
        /// Vertices announced.
        vertices: usize,
        /// Triangles announced.
        triangles: usize,
    },
    /// A line of an OBJ file is malformed.
    #[error("line {line} {problem}")]
    Line {
        /// Counted from 1.
        line: usize,
        /// Description of the error.
        problem: &'static str,
    },
    /// A triangle refers to a missing vertex.
    #[error("triangle {triangle} (from 0) names a vertex beyond the {vertices} there are")]
    Index {
        /// Triangle, from 0.
        triangle: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
}
