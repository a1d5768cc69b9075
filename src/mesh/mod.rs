//! Triangle meshes: storage, files, validation, adjacency, material space, ordering and the start-state check.
//!
//! A mesh describes the start of a scene and never moves. Files are read in one pass with memory proportional to the
//! file. Counts in a file are not trusted before that many bytes have been read.

mod adjacency;
mod border;
mod closed;
mod crossings;
mod file_mesh;
mod intersect;
mod irregular;
pub mod level_set;
mod material;
mod nearest;
mod nested;
mod obj;
mod order;
mod panel;
mod ply;
mod polygon;
mod refinement;
mod sewn;
pub mod shapes;
mod stitches;
mod untangle;
mod validate;
mod weld;
mod winding;
mod words;

use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::input::{Input, Streams};
use crate::math::{DVec3, FAR_M, Vec2, Vec3, bounds, local_origin};

pub use adjacency::{Hinge, hinges, pieces, unique_edges};
pub(crate) use border::ascending;
pub use border::{Border, BorderEdge, EdgeCut, Meeting, match_sides};
pub use closed::closed_parts;
pub use crossings::{Group, GroupKind, MOST_PAIRS, crossings, first_intersection, triangles_meet};
pub use file_mesh::{FileMesh, MaterialSource, MeshOptions, extent};
pub use intersect::edge_crosses_triangle;
pub use material::{TextureFit, flatten_triangle, flatten_triangles};
pub use nearest::{NearestPoint, SurfacePoint, place};
pub use nested::{LEVELS_MAX, NestedSheet, Outline};
pub use obj::parse_obj;
pub(crate) use obj::parse_obj_far;
pub use order::{locality_order, middle, vertex_order};
pub use panel::{PanelMesh, panel_mesh};
pub use ply::parse_ply;
pub(crate) use ply::parse_ply_far;
pub(crate) use polygon::triangles_of_faces;
pub use refinement::{Refinement, coarser};
pub use sewn::{SewnFault, SewnMesh};
pub use untangle::{Tangle, Untangled};
pub(crate) use validate::needles;
pub use validate::{MeshFault, check_obstacle, validate};
pub use weld::first_at_place;

/// A triangle mesh of cloth in its start state. Triangles are counter-clockwise, and every vertex is in a triangle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// World positions at time 0, meters.
    pub positions: Vec<Vec3>,
    /// Vertex indices of every triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Material-space (rest) coordinates of every triangle's corners, meters: x = warp, y = weft. They are
    /// counter-clockwise and stored per corner, so that a seam (one vertex with several texture coordinates) needs no
    /// special case.
    pub material_uv: Vec<[Vec2; 3]>,
}

/// Why a mesh file is refused: one sentence with the file and, if its format has lines, the line.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, thiserror::Error)]
pub enum MeshReadError {
    /// The file cannot be opened or read.
    #[error("{}: cannot be read: {reason}", path.display())]
    Unreadable { path: PathBuf, reason: String },
    /// The file ends neither in `.obj` nor in `.ply`.
    #[error("{}: a mesh file ends in .obj or .ply", path.display())]
    UnknownFormat { path: PathBuf },
    /// A line, a header or a record of the file is wrong.
    #[error("{}{}: {}", path.display(), fault.place(), fault.what)]
    Syntax { path: PathBuf, fault: ParseFault },
    /// The file is well-formed, but its mesh cannot be simulated.
    #[error("{}: {fault}", path.display())]
    Mesh { path: PathBuf, fault: MeshFault },
}

