//! Triangle meshes: storage, files, validation, adjacency, material space, ordering and the start-state check.
//!
//! Nothing here moves: a mesh is what a scene starts from. Files are read in one pass with memory proportional to the
//! file; no claim of a file is believed before the bytes behind it have been seen.

mod adjacency;
mod crossings;
mod intersect;
mod material;
mod obj;
mod order;
mod ply;
pub mod shapes;
mod untangle;
mod validate;

use std::path::{Path, PathBuf};

use crate::math::{Vec2, Vec3};

pub use adjacency::{Hinge, hinges, pieces, unique_edges};
pub use crossings::{Group, GroupKind, MOST_PAIRS, crossings, first_intersection};
pub use intersect::edge_crosses_triangle;
pub use material::{flatten_triangle, flatten_triangles};
pub use obj::parse_obj;
pub use order::{locality_order, middle, vertex_order};
pub use ply::parse_ply;
pub use untangle::{Tangle, Untangled};
pub use validate::{MeshFault, check_obstacle, validate};

/// A triangle mesh of cloth in its start state. Counter-clockwise triangles; every vertex is used by a triangle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// World positions at time 0, metres.
    pub positions: Vec<Vec3>,
    /// Vertex indices of every triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Material-space (rest) coordinates of every triangle's corners, metres: x = warp, y = weft. Kept per corner, so
    /// that a seam (one vertex, several texture coordinates) is no special case. Counter-clockwise as well.
    pub material_uv: Vec<[Vec2; 3]>,
}

/// Why a mesh file is refused: one sentence with the file and, where its format has lines, the line.
#[derive(Debug, thiserror::Error)]
pub enum MeshReadError {
    /// The file cannot be opened or read.
    #[error("{}: cannot be read: {reason}", path.display())]
    Unreadable { path: PathBuf, reason: String },
    /// Neither `.obj` nor `.ply`.
    #[error("{}: a mesh file ends in .obj or .ply", path.display())]
    UnknownFormat { path: PathBuf },
    /// A line, a header or a record of the file is wrong.
    #[error("{}{}: {}", path.display(), fault.place(), fault.what)]
    Syntax { path: PathBuf, fault: ParseFault },
    /// The file is well formed, the mesh in it cannot be simulated.
    #[error("{}: {fault}", path.display())]
    Mesh { path: PathBuf, fault: MeshFault },
}

/// What is wrong in the text or bytes of a mesh file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{what}")]
pub struct ParseFault {
    /// Line counting from 1, where the format has lines.
    pub line: Option<u64>,
    /// What is wrong and what would be right.
    pub what: String,
}

impl ParseFault {
    fn at(line: u64, what: impl Into<String>) -> ParseFault {
        ParseFault { line: Some(line), what: what.into() }
    }

    fn whole(what: impl Into<String>) -> ParseFault {
        ParseFault { line: None, what: what.into() }
    }

    fn place(&self) -> String {
        self.line.map(|line| format!(", line {line}")).unwrap_or_default()
    }
}

/// Where the material (rest) coordinates of a mesh file come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MaterialSource {
    /// The file's texture coordinates in metres where every corner has one, its 3D shape otherwise.
    #[default]
    TextureOrShape,
    /// Always the 3D shape: for files whose texture coordinates are a picture's, not a pattern's.
    Shape,
}

/// Reads and validates the mesh in an OBJ or PLY file.
///
/// Does not look for self-intersections: [`first_intersection`] does, once all pieces of a scene are in place.
pub fn read_mesh(path: &Path, source: MaterialSource) -> Result<FileMesh, MeshReadError> {
    read_file(path)?.into_mesh(source).map_err(|fault| MeshReadError::Mesh { path: path.into(), fault })
}

/// Reads an obstacle's surface from an OBJ or PLY file: every vertex of it, in its order, also those in no triangle.
///
/// Checked are indices, finite coordinates and areas. What only cloth needs is not: edges may have any number of
/// triangles, wound in any way.
pub fn read_surface(path: &Path) -> Result<Surface, MeshReadError> {
    let surface = read_file(path)?;
    check_obstacle(&surface).map_err(|fault| MeshReadError::Mesh { path: path.into(), fault })?;
    Ok(surface)
}

