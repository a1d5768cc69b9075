//! [`ParsedScene`]: a scene file that was read and checked. It builds a [`Scene`] at any resolution, repeatedly.
//!
//! Files are read and fields are checked once, when the scene is parsed. [`ParsedScene::at`] makes and checks
//! everything that depends on the resolution: sheets, the vertices that pins select, and the start state.

use std::path::PathBuf;

use crate::math::{DVec3, Vec3};
use crate::mesh::{Refinement, SewnMesh, closed_parts, extent};

use super::cloth_source::{ClothSource, Shape};
use super::error::Place;
use super::map_values::merged_maps;
use super::pieces::{Merged, Piece, merge, obstacle_warning, size_warning};
use super::pins::{self, PinSource};
use super::seam::{Joint, Joints, SeamSource, sew};
use super::seam_fault::{fault_sentence, panel_of};
use super::seam_file::SewingSource;
use super::start::{GivenStart, Start, StartState};
use super::{
    Change, Closing, Fabric, Motion, Movement, Obstacle, Overrides, Pin, RESOLUTIONS, Scene, SceneError, Settings,
    Sewing, Untangling,
};

/// Last length of a thread over `weld_m`. A thread that shrank to nothing would draw the sides through each other, and
/// what keeps them apart would work against it in every step.
pub(super) const LAST_LENGTH: f64 = 0.25;

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
    /// The fabrics that the scene names.
    pub(super) fabrics: Vec<Fabric>,
    pub(super) pins: Vec<PinSource>,
    /// Changes while it runs.
    pub(super) changes: Vec<Change>,
    pub(super) seams: Vec<SeamSource>,
    pub(super) sewing: SewingSource,
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
    /// Position of the field that lists the seams.
    pub(super) seams_at: Place,
}

