//! What a scene file says of a piece of cloth, before the piece has a resolution.

use crate::math::{DVec3, Vec3};
use crate::mesh::FileMesh;

use super::error::Place;
use super::fabric::Fabric;
use super::placement::Placement;

/// A piece of cloth at no resolution yet.
#[derive(Clone, Debug)]
pub(super) struct ClothSource {
    /// Shown in messages and selected by pins.
    pub name: String,
    pub shape: Shape,
    pub velocity: StartVelocity,
    pub fabric: Fabric,
    /// Friction coefficient of its own, if it has one.
    pub friction: Option<f64>,
}

/// What a piece of cloth is made from.
#[derive(Clone, Debug)]
pub(super) enum Shape {
    /// A rectangle, meshed at the resolution that is asked for.
    Sheet(SheetSource),
    /// The mesh of a file at its place in the scene; the same at every resolution.
    Mesh(FileMesh),
}

/// A rectangle of cloth.
#[derive(Clone, Debug)]
pub(super) struct SheetSource {
    pub size_m: [f64; 2],
    /// Directions of warp and weft before it is placed.
    pub axes: [DVec3; 2],
    pub placement: Placement,
    /// Triangles where no resolution is asked for; a fraction, so that shares add up.
    pub triangles: f64,
    pub at: Place,
}

/// Start velocity of the vertices, m/s.
#[derive(Clone, Debug)]
pub(super) enum StartVelocity {
    Same(Vec3),
    /// One per vertex of a mesh from a file.
    PerVertex(Vec<Vec3>),
}

impl ClothSource {
    pub(super) fn sheet(&self) -> Option<&SheetSource> {
        match &self.shape {
            Shape::Sheet(sheet) => Some(sheet),
            Shape::Mesh(_) => None,
        }
    }
}
