//! The input of untangling.

use crate::mesh::Group;

/// A mesh that crosses itself, and which of its vertices may be moved.
#[derive(Clone, Copy, Debug)]
pub struct Tangle<'a> {
    /// Triangles of everything.
    pub triangles: &'a [[u32; 3]],
    /// What they belong to, ascending; as [`crate::mesh::crossings`] has them.
    pub groups: &'a [Group],
    /// Whether each vertex may be moved; vertices of obstacles never are.
    pub movable: &'a [bool],
    /// Distance that is aimed at between what was pushed apart, meters. Above 0.
    pub gap_m: f64,
}
