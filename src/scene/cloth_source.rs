//! Description of a piece of cloth as a scene file gives it, before a resolution is chosen.

use crate::math::{DVec3, Vec3};
use crate::mesh::FileMesh;

use super::error::Place;
use super::fabric::Fabric;
use super::placement::Placement;

/// Source of a piece of cloth; a resolution turns it into a mesh.
#[derive(Clone, Debug)]
pub(super) struct ClothSource {
    /// Name in messages; pins select the cloth by it.
    pub name: String,
    pub shape: Shape,
    pub velocity: StartVelocity,
    pub fabric: Fabric,
    /// Friction coefficient of this piece; none = that of the scene.
    pub friction: Option<f64>,
}

/// Geometry of a piece of cloth.
#[derive(Clone, Debug)]
pub(super) enum Shape {
    /// A rectangle, meshed at the requested resolution.
    Sheet(SheetSource),
    /// A mesh from a file, already placed in the scene; the same at every resolution.
    Mesh(FileMesh),
}

/// A rectangle of cloth.
#[derive(Clone, Debug)]
pub(super) struct SheetSource {
    pub size_m: [f64; 2],
    /// Directions of warp and weft before the placement.
    pub axes: [DVec3; 2],
    pub placement: Placement,
    /// Triangles at the scene's own resolution. It is a fraction, so that the shares of several sheets add up.
    pub triangles: f64,
    pub at: Place,
}

/// Start velocity of the vertices, m/s.
#[derive(Clone, Debug)]
pub(super) enum StartVelocity {
    Same(Vec3),
    /// One velocity per vertex of a mesh from a file.
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