fn read_file(path: &Path) -> Result<Surface, MeshReadError> {
    let unreadable = |error: std::io::Error| MeshReadError::Unreadable { path: path.into(), reason: error.to_string() };
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    if extension != "obj" && extension != "ply" {
        return Err(MeshReadError::UnknownFormat { path: path.into() });
    }
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let metadata = file.metadata().map_err(unreadable)?;
    if !metadata.is_file() {
        return Err(MeshReadError::Unreadable { path: path.into(), reason: "it is not a file".into() });
    }
    let reader = std::io::BufReader::with_capacity(1 << 16, file);
    let parsed = if extension == "obj" { parse_obj(reader) } else { parse_ply(reader, metadata.len()) };
    parsed.map_err(|fault| MeshReadError::Syntax { path: path.into(), fault })
}

/// What a mesh file holds, with the file's own vertex numbering.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// World positions, metres.
    pub positions: Vec<Vec3>,
    /// Triangles; polygons have been cut into fans.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates of the corners, or empty if a corner has none.
    pub texture_uv: Vec<[Vec2; 3]>,
}

impl Surface {
    /// The validated mesh; material coordinates as `source` says. Vertices in no triangle are dropped.
    pub fn into_mesh(self, source: MaterialSource) -> Result<FileMesh, MeshFault> {
        let Surface { mut positions, mut triangles, texture_uv } = self;
        let used = validate::check_surface(&positions, &triangles)?;
        let mut file_vertices = None;
        if used.contains(&false) {
            let kept: Vec<u32> = (0..).zip(&used).filter(|(_, used)| **used).map(|(vertex, _)| vertex).collect();
            let mut new_from_file = vec![0; positions.len()];
            (0..).zip(&kept).for_each(|(new, &old)| new_from_file[old as usize] = new);
            triangles.iter_mut().flatten().for_each(|v| *v = new_from_file[*v as usize]);
            positions = kept.iter().map(|&old| positions[old as usize]).collect();
            file_vertices = Some(kept);
        }
        // A map that is a point or a line everywhere (exporters write `vt 0 0` for "none") says nothing about the rest shape.
        let is_a_map = texture_uv.iter().any(|uv| material::doubled_area(uv) != 0.0);
        let mut material_uv = if source == MaterialSource::TextureOrShape && is_a_map {
            texture_uv
        } else {
            flatten_triangles(&positions, &triangles)
        };
        material::mirror_clockwise(&mut material_uv);
        let dropped = used.len() - positions.len();
        let mesh = TriangleMesh { positions, triangles, material_uv };
        validate::check_material(&mesh)?;
        Ok(FileMesh { mesh, file_vertices, dropped })
    }
}

/// A mesh as it came from a file.
#[derive(Clone, Debug, PartialEq)]
pub struct FileMesh {
    /// The mesh, vertices in the order of the file.
    pub mesh: TriangleMesh,
    /// The file's number (from 0) of every vertex, where vertices have been dropped.
    file_vertices: Option<Vec<u32>>,
    /// Vertices of the file that belong to no triangle; without mass they cannot be simulated.
    pub dropped: usize,
}

impl From<TriangleMesh> for FileMesh {
    fn from(mesh: TriangleMesh) -> FileMesh {
        FileMesh { mesh, file_vertices: None, dropped: 0 }
    }
}

impl FileMesh {
    /// The mesh's vertex with this number (from 0) in the file, unless it was dropped or never existed.
    pub fn vertex(&self, file_vertex: u32) -> Option<u32> {
        match &self.file_vertices {
            None => ((file_vertex as usize) < self.mesh.positions.len()).then_some(file_vertex),
            Some(numbers) => numbers.binary_search(&file_vertex).ok().map(|vertex| vertex as u32),
        }
    }

    /// A sentence about what has been dropped, if anything has.
    pub fn left_out(&self, path: &Path) -> Option<String> {
        let what = match self.dropped {
            0 => return None,
            1 => "1 vertex belongs to no triangle and is left out".to_owned(),
            count => format!("{count} vertices belong to no triangle and are left out"),
        };
        Some(format!("{}: {what}", path.display()))
    }
}
