//! Cloth pieces and how they become one mesh.

use std::borrow::Cow;
use std::path::Path;

use crate::math::{DQuat, DVec3, Vec3};
use crate::mesh::{FileMesh, MaterialSource, TriangleMesh, read_mesh, validate};

use super::parsed::{ClothSource, StartVelocity};
use super::{Cloth, Fabric, SceneError, Sheet};

/// One piece of cloth in its start state.
pub(super) struct Piece<'a> {
    pub source: &'a ClothSource,
    /// The mesh at its place; pins name vertices by their number in the file.
    pub cloth: Cow<'a, FileMesh>,
    /// Present if the piece is a generated sheet.
    pub sheet: Option<Sheet>,
}

/// Where a piece is put: x -> rotation * (scale * x) + translation. The scale applies to the rest shape, too.
#[derive(Clone, Copy, Debug)]
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

/// The pieces as one mesh.
pub(super) struct Merged {
    pub mesh: TriangleMesh,
    pub velocities: Vec<Vec3>,
    pub fabrics: Vec<Fabric>,
    pub fabric_of_triangle: Vec<u16>,
    pub cloths: Vec<Cloth>,
}

/// Merges pieces in their order; `Err` is the reason as half a sentence. `friction` = that of pieces without one of their own.
pub(super) fn merge(pieces: &[Piece], friction: f64) -> Result<Merged, String> {
    let mut merged = Merged {
        mesh: TriangleMesh::default(),
        velocities: Vec::new(),
        fabrics: Vec::new(),
        fabric_of_triangle: Vec::new(),
        cloths: Vec::new(),
    };
    for piece in pieces {
        let (mesh, source) = (&piece.cloth.mesh, piece.source);
        let first = merged.mesh.positions.len();
        if first + mesh.positions.len() > i32::MAX as usize {
            return Err("the cloths have more than 2147483647 vertices together".into());
        }
        let known = merged.fabrics.iter().position(|fabric| *fabric == source.fabric);
        let fabric = known.unwrap_or(merged.fabrics.len());
        if known.is_none() {
            merged.fabrics.push(source.fabric.clone());
        }
        let fabric = u16::try_from(fabric).map_err(|_| "there are more than 65536 different fabrics".to_owned())?;
        let first_triangle = merged.mesh.triangles.len() as u32;
        merged.mesh.positions.extend(&mesh.positions);
        merged.mesh.material_uv.extend(&mesh.material_uv);
        merged.mesh.triangles.extend(mesh.triangles.iter().map(|t| t.map(|v| v + first as u32)));
        match &source.velocity {
            StartVelocity::Same(velocity) => merged.velocities.resize(merged.mesh.positions.len(), *velocity),
            StartVelocity::PerVertex(velocities) => merged.velocities.extend(velocities),
        }
        merged.fabric_of_triangle.resize(merged.mesh.triangles.len(), fabric);
        merged.cloths.push(Cloth {
            name: source.name.clone(),
            vertices: first as u32..merged.mesh.positions.len() as u32,
            triangles: first_triangle..merged.mesh.triangles.len() as u32,
            friction: source.friction.unwrap_or(friction),
        });
    }
    Ok(merged)
}
