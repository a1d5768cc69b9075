//! Elementary tests between the two parts of a stencil, a vertex and a face or two edges: closest points, proximity,
//! continuous collision, and the exact static test of an edge against a triangle.
//!
//! Functions of a few vectors, without allocation and without state; nothing here knows about meshes. Stencils whose
//! parts share a vertex always touch: the broad phase must not ask for them.

// What is no number must compare as "proves nothing": conditions are negated where that needs it.
#[allow(clippy::neg_cmp_op_on_partial_ord)]
mod ccd;
#[allow(clippy::neg_cmp_op_on_partial_ord)]
mod closest;
pub mod lanes;
#[allow(clippy::neg_cmp_op_on_partial_ord)]
mod planes;
mod real;

pub use ccd::{Ccd, DecidedBy, Filtered, ccd, ccd_fallback, ccd_filter};
pub use closest::{Closest, Feature, Proximity, closest_offset, closest_points, proximity};
// Lives with the start-state check of a mesh, which uses it too.
pub use crate::mesh::edge_crosses_triangle;

use crate::math::Vec3;

/// What the two parts of a stencil are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum StencilKind {
    /// A vertex and a triangle.
    VertexFace,
    /// Two edges.
    EdgeEdge,
}

/// Four vertices that may collide: vertex, then the face's three (vertex-face); two of the first edge, then two of the
/// second (edge-edge).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Stencil {
    /// Vertex indices.
    pub vertices: [u32; 4],
    /// What they are.
    pub kind: StencilKind,
}

impl Stencil {
    /// The positions of the stencil's vertices.
    pub fn gather(&self, positions: &[Vec3]) -> [Vec3; 4] {
        self.vertices.map(|v| positions[v as usize])
    }
}
