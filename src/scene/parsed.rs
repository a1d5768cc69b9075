//! A scene as it was written, before it has a resolution: [`ParsedScene`] -> [`Scene`], as often as wanted.
//!
//! Files are read and fields are checked once, when the scene is parsed. What depends on the resolution is made and checked
//! by [`ParsedScene::at`]: sheets, the vertices that pins select, the start state.

use std::path::PathBuf;

use crate::math::{DVec2, DVec3, Vec3};
use crate::mesh::{FileMesh, TriangleMesh};

use super::pieces::{Piece, Placement, merge, size_warning};
use super::pins::{self, PinSource};
use super::start::{Start, StartState};
use super::{
    Crossings, Fabric, Motion, Obstacle, Overrides, Pin, RESOLUTIONS, Scene, SceneError, Settings, Untangling,
    sheet_cells,
};

/// Where a refusal points.
#[derive(Clone, Debug)]
pub(super) struct Place {
    pub path: PathBuf,
    /// Counting from 1; formats without lines have none.
    pub line: Option<usize>,
    /// With the tables it lies in.
    pub field: String,
}

impl Place {
    /// The refusal of what stands here.
    pub(super) fn error(&self, what: impl Into<String>) -> SceneError {
        SceneError::Field { path: self.path.clone(), line: self.line, field: self.field.clone(), what: what.into() }
    }

    fn crossing(&self, crossings: Box<Crossings>) -> SceneError {
        SceneError::Crossing { path: self.path.clone(), line: self.line, field: self.field.clone(), crossings }
    }
}

/// A scene file that was read and checked, at no resolution yet.
///
/// It keeps what every piece of cloth was made from, so that one scene can be had at several resolutions. The material
/// coordinates of every triangle's corners come with each of them (`TriangleMesh::material_uv`); those of a sheet have
/// the same origin and axes at every resolution.
#[derive(Clone, Debug)]
pub struct ParsedScene {
    pub(super) path: PathBuf,
    pub(super) name: String,
    pub(super) cloths: Vec<ClothSource>,
    pub(super) pins: Vec<PinSource>,
    pub(super) motions: Vec<Motion>,
    pub(super) obstacles: Vec<Obstacle>,
    pub(super) settings: Settings,
    pub(super) warnings: Vec<String>,
    pub(super) left_out: Vec<String>,
    /// The field that lists the cloths.
    pub(super) cloths_at: Place,
    /// The field that lists the pins.
    pub(super) pins_at: Place,
}

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

impl ParsedScene {
    /// The scene at a resolution; its own where `overrides` has none.
    ///
    /// # Errors
    /// A resolution that cannot be had, a pin that selects nothing at it, or a start state that crosses itself.
    pub fn at(&self, overrides: &Overrides) -> Result<Scene, SceneError> {
        self.build(overrides, &mut StartState::default())
    }

    /// As [`ParsedScene::at`], but a start state that crosses is untangled where possible: then the scene starts with the
    /// positions that this led to (its rest shape stays) and the second value says what it took.
    ///
    /// # Errors
    /// As [`ParsedScene::at`]; [`SceneError::Crossing`] then holds the best state that was reached.
    pub fn untangled_at(&self, overrides: &Overrides) -> Result<(Scene, Option<Untangling>), SceneError> {
        let mut start = StartState { untangle: true, untangled: None };
        let scene = self.build(overrides, &mut start)?;
        Ok((scene, start.untangled))
    }

