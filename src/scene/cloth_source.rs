//! Description of a piece of cloth as a scene file gives it, before a resolution is chosen.

use std::path::PathBuf;

use crate::math::{DVec3, FAR_M, Vec3, bounds, local_origin};
use crate::mesh::{FileMesh, Outline};

use super::SceneError;
use super::error::Place;
use super::fabric::Fabric;
use super::maps::MapSource;
use super::pattern::Pattern;
use super::person::Garment;
use super::placement::{Placement, place_mesh};

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
    /// Pressure inside over that outside, Pa.
    pub pressure_pa: f64,
    pub maps: Vec<MapSource>,
    /// The body that flat panels are bent about.
    pub wrap: Option<Wrap>,
}

/// The obstacle that a cloth's panels are bent about.
#[derive(Clone, Debug)]
pub(super) struct Wrap {
    /// Index into the obstacles.
    pub obstacle: usize,
    pub at: Place,
}

/// Geometry of a piece of cloth.
#[derive(Clone, Debug)]
pub(super) enum Shape {
    /// A rectangle or disc, meshed at the requested resolution.
    Sheet(SheetSource),
    /// A garment of a person, meshed at the requested resolution.
    Garment(GarmentSource),
    /// The panels of a sewing pattern, meshed at the requested resolution.
    Pattern(PatternSource),
    /// A mesh from a file, placed relative to the scene's local origin; the same at every resolution.
    Mesh(FileMesh),
}

/// A rectangle or disc of cloth.
#[derive(Clone, Debug)]
pub(super) struct SheetSource {
    pub outline: Outline,
    /// Directions of warp and weft before the placement.
    pub axes: [DVec3; 2],
    /// In coordinates relative to the scene's local origin.
    pub placement: Placement,
    /// Triangles at the scene's own resolution. It is a fraction, so that the shares of several sheets add up.
    pub triangles: f64,
    pub kind: SheetKind,
    pub at: Place,
}

/// A garment of a person.
#[derive(Clone, Debug)]
pub(super) struct GarmentSource {
    pub garment: Garment,
    /// In coordinates relative to the scene's local origin.
    pub placement: Placement,
    /// Triangles at the scene's own resolution.
    pub triangles: f64,
    pub at: Place,
}

/// A sewing pattern.
#[derive(Clone, Debug)]
pub(super) struct PatternSource {
    pub pattern: Pattern,
    /// In coordinates relative to the scene's local origin.
    pub placement: Placement,
    /// Triangles at the scene's own resolution.
    pub triangles: f64,
    pub at: Place,
}

/// How a sheet is meshed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SheetKind {
    /// Irregular triangles with nested levels.
    Irregular,
    /// A regular grid.
    Grid,
}

/// Start velocity of the vertices, m/s.
#[derive(Clone, Debug)]
pub(super) enum StartVelocity {
    Same(Vec3),
    /// One velocity per vertex of a mesh from a file.
    PerVertex(Vec<Vec3>),
}

impl ClothSource {
    /// Triangles at the scene's own resolution, if the piece is meshed at any.
    pub(super) fn triangles(&self) -> Option<f64> {
        match &self.shape {
            Shape::Sheet(sheet) => Some(sheet.triangles),
            Shape::Garment(garment) => Some(garment.triangles),
            Shape::Pattern(pattern) => Some(pattern.triangles),
            Shape::Mesh(_) => None,
        }
    }
}

/// A piece of cloth before the scene's local origin is known.
pub(super) struct UnplacedCloth {
    /// A mesh is as its file has it.
    pub source: ClothSource,
    /// In world coordinates.
    pub placement: Placement,
    /// The file of a mesh.
    pub file: Option<PathBuf>,
}

impl UnplacedCloth {
    /// The box that holds the piece in the world, meters.
    fn bounds(&self) -> (DVec3, DVec3) {
        match &self.source.shape {
            Shape::Mesh(file) => self.placement.bounds(&file.mesh.positions, file.base),
            Shape::Garment(source) => self.placement.box_of(source.garment.bounds()),
            Shape::Pattern(source) => self.placement.box_of(source.pattern.bounds()),
            Shape::Sheet(sheet) => {
                let [low, high] = sheet.outline.bounds();
                let corners = [[low.x, low.y], [high.x, low.y], [low.x, high.y], [high.x, high.y]];
                let in_space = |[u, v]: [f64; 2]| sheet.axes[0] * u + sheet.axes[1] * v;
                bounds(corners.map(|corner| self.placement.point(in_space(corner))))
            }
        }
    }

    fn place(self, origin_m: DVec3) -> Result<ClothSource, SceneError> {
        let (placement, mut source) = (self.placement.about(origin_m), self.source);
        match &mut source.shape {
            Shape::Mesh(mesh) => place_mesh(mesh, &self.file.unwrap_or_default(), &placement)?,
            Shape::Sheet(sheet) => sheet.placement = placement,
            Shape::Garment(garment) => garment.placement = placement,
            Shape::Pattern(pattern) => pattern.placement = placement,
        }
        Ok(source)
    }
}

/// Places the pieces relative to the scene's local origin, the second value, which is that of the box around all of
/// them.
///
/// # Errors
/// A mesh is not valid at its place.
pub(super) fn place_cloths(cloths: Vec<UnplacedCloth>) -> Result<(Vec<ClothSource>, DVec3), SceneError> {
    let corners = cloths.iter().map(UnplacedCloth::bounds).flat_map(|(low, high)| [low, high]);
    let (low, high) = bounds(corners);
    let origin_m = local_origin(low, high, FAR_M);
    let placed = cloths.into_iter().map(|cloth| cloth.place(origin_m)).collect::<Result<_, _>>()?;
    Ok((placed, origin_m))
}
