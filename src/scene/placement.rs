//! Placement of a piece of cloth or an obstacle in the scene.

use std::path::Path;

use crate::math::{DAffine3, DQuat, DVec3, Vec3, bounds};
use crate::mesh::{FileMesh, MaterialSource, MeshOptions, Surface, TriangleMesh, read_mesh, validate};

use super::error::SceneError;

/// A placement: x -> rotation * (scale * x) + translation. The scale applies to the rest shape as well.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placement {
    pub translation_m: DVec3,
    pub rotation: DQuat,
    pub scale: f64,
}

impl Placement {
    /// The same placement in coordinates relative to `origin_m`.
    pub(super) fn about(self, origin_m: DVec3) -> Placement {
        Placement { translation_m: self.translation_m - origin_m, ..self }
    }

    /// Applies the placement to a mesh, including its material coordinates. Its positions are relative to `base`.
    pub(super) fn place(&self, mesh: &mut TriangleMesh, base: DVec3) {
        self.move_points(&mut mesh.positions, base);
        if self.scale != 1.0 {
            mesh.material_uv.iter_mut().flatten().for_each(|uv| *uv *= self.scale as f32);
        }
    }

    /// Applies the placement to a surface.
    pub(super) fn move_surface(&self, surface: &mut Surface) {
        self.move_points(&mut surface.positions, surface.base);
        surface.base = DVec3::ZERO;
    }

    /// The place of a point.
    pub(super) fn point(&self, p: DVec3) -> DVec3 {
        self.rotation * (p * self.scale) + self.translation_m
    }

    /// The placement as a matrix.
    pub(super) fn affine(&self) -> DAffine3 {
        DAffine3::from_scale_rotation_translation(DVec3::splat(self.scale), self.rotation, self.translation_m)
    }

    /// The box that holds points relative to `base` once they are placed.
    pub(super) fn bounds(&self, points: &[Vec3], base: DVec3) -> (DVec3, DVec3) {
        bounds(points.iter().map(|p| self.point(p.as_dvec3() + base)))
    }

    /// The box that holds another one, given by its lowest and highest corner, once it is placed.
    pub(super) fn box_of(&self, [low, high]: [DVec3; 2]) -> (DVec3, DVec3) {
        let ends = [low, high];
        let corner = |bits: usize| DVec3::new(ends[bits & 1].x, ends[bits >> 1 & 1].y, ends[bits >> 2].z);
        bounds((0..8).map(|bits| self.point(corner(bits))))
    }

    fn move_points(&self, points: &mut [Vec3], base: DVec3) {
        for p in points {
            *p = self.point(p.as_dvec3() + base).as_vec3();
        }
    }
}

/// Reads a mesh from a file; [`place_mesh`] places it. Vertices that lie within `weld_m` of each other after placement
/// are joined.
pub(super) fn unplaced_mesh(
    path: &Path,
    material: MaterialSource,
    weld_m: Option<f64>,
    placement: &Placement,
) -> Result<FileMesh, SceneError> {
    let weld = weld_m.map(|distance| distance / placement.scale);
    Ok(read_mesh(path, MeshOptions { material, weld, unit_m: placement.scale })?)
}

/// Places the mesh of the file `path`.
pub(super) fn place_mesh(file: &mut FileMesh, path: &Path, placement: &Placement) -> Result<(), SceneError> {
    placement.place(&mut file.mesh, file.base);
    file.base = DVec3::ZERO;
    // A far translation or an extreme scale can make a valid mesh invalid.
    validate(&file.mesh)
        .map_err(|fault| SceneError::File { path: path.into(), what: format!("at its place in the scene: {fault}") })
}
