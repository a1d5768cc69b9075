//! Placement of a piece of cloth or an obstacle in the scene.

use std::path::Path;

use crate::math::{DQuat, DVec3, Vec3};
use crate::mesh::{FileMesh, MaterialSource, MeshOptions, TriangleMesh, read_mesh, validate};

use super::error::SceneError;

/// A placement: x -> rotation * (scale * x) + translation. The scale applies to the rest shape as well.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placement {
    pub translation_m: DVec3,
    pub rotation: DQuat,
    pub scale: f64,
}

impl Placement {
    /// Applies the placement to a mesh, including its material coordinates.
    pub(super) fn place(&self, mesh: &mut TriangleMesh) {
        self.move_points(&mut mesh.positions);
        if self.scale != 1.0 {
            mesh.material_uv.iter_mut().flatten().for_each(|uv| *uv *= self.scale as f32);
        }
    }

    /// Applies the placement to points.
    pub(super) fn move_points(&self, points: &mut [Vec3]) {
        for p in points {
            *p = (self.rotation * (p.as_dvec3() * self.scale) + self.translation_m).as_vec3();
        }
    }
}

/// Reads and places a mesh from a file. Vertices that lie within `weld_m` of each other after placement are joined.
pub(super) fn placed_mesh(
    path: &Path,
    material: MaterialSource,
    weld_m: Option<f64>,
    placement: &Placement,
) -> Result<FileMesh, SceneError> {
    let weld = weld_m.map(|distance| distance / placement.scale);
    let mut file = read_mesh(path, MeshOptions { material, weld })?;
    placement.place(&mut file.mesh);
    // A far translation or an extreme scale can make a valid mesh invalid.
    validate(&file.mesh)
        .map_err(|fault| SceneError::File { path: path.into(), what: format!("at its place in the scene: {fault}") })?;
    Ok(file)
}
