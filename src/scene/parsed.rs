//! [`ParsedScene`]: a scene file that was read and checked. It builds a [`Scene`] at any resolution, repeatedly.
//!
//! Files are read and fields are checked once, when the scene is parsed. [`ParsedScene::at`] makes and checks
//! everything that depends on the resolution: sheets, the vertices that pins select, and the start state.

use std::path::PathBuf;

use crate::math::DVec3;
use crate::mesh::{Refinement, extent};

use super::cloth_source::{ClothSource, Shape};
use super::error::Place;
use super::pieces::{Piece, merge, obstacle_warning, size_warning};
use super::pins::{self, PinSource};
use super::start::{GivenStart, Start, StartState};
use super::{Motion, Movement, Obstacle, Overrides, Pin, RESOLUTIONS, Scene, SceneError, Settings, Untangling};

/// A scene file that was read and checked, before a resolution is chosen.
///
/// It keeps the source of every piece of cloth, so that one scene can be built at several resolutions. The material
/// coordinates of a sheet (`TriangleMesh::material_uv`) have the same origin and axes at every resolution.
#[derive(Clone, Debug)]
pub struct ParsedScene {
    pub(super) path: PathBuf,
    pub(super) name: String,
    pub(super) origin_m: DVec3,
    pub(super) cloths: Vec<ClothSource>,
    pub(super) pins: Vec<PinSource>,
    pub(super) motions: Vec<Motion>,
    /// Obstacles that pins follow.
    pub(super) followed: Vec<u32>,
    pub(super) obstacles: Vec<Obstacle>,
    pub(super) settings: Settings,
    pub(super) warnings: Vec<String>,
    pub(super) left_out: Vec<String>,
    /// Position of the field that lists the cloths.
    pub(super) cloths_at: Place,
    /// Position of the field that lists the pins.
    pub(super) pins_at: Place,
}

impl ParsedScene {
    /// Builds the scene at the resolution of `overrides`, or at its own if there is none.
    ///
    /// # Errors
    /// The resolution is invalid, a pin selects no vertex at it, or the start state crosses itself.
    pub fn at(&self, overrides: &Overrides) -> Result<Scene, SceneError> {
        self.build_finest(overrides, &mut StartState::default())
    }

    /// Like [`ParsedScene::at`], but every piece is `coarsenings` levels coarser, with a fourth of the triangles per
    /// level. The second value says for every piece how [`ParsedScene::at`] makes it from the coarse one; a mesh from a
    /// file that does not divide a coarser one so many times stays as it is. Coarse meshes that cross where the fine
    /// ones do not are moved apart.
    ///
    /// # Errors
    /// Those of [`ParsedScene::at`], and a sheet that has no such level: a grid, or one of less than 128 triangles.
    pub fn coarser_at(
        &self,
        overrides: &Overrides,
        coarsenings: usize,
    ) -> Result<(Scene, Vec<Refinement>), SceneError> {
        self.coarser(overrides, coarsenings, &mut StartState { untangle: true, ..StartState::default() })
    }

    /// Like [`ParsedScene::at`], but a start state that crosses is untangled if possible. The scene then starts at
    /// the untangled positions, with its rest shape unchanged, and the second value reports the untangling.
    ///
    /// # Errors
    /// Those of [`ParsedScene::at`]; [`SceneError::Crossing`] then holds the best state that was reached.
    pub fn untangled_at(&self, overrides: &Overrides) -> Result<(Scene, Option<Untangling>), SceneError> {
        let mut start = StartState { untangle: true, ..StartState::default() };
        let scene = self.build_finest(overrides, &mut start)?;
        Ok((scene, start.untangled))
    }

    /// Like [`ParsedScene::at`], but the cloth starts as `given` says, with the rest shape, the pins and the
    /// obstacles of the scene; pins hold their vertices where those start. `given` must have as many vertices as the
    /// scene. If `untangle`, as [`ParsedScene::untangled_at`].
    ///
    /// # Errors
    /// Those of [`ParsedScene::at`].
    pub fn started_at(
        &self,
        overrides: &Overrides,
        given: &GivenStart,
        untangle: bool,
    ) -> Result<(Scene, Option<Untangling>), SceneError> {
        let mut start = StartState { given: Some(given), untangle, ..StartState::default() };
        let scene = self.build_finest(overrides, &mut start)?;
        Ok((scene, start.untangled))
    }

    /// Like [`ParsedScene::at`] without the check of the start state, for those who read a run that has made it:
    /// pieces, shapes at rest and obstacles are those of the run, and so is the start state unless it was untangled.
    ///
    /// # Errors
    /// The resolution is invalid, or a pin selects no vertex at it.
    pub fn unchecked_at(&self, overrides: &Overrides) -> Result<Scene, SceneError> {
        self.build_finest(overrides, &mut StartState { trusted: true, ..StartState::default() })
    }

    /// [`ParsedScene::coarser_at`] without that check.
    ///
    /// # Errors
    /// Those of [`ParsedScene::coarser_at`] but that.
    pub fn unchecked_coarser_at(
        &self,
        overrides: &Overrides,
        coarsenings: usize,
    ) -> Result<(Scene, Vec<Refinement>), SceneError> {
        self.coarser(overrides, coarsenings, &mut StartState { trusted: true, ..StartState::default() })
    }

