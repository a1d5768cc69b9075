//! Cloth pieces and how they become one mesh.

use std::path::Path;

use crate::math::{DQuat, DVec3, Vec3};
use crate::mesh::{FileMesh, MaterialSource, TriangleMesh, first_intersection, read_mesh, validate};

use super::{Fabric, SceneError, Sheet};

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
        for p in &mut mesh.positions {
            *p = (self.rotation * (p.as_dvec3() * self.scale) + self.translation_m).as_vec3();
        }
        if self.scale != 1.0 {
            mesh.material_uv.iter_mut().flatten().for_each(|uv| *uv *= self.scale as f32);
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
}

/// Merges pieces in their order; `Err` is the reason as half a sentence.
pub(super) fn merge(pieces: &mut [Piece]) -> Result<Merged, String> {
    let mut merged = Merged {
        mesh: TriangleMesh::default(),
        velocities: Vec::new(),
        fabrics: Vec::new(),
        fabric_of_triangle: Vec::new(),
    };
    let mut first_triangles = Vec::new();
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
        first_triangles.push(merged.mesh.triangles.len());
        merged.mesh.positions.extend(&piece.cloth.mesh.positions);
        merged.mesh.material_uv.extend(&piece.cloth.mesh.material_uv);
        merged.mesh.triangles.extend(piece.cloth.mesh.triangles.iter().map(|t| t.map(|v| v + first as u32)));
        merged.velocities.extend(&piece.velocities);
        merged.fabric_of_triangle.resize(merged.mesh.triangles.len(), fabric);
    }
    // A sheet alone is flat and cannot meet itself.
    let flat = pieces.len() == 1 && pieces[0].sheet.is_some();
    if let Some(pair) = (!flat).then(|| first_intersection(&merged.mesh)).flatten() {
        let [one, other] = pair.map(|t| {
            let piece = first_triangles.partition_point(|&first| first <= t as usize) - 1;
            format!("triangle {} of `{}`", t as usize - first_triangles[piece] + 1, pieces[piece].name)
        });
        return Err(format!("{one} and {other} cross or touch at the start; move them apart"));
    }
    Ok(merged)
}
