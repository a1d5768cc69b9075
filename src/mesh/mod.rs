//! Triangle meshes: storage, adjacency, rest shape, ordering, OBJ and PLY files.

use crate::math::{Vec2, Vec3};

/// A triangle mesh of cloth in its start state. Counter-clockwise triangles; every vertex is used by a triangle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// World positions at time 0, metres.
    pub positions: Vec<Vec3>,
    /// Vertex indices of every triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Material-space (rest) coordinates of every triangle's corners, metres: x = warp, y = weft. Kept per corner, so
    /// that a seam (one vertex, several texture coordinates) is no special case.
    pub material_uv: Vec<[Vec2; 3]>,
}