    fn coarser(
        &self,
        overrides: &Overrides,
        coarsenings: usize,
        start: &mut StartState,
    ) -> Result<(Scene, Vec<Refinement>), SceneError> {
        let pieces = self.pieces(overrides, coarsenings)?;
        let scene = self.build(overrides, &pieces, start)?;
        Ok((scene, pieces.into_iter().map(|piece| piece.refinement).collect()))
    }

    fn pieces(&self, overrides: &Overrides, coarsenings: usize) -> Result<Vec<Piece<'_>>, SceneError> {
        let factor = self.resolution_factor(overrides.resolution)?;
        self.cloths.iter().map(|cloth| Piece::new(cloth, factor, coarsenings)).collect()
    }

    fn build_finest(&self, overrides: &Overrides, start: &mut StartState) -> Result<Scene, SceneError> {
        self.build(overrides, &self.pieces(overrides, 0)?, start)
    }

    fn build(&self, overrides: &Overrides, pieces: &[Piece], start: &mut StartState) -> Result<Scene, SceneError> {
        let settings = Settings { frames: overrides.frames.unwrap_or(self.settings.frames), ..self.settings.clone() };
        let mut merged = merge(pieces, settings.friction).map_err(|what| self.cloths_at.error(what))?;
        let mut held: Vec<Pin> = Vec::new();
        for pin in &self.pins {
            let first_vertex = merged.cloths[pin.cloth].vertices.start;
            let vertices = pin.vertices(&pieces[pin.cloth], &self.obstacles)?;
            let motions = self.motions.len() as u32;
            held.extend(vertices.into_iter().map(|v| pin.hold(first_vertex + v, motions)));
        }
        let pins = pins::without_conflicts(held).map_err(|vertex| {
            let what = "is held by two pins at the same time that move it differently";
            self.pins_at.error(format!("vertex {vertex} {what}"))
        })?;
        // A sheet that starts as a sheet is flat.
        let flat: Vec<bool> = pieces.iter().map(|piece| piece.sheet.is_some() && start.given.is_none()).collect();
        Start {
            path: &self.path,
            resolution: overrides.resolution,
            flat: &flat,
            obstacles: &self.obstacles,
            pins: &pins,
            origin_m: self.origin_m,
            settings: &settings,
        }
        .settle(&mut merged, start)
        .map_err(|crossings| self.cloths_at.crossing(crossings))?;
        Ok(Scene {
            name: self.name.clone(),
            origin_m: self.origin_m,
            mesh: merged.mesh,
            velocities: merged.velocities,
            fabrics: merged.fabrics,
            fabric_of_triangle: merged.fabric_of_triangle,
            pins,
            motions: self.motions.clone(),
            followed: self.followed.clone(),
            cloths: merged.cloths,
            obstacles: self.obstacles.clone(),
            parts: merged.parts,
            settings,
            warnings: self.warnings.clone(),
            left_out: self.left_out.clone(),
        })
    }

    /// Adds a warning for every mesh whose size is implausible: that of a cloth for its thickness, that of an
    /// obstacle for the cloth. `from_file` = whether an obstacle is a mesh from a file; others state their size in
    /// meters.
    pub(super) fn warn_of_sizes(mut self, from_file: impl Fn(usize) -> bool) -> ParsedScene {
        let thickness_m = self.settings.thickness_m;
        let mut cloth_m: f64 = 0.0;
        for cloth in &self.cloths {
            cloth_m = cloth_m.max(match &cloth.shape {
                Shape::Mesh(mesh) => {
                    self.warnings.extend(size_warning(&format!("`{}`", cloth.name), mesh.extent(), thickness_m));
                    mesh.extent()
                }
                Shape::Garment(source) => {
                    let (low, high) = source.placement.box_of(source.garment.bounds());
                    (high - low).max_element()
                }
                Shape::Sheet(sheet) => {
                    let [low, high] = sheet.outline.bounds();
                    (high - low).max_element()
                }
            });
        }
        for (_, obstacle) in self.obstacles.iter().enumerate().filter(|(i, _)| from_file(*i)) {
            let scale = match &obstacle.movement {
                Movement::Keyframes(motion) => motion.keyframes.first().map_or(1.0, |key| key.scale),
                _ => 1.0,
            };
            self.warnings.extend(obstacle_warning(&obstacle.name, extent(&obstacle.positions) * scale, cloth_m));
        }
        self
    }

    /// Factor on the number of triangles of every sheet.
    fn resolution_factor(&self, wanted: Option<u64>) -> Result<f64, SceneError> {
        let Some(wanted) = wanted else { return Ok(1.0) };
        let fault = |what: &str| SceneError::File { path: self.path.clone(), what: what.into() };
        if !RESOLUTIONS.contains(&wanted) {
            let (least, most) = (RESOLUTIONS.start(), RESOLUTIONS.end());
            return Err(fault(&format!("the resolution must be from {least} to {most} triangles, not {wanted}")));
        }
        let mut shares = self.cloths.iter().filter_map(ClothSource::triangles).peekable();
        if shares.peek().is_none() {
            return Err(fault(
                "the resolution of a scene can be chosen for sheets and garments only, and this scene has none",
            ));
        }
        Ok(wanted as f64 / shares.sum::<f64>())
    }
}
