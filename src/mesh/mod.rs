//! Triangle meshes: storage, files, validation, adjacency, material space, ordering and the start-state check.
//!
//! Nothing here moves: a mesh is what a scene starts from. Files are read in one pass with memory proportional to the
//! file; no claim of a file is believed before the bytes behind it have been seen.

mod adjacency;
mod crossings;
mod file_mesh;
mod intersect;
mod material;
mod obj;
mod order;
mod ply;
mod polygon;
pub mod shapes;
mod untangle;
mod validate;
mod weld;
mod winding;

use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::input::{Input, Streams};
use crate::math::{Vec2, Vec3};

pub use adjacency::{Hinge, hinges, pieces, unique_edges};
pub use crossings::{Group, GroupKind, MOST_PAIRS, crossings, first_intersection};
pub use file_mesh::{FileMesh, MaterialSource, MeshOptions, extent};
pub use intersect::edge_crosses_triangle;
pub use material::{TextureFit, flatten_triangle, flatten_triangles};
pub use obj::parse_obj;
pub use order::{locality_order, middle, vertex_order};
pub use ply::parse_ply;
pub use untangle::{Tangle, Untangled};
pub(crate) use validate::needles;
pub use validate::{MeshFault, check_obstacle, validate};
pub use weld::first_at_place;

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
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
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

/// Reads and validates the mesh in an OBJ or PLY file.
///
/// Does not look for self-intersections: [`first_intersection`] does, once all pieces of a scene are in place.
pub fn read_mesh(path: &Path, options: impl Into<MeshOptions>) -> Result<FileMesh, MeshReadError> {
    read_file(path)?.into_mesh(options).map_err(|fault| MeshReadError::Mesh { path: path.into(), fault })
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

/// As [`read_surface`], but triangles without area are left out, because nothing can hit them that does not hit their
/// neighbors. The second value says how many, if any.
pub fn read_obstacle(path: &Path) -> Result<(Surface, Option<String>), MeshReadError> {
    let mut surface = read_file(path)?;
    let needles = needles(&surface.positions, &surface.triangles);
    // Where nothing would be left, the check names the first of them.
    let left_out = if needles.contains(&false) { surface.leave_out(&needles, path) } else { None };
    check_obstacle(&surface).map_err(|fault| MeshReadError::Mesh { path: path.into(), fault })?;
    Ok((surface, left_out))
}

/// Reads what the file holds; nothing but its form is checked.
pub(crate) fn read_file(path: &Path) -> Result<Surface, MeshReadError> {
    let unreadable = |error: std::io::Error| MeshReadError::Unreadable { path: path.into(), reason: error.to_string() };
    let mut name = path.to_path_buf();
    if name.extension().is_some_and(|e| e.eq_ignore_ascii_case("gz")) {
        name.set_extension("");
    }
    let extension = name.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    if extension != "obj" && extension != "ply" {
        return Err(MeshReadError::UnknownFormat { path: path.into() });
    }
    let input = Input::open(path, Streams::Refused).map_err(unreadable)?;
    let parsed = if extension == "obj" { parse_obj(input.reader) } else { parse_ply(input.reader, input.bytes) };
    parsed.map_err(|fault| MeshReadError::Syntax { path: path.into(), fault })
}

/// What a mesh file holds, with the file's own vertex numbering.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// World positions, metres.
    pub positions: Vec<Vec3>,
    /// Triangles; polygons have been cut.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates of the corners, or empty if a corner has none.
    pub texture_uv: Vec<[Vec2; 3]>,
    /// Objects and groups, ascending by triangles; empty if the file names none.
    pub parts: Vec<Part>,
}

/// Triangles of a file that stand under one object and group name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// Name of the object (`o`), or empty.
    pub object: String,
    /// Names of the groups (`g`), separated by blanks, or empty.
    pub group: String,
    /// Its triangles.
    pub triangles: Range<u32>,
}

impl Part {
    /// Whether this is its object, one of its groups or all of them.
    pub fn is_named(&self, name: &str) -> bool {
        self.object == name || self.group == name || self.group.split_whitespace().any(|group| group == name)
    }
}

impl Surface {
    /// Drops triangles and says how many; `path` names the file.
    pub(crate) fn leave_out(&mut self, dropped: &[bool], path: &Path) -> Option<String> {
        let first = dropped.iter().position(|&dropped| dropped)? + 1;
        let count = dropped.iter().filter(|&&dropped| dropped).count();
        let mut kept_before = vec![0];
        dropped.iter().for_each(|&dropped| kept_before.push(kept_before[kept_before.len() - 1] + u32::from(!dropped)));
        for part in &mut self.parts {
            let Range { start, end } = part.triangles;
            part.triangles = kept_before[start as usize]..kept_before[end as usize];
        }
        let mut keep = dropped.iter().map(|&dropped| !dropped);
        self.triangles.retain(|_| keep.next().unwrap_or(true));
        let mut keep = dropped.iter().map(|&dropped| !dropped);
        self.texture_uv.retain(|_| keep.next().unwrap_or(true));
        Some(match count {
            1 => format!("{}: triangle {first} has no area and is left out", path.display()),
            _ => format!("{}: {count} triangles without area are left out, the first is {first}", path.display()),
        })
    }
}