/// An error in the text or bytes of a mesh file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{what}")]
pub struct ParseFault {
    /// Line from 1; none for formats without lines.
    pub line: Option<u64>,
    /// The error and the correct form.
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
/// Self-intersections are not searched here; [`first_intersection`] finds them once all pieces of a scene are in place.
pub fn read_mesh(path: &Path, options: impl Into<MeshOptions>) -> Result<FileMesh, MeshReadError> {
    let options = options.into();
    let surface = read_file(path, options.unit_m)?;
    surface.into_mesh(options).map_err(|fault| MeshReadError::Mesh { path: path.into(), fault })
}

/// Reads an obstacle's surface from an OBJ or PLY file, with all vertices in the order of the file, used or not.
///
/// Indices, finite coordinates and areas are checked. Unlike for cloth, edges can have any number of triangles with any
/// winding. Its base is zero, so positions far from the origin are rounded as f32 rounds them.
pub fn read_surface(path: &Path) -> Result<Surface, MeshReadError> {
    let surface = read_file(path, 0.0)?;
    check_obstacle(&surface).map_err(|fault| MeshReadError::Mesh { path: path.into(), fault })?;
    Ok(surface)
}

/// Like [`read_surface`], but triangles without area are left out, because anything that hits them hits their neighbors
/// too. The second value is a sentence about their number, if any.
///
/// `unit_m`: meters per unit of the file.
pub fn read_obstacle(path: &Path, unit_m: f64) -> Result<(Surface, Option<String>), MeshReadError> {
    let mut surface = read_file(path, unit_m)?;
    let needles = needles(&surface.positions, &surface.triangles);
    // If no triangle would be left, the check below reports the first one.
    let left_out = if needles.contains(&false) { surface.leave_out(&needles, path) } else { None };
    check_obstacle(&surface).map_err(|fault| MeshReadError::Mesh { path: path.into(), fault })?;
    Ok((surface, left_out))
}

/// Reads the content of a file and checks its syntax only. `unit_m`: meters per unit of the file; 0: positions are
/// never far.
pub(crate) fn read_file(path: &Path, unit_m: f64) -> Result<Surface, MeshReadError> {
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
    let far = FAR_M / unit_m;
    let parsed = match extension.as_str() {
        "obj" => parse_obj_far(input.reader, far),
        _ => parse_ply_far(input.reader, input.bytes, far),
    };
    parsed.map_err(|fault| MeshReadError::Syntax { path: path.into(), fault })
}

/// Content of a mesh file, with the file's own vertex numbering.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// Point that `positions` are relative to: zero, or for a file far from its origin a point in the middle of it.
    pub base: DVec3,
    /// Positions relative to `base`, in the unit of the file; meters once they are placed.
    pub positions: Vec<Vec3>,
    /// Triangles; larger polygons have been triangulated.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates of every triangle's corners. Empty if a corner has none.
    pub texture_uv: Vec<[Vec2; 3]>,
    /// Objects and groups, ascending by triangles. Empty if the file has none.
    pub parts: Vec<Part>,
    /// Further numbers of the vertices.
    pub properties: Vec<VertexProperty>,
    /// Named edges: vertices from end to end.
    pub edges: Vec<(String, Vec<u32>)>,
    /// Seams between borders.
    pub seams: Vec<FileSeam>,
}

/// A seam of a mesh file: its name, and the vertices of the file along both sides. The first vertex of one side meets
/// that of the other.
pub type FileSeam = (String, [Vec<u32>; 2]);

/// A number that a file gives to every vertex, such as a selection that was painted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VertexProperty {
    /// Its name in the file.
    pub name: String,
    /// Its value at every vertex of the file.
    pub values: Vec<f32>,
}

/// Triangles of one object and group of a file.
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
    /// True if `name` is the object, one of the groups or all groups together.
    pub fn is_named(&self, name: &str) -> bool {
        self.object == name || self.group == name || self.group.split_whitespace().any(|group| group == name)
    }
}

/// Positions of a file, rounded to f32 about a base: the local origin of a file with coordinates beyond `far`, else
/// zero.
fn rounded(positions: &[DVec3], far: f64) -> (DVec3, Vec<Vec3>) {
    let (low, high) = bounds(positions.iter().copied());
    let base = if positions.is_empty() { DVec3::ZERO } else { local_origin(low, high, far) };
    (base, positions.iter().map(|p| (p - base).as_vec3()).collect())
}

impl Surface {
    /// Drops triangles and returns a sentence with their number. `path` names the file in it.
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
