//! Cloth pieces and how they become one mesh.

use std::path::Path;

use crate::math::{DQuat, DVec3, Vec3};
use crate::mesh::{FileMesh, MaterialSource, TriangleMesh, read_mesh, validate};

use super::{Cloth, Fabric, SceneError, Sheet};

/// One piece of cloth in its start state.
pub(super) struct Piece {
    /// Shown in messages and selected by pins.
    pub name: String,
    /// The mesh at its place; pins name vertices by their number in the file.
    pub cloth: FileMesh,
    /// A sentence about what of the file is left out.
    pub left_out: Option<String>,
    pub velocities: Vec<Vec3>,
    pub fabric: Fabric,
    /// Friction coefficient of its own, if it has one.
    pub friction: Option<f64>,
    /// Present if the piece is a generated sheet.
    pub sheet: Option<Sheet>,
    /// First vertex in the scene.
    pub first_vertex: u32,
}

/// Where a piece is put: x -> rotation * (scale * x) + translation. The scale applies to the rest shape, too.
#[derive(Clone, Copy)]
pub(super) struct Placement {
    pub translation_m: DVec3,
    pub rotation: DQuat,
    pub scale: f64,
}

impl Placement {
    /// Moves a mesh to its place.
    pub fn place(&self, mesh: &mut TriangleMesh) {
        self.move_points(&mut mesh.positions);
        if self.scale != 1.0 {
            mesh.material_uv.iter_mut().flatten().for_each(|uv| *uv *= self.scale as f32);
        }
    }

    /// Moves points to their place.
    pub fn move_points(&self, points: &mut [Vec3]) {
        for p in points {
            *p = (self.rotation * (p.as_dvec3() * self.scale) + self.translation_m).as_vec3();
        }
    }
}

/// Reads and places a mesh from a file.
pub(super) fn placed_mesh(path: &Path, source: MaterialSource, placement: &Placement) -> Result<FileMesh, SceneError> {
    let mut file = read_mesh(path, source)?;
    placement.place(&mut file.mesh);
    // Far translations and extreme scales can undo what the file had right.
    validate(&file.mesh)
        .map_err(|fault| SceneError::File { path: path.into(), what: format!("at its place in the scene: {fault}") })?;
    Ok(file)
}

/// The pieces as one mesh, with their first vertices filled in.
pub(super) struct Merged {
    pub mesh: TriangleMesh,
    pub velocities: Vec<Vec3>,
    pub fabrics: Vec<Fabric>,
    pub fabric_of_triangle: Vec<u16>,
    pub cloths: Vec<Cloth>,
}

/// Merges pieces in their order; `Err` is the reason as half a sentence. `friction` = that of pieces without one of their own.
pub(super) fn merge(pieces: &mut [Piece], friction: f64) -> Result<Merged, String> {
    let mut merged = Merged {
        mesh: TriangleMesh::default(),
        velocities: Vec::new(),
        fabrics: Vec::new(),
        fabric_of_triangle: Vec::new(),
        cloths: Vec::new(),
    };
    for piece in pieces.iter_mut() {
        let first = merged.mesh.positions.len();
        if first + piece.cloth.mesh.positions.len() > i32::MAX as usize {
            return Err("the cloths have more than 2147483647 vertices together".into());
        }
        let known = merged.fabrics.iter().position(|fabric| *fabric == piece.fabric);
        let fabric = known.unwrap_or(merged.fabrics.len());
        if known.is_none() {
            merged.fabrics.push(piece.fabric.clone());
        }
        let fabric = u16::try_from(fabric).map_err(|_| "there are more than 65536 different fabrics".to_owned())?;
        piece.first_vertex = first as u32;
        let first_triangle = merged.mesh.triangles.len() as u32;
        merged.mesh.positions.extend(&piece.cloth.mesh.positions);
        merged.mesh.material_uv.extend(&piece.cloth.mesh.material_uv);
        merged.mesh.triangles.extend(piece.cloth.mesh.triangles.iter().map(|t| t.map(|v| v + first as u32)));
        merged.velocities.extend(&piece.velocities);
        merged.fabric_of_triangle.resize(merged.mesh.triangles.len(), fabric);
        merged.cloths.push(Cloth {
            name: piece.name.clone(),
            vertices: first as u32..merged.mesh.positions.len() as u32,
            triangles: first_triangle..merged.mesh.triangles.len() as u32,
            friction: piece.friction.unwrap_or(friction),
        });
    }
    Ok(merged)
}
