//! The input of untangling.

use crate::mesh::Group;

/// A mesh that crosses itself, with the vertices that untangling may move.
#[derive(Clone, Copy, Debug)]
pub struct Tangle<'a> {
    /// Triangles of cloth and obstacles.
    pub triangles: &'a [[u32; 3]],
    /// Groups of the triangles, ascending, as for [`crate::mesh::crossings`].
    pub groups: &'a [Group],
    /// True for each vertex that may move; always false for obstacles.
    pub movable: &'a [bool],
    /// Target distance between surfaces that were pushed apart, meters, above 0.
    pub gap_m: f64,
}