    fn build(&self, overrides: &Overrides, start: &mut StartState) -> Result<Scene, SceneError> {
        let factor = self.resolution_factor(overrides.resolution)?;
        let pieces = self.cloths.iter().map(|cloth| cloth.piece(factor)).collect::<Result<Vec<Piece>, _>>()?;
        let settings = Settings { frames: overrides.frames.unwrap_or(self.settings.frames), ..self.settings.clone() };
        let mut merged = merge(&pieces, settings.friction).map_err(|what| self.cloths_at.error(what))?;
        let mut held: Vec<Pin> = Vec::new();
        for pin in &self.pins {
            let first_vertex = merged.cloths[pin.cloth].vertices.start;
            held.extend(pin.vertices(&pieces[pin.cloth])?.into_iter().map(|v| pin.hold(first_vertex + v)));
        }
        let pins = pins::without_conflicts(held).map_err(|vertex| {
            let what = "is held by two pins at the same time that move it differently";
            self.pins_at.error(format!("vertex {vertex} {what}"))
        })?;
        let flat: Vec<bool> = pieces.iter().map(|piece| piece.sheet.is_some()).collect();
        Start {
            path: &self.path,
            resolution: overrides.resolution,
            flat: &flat,
            obstacles: &self.obstacles,
            pins: &pins,
            settings: &settings,
        }
        .settle(&mut merged, start)
        .map_err(|crossings| self.cloths_at.crossing(crossings))?;
        Ok(Scene {
            name: self.name.clone(),
            mesh: merged.mesh,
            velocities: merged.velocities,
            fabrics: merged.fabrics,
            fabric_of_triangle: merged.fabric_of_triangle,
            pins,
            motions: self.motions.clone(),
            cloths: merged.cloths,
            obstacles: self.obstacles.clone(),
            parts: merged.parts,
            settings,
            warnings: self.warnings.clone(),
            left_out: self.left_out.clone(),
        })
    }

    /// Adds a sentence for every mesh whose size does not go with the thickness of the cloth.
    pub(super) fn warn_of_sizes(mut self) -> ParsedScene {
        let thickness_m = self.settings.thickness_m;
        for cloth in &self.cloths {
            if let Shape::Mesh(mesh) = &cloth.shape {
                self.warnings.extend(size_warning(&format!("`{}`", cloth.name), mesh.extent(), thickness_m));
            }
        }
        self
    }

    /// What the triangles of every sheet are multiplied by.
    fn resolution_factor(&self, wanted: Option<u64>) -> Result<f64, SceneError> {
        let Some(wanted) = wanted else { return Ok(1.0) };
        let fault = |what: &str| SceneError::File { path: self.path.clone(), what: what.into() };
        if !RESOLUTIONS.contains(&wanted) {
            let (least, most) = (RESOLUTIONS.start(), RESOLUTIONS.end());
            return Err(fault(&format!("the resolution must be from {least} to {most} triangles, not {wanted}")));
        }
        let mut shares = self.cloths.iter().filter_map(ClothSource::sheet).map(|sheet| sheet.triangles).peekable();
        if shares.peek().is_none() {
            return Err(fault("the resolution of a scene can be chosen for sheets only, and this scene has none"));
        }
        Ok(wanted as f64 / shares.sum::<f64>())
    }
}

impl ClothSource {
    pub(super) fn sheet(&self) -> Option<&SheetSource> {
        match &self.shape {
            Shape::Sheet(sheet) => Some(sheet),
            Shape::Mesh(_) => None,
        }
    }

    fn piece(&self, factor: f64) -> Result<Piece<'_>, SceneError> {
        let (cloth, sheet) = match &self.shape {
            Shape::Mesh(mesh) => (std::borrow::Cow::Borrowed(mesh), None),
            Shape::Sheet(sheet) => {
                let cells = sheet_cells(sheet.size_m, (sheet.triangles * factor).round().max(2.0) as u64);
                let uv = cells.coordinates(sheet.size_m);
                let in_space = |uv: DVec2| sheet.axes[0] * uv.x + sheet.axes[1] * uv.y;
                let corners = cells.triangle_corners();
                let mut mesh = TriangleMesh {
                    positions: uv.iter().map(|uv| in_space(uv.as_dvec2()).as_vec3()).collect(),
                    material_uv: corners.iter().map(|t| t.map(|v| uv[v as usize])).collect(),
                    triangles: corners,
                };
                sheet.placement.place(&mut mesh);
                crate::mesh::validate(&mesh).map_err(|fault| sheet.at.error(fault.to_string()))?;
                (std::borrow::Cow::Owned(FileMesh::from(mesh)), Some(cells))
            }
        };
        Ok(Piece { source: self, cloth, sheet })
    }
}