impl ParsedScene {
    /// Length of a step, seconds.
    pub fn step_s(&self) -> f64 {
        self.settings.step_s
    }

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
        if !self.seams.is_empty() && coarsenings > 0 {
            return Err(self.seams_at.error("cloth that is sewn has no coarser level (--segments)"));
        }
        if !self.changes.is_empty() && coarsenings > 0 {
            let what = "a scene that changes while it runs (`[[change]]`) cannot be split in time (--segments)";
            return Err(SceneError::File { path: self.path.clone(), what: what.into() });
        }
        let (pieces, joints) = self.pieces(overrides, coarsenings)?;
        let scene = self.build(overrides, &pieces, &joints, start)?;
        Ok((scene, pieces.into_iter().map(|piece| piece.refinement).collect()))
    }

    /// The pieces with the vertices that seams add, and what the seams join.
    pub(super) fn pieces(
        &self,
        overrides: &Overrides,
        coarsenings: usize,
    ) -> Result<(Vec<Piece<'_>>, Joints), SceneError> {
        let factor = self.resolution_factor(overrides.resolution)?;
        let piece = |cloth| Piece::new(cloth, factor, coarsenings);
        let mut pieces: Vec<Piece<'_>> = self.cloths.iter().map(piece).collect::<Result<_, _>>()?;
        for (piece, wrap) in pieces.iter_mut().zip(&self.cloths).filter_map(|(p, c)| Some((p, c.wrap.as_ref()?))) {
            if coarsenings > 0 {
                return Err(wrap.at.error("cloth that is bent about a body has no coarser level (--segments)"));
            }
            piece
                .wrap(&self.obstacles[wrap.obstacle], self.settings.thickness_m)
                .map_err(|what| wrap.at.error(what))?;
        }
        let joints = if self.seams.is_empty() { Joints::default() } else { sew(&mut pieces, &self.seams)? };
        Ok((pieces, joints))
    }

    fn build_finest(&self, overrides: &Overrides, start: &mut StartState) -> Result<Scene, SceneError> {
        let (pieces, joints) = self.pieces(overrides, 0)?;
        self.build(overrides, &pieces, &joints, start)
    }

    fn build(
        &self,
        overrides: &Overrides,
        pieces: &[Piece],
        joints: &Joints,
        start: &mut StartState,
    ) -> Result<Scene, SceneError> {
        let mut settings =
            Settings { frames: overrides.frames.unwrap_or(self.settings.frames), ..self.settings.clone() };
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
        let (sewing, not_sewn) = self.sewing_of(&merged, joints, &pins)?;
        if sewing.is_none() {
            self.check_pressures(&merged)?;
        }
        if sewing.is_some() && !self.sewing.gravity {
            settings.gravity_m_s2 = Vec3::ZERO;
            settings.over_time.gravity_waits = true;
        }
        // A sheet that starts as a sheet is flat.
        let flat: Vec<bool> = pieces.iter().map(|piece| piece.is_flat() && start.given.is_none()).collect();
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
            maps: merged_maps(pieces)?,
            parts: merged.parts,
            folds: Vec::new(),
            sewing,
            settings,
            warnings: self.warnings.clone(),
            left_out: self.left_out.iter().chain(&joints.left_out).chain(&not_sewn).cloned().collect(),
        })
    }

    /// What the joints of a scene sew, none without joints; and a sentence for every seam that does not make cloth.
    fn sewing_of(
        &self,
        merged: &Merged,
        joints: &Joints,
        pins: &[Pin],
    ) -> Result<(Option<Sewing>, Vec<String>), SceneError> {
        let mesh = &merged.mesh;
        let of_joint = |joint: &Joint| {
            let [a, b] = joint.ends.map(|(cloth, vertex)| merged.cloths[cloth].vertices.start + vertex);
            ([a.min(b), a.max(b)], joint.seam)
        };
        let number = |v: u32| {
            let cloth = merged.cloths.iter().find(|cloth| cloth.vertices.contains(&v));
            v - cloth.map_or(0, |cloth| cloth.vertices.start)
        };
        let panel = |triangle: u32| panel_of(&merged.parts, &merged.cloths, triangle);
        let (mut left_out, mut dropped) = (Vec::new(), vec![false; joints.names.len()]);
        let (pairs, seam_of_pair) = loop {
            let sewn = joints.joints.iter().filter(|joint| !dropped[joint.seam as usize]);
            let mut both: Vec<([u32; 2], u32)> = sewn.map(of_joint).collect();
            both.retain(|([a, b], _)| a != b);
            both.sort_unstable();
            both.dedup_by_key(|(pair, _)| *pair);
            let (pairs, seams): (Vec<[u32; 2]>, Vec<u32>) = both.into_iter().unzip();
            let Err(fault) = SewnMesh::new(mesh, &pairs) else { break (pairs, seams) };
            let at = |v: u32| pairs.iter().position(|pair| pair.contains(&v)).map(|pair| seams[pair]);
            let seam_of = |v: u32| at(v).map(|seam| joints.names[seam as usize].clone());
            let what = fault_sentence(fault, mesh, seam_of, panel, number);
            let of_fault = fault.vertices().into_iter().filter_map(at);
            match of_fault.into_iter().find(|&seam| joints.lenient[seam as usize]) {
                Some(seam) => {
                    dropped[seam as usize] = true;
                    left_out.push(format!("seam `{}` is not sewn: {what}", joints.names[seam as usize]));
                }
                None => return Err(self.seams_at.error(what)),
            }
        };
        if pairs.is_empty() {
            return Ok((None, left_out));
        }
        let seam_name = |pair: usize| joints.names[seam_of_pair[pair] as usize].clone();
        let held = |v: u32| pins.iter().find(|pin| pin.vertex == v);
        for (i, &[a, b]) in pairs.iter().enumerate() {
            let apart_m = mesh.positions[a as usize].as_dvec3().distance(mesh.positions[b as usize].as_dvec3());
            if let (Some(one), Some(other)) = (held(a), held(b))
                && (apart_m > 0.5 * self.sewing.weld_m || one.motion != other.motion)
            {
                let [a, b] = [a, b].map(|v| {
                    let triangle = mesh.triangles.iter().position(|t| t.contains(&v)).unwrap_or_default() as u32;
                    format!("vertex {} of {}", number(v), panel(triangle))
                });
                return Err(self.seams_at.error(format!(
                    "seam `{}` joins {a} and {b}, but pins hold both, {apart_m:.3} m apart at the start",
                    seam_name(i)
                )));
            }
        }
        let longest = |longest: f64, &[a, b]: &[u32; 2]| {
            longest.max(mesh.positions[a as usize].as_dvec3().distance(mesh.positions[b as usize].as_dvec3()))
        };
        let longest_m = pairs.iter().fold(0.0, longest);
        let SewingSource { close_s, close_speed_m_s, weld_m, refine, .. } = self.sewing;
        let gravity_m_s2 = self.settings.gravity_m_s2;
        let close_s = close_speed_m_s.map_or(close_s, |speed| (longest_m / speed).max(self.settings.step_s));
        let closing = Closing { start_s: 0.0, close_s, last_m: LAST_LENGTH * weld_m };
        let names = joints.names.clone();
        let angles = joints.angles.iter().map(|angle| angle.unwrap_or(self.sewing.angle) as f32).collect();
        let sewing =
            Sewing { pairs, names, angles, seam_of_pair, closing, first_m: None, weld_m, refine, gravity_m_s2 };
        Ok((Some(sewing), left_out))
    }

    /// Pressure needs a closed surface. Panels may close one once they are sewn.
    fn check_pressures(&self, merged: &Merged) -> Result<(), SceneError> {
        if merged.cloths.iter().all(|cloth| cloth.pressure_pa == 0.0) {
            return Ok(());
        }
        let outward = closed_parts(&merged.mesh.triangles, &merged.mesh.positions);
        for cloth in merged.cloths.iter().filter(|cloth| cloth.pressure_pa != 0.0) {
            let open = cloth.triangles.clone().find(|&t| outward[t as usize] == 0.0);
            if let Some(triangle) = open {
                let triangle = triangle - cloth.triangles.start;
                let what = "has a border; pressure needs a closed surface, or seams that close one";
                return Err(self
                    .cloths_at
                    .error(format!("`pressure_pa`: the part of `{}` with triangle {triangle} {what}", cloth.name)));
            }
        }
        Ok(())
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
                Shape::Pattern(source) => {
                    let (low, high) = source.placement.box_of(source.pattern.bounds());
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
                "the resolution can be chosen for sheets, garments and patterns only, and this scene has none",
            ));
        }
        Ok(wanted as f64 / shares.sum::<f64>())
    }
}
