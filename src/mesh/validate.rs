//! Requirements of a mesh for simulation. Errors name triangles and vertices counting from 1, as OBJ files do.
//!
//! Triangles that cross each other are not searched here; `first_intersection` finds them.

use crate::math::Vec3;

use super::{Surface, TriangleMesh, material};

/// Smallest doubled area over the squared longest edge, about height over length of a needle triangle. Below it the
/// inverse rest matrix has no correct digit in f32.
const SMALLEST_SHAPE: f64 = 1e-6;

/// Largest coordinate of a mesh. Beyond it the solver leaves the range of f32 (seen from 1e12 m on).
const LARGEST_COORDINATE: f32 = 1e9;
/// Smallest longest edge of a rest triangle. Below it the solver leaves the range of f32 (seen at 1e-9 m).
const SMALLEST_EDGE: f64 = 1e-7;

/// Why a mesh cannot be simulated.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MeshFault {
    #[error("no triangle in it")]
    Empty,
    #[error("{0} vertices are too many: at most 2147483647 can be numbered")]
    TooManyVertices(usize),
    #[error("vertex {0} has a coordinate that is not a finite number")]
    NonFinitePosition(usize),
    #[error(
        "vertex {vertex} has the coordinate {value:e}; beyond {LARGEST_COORDINATE:e} nothing can be computed \
         in single precision"
    )]
    TooFar { vertex: usize, value: f32 },
    #[error("triangle {triangle} names vertex {vertex}, but there are only {vertices}")]
    IndexOutOfRange { triangle: usize, vertex: u64, vertices: usize },
    #[error("triangle {triangle} names vertex {vertex} twice; its corners must differ")]
    RepeatedVertex { triangle: usize, vertex: u64 },
    #[error("the edge of vertices {} and {} belongs to {count} triangles ({}, {}, {}, ..); at most two may share an edge",
        edge[0], edge[1], triangles[0], triangles[1], triangles[2])]
    NonManifoldEdge { edge: [u64; 2], triangles: [usize; 3], count: usize },
    #[error("triangles {} and {} run along their edge of vertices {} and {} in the same direction; turn one of them over",
        triangles[0], triangles[1], edge[0], edge[1])]
    MixedOrientation { edge: [u64; 2], triangles: [usize; 2] },
    #[error("the surface has one side only, as a Moebius strip has (no winding suits all its triangles; {} and {} disagree): cut it \
        from border to border, so that the cut's vertices are there twice", triangles[0], triangles[1])]
    OneSided { triangles: [usize; 2] },
    #[error("joining vertices within weld_m makes a line of triangle {0}; choose a smaller weld_m")]
    Collapsed(usize),
    #[error("vertex {0} belongs to no triangle and so has no mass; remove it")]
    UnusedVertex(usize),
    #[error("{triangles} triangles have {coordinates} triples of material coordinates; every triangle needs one")]
    MaterialCount { triangles: usize, coordinates: usize },
    #[error("triangle {0} has a material coordinate that is not a finite number")]
    NonFiniteMaterial(usize),
    #[error("triangle {0} has no area in space: its corners lie on one line")]
    ZeroArea(usize),
    #[error("triangle {0} has no area in material space: its texture coordinates lie on one line")]
    ZeroMaterialArea(usize),
    #[error(
        "triangle {triangle} is too small at rest: its longest edge is {edge:.3e}, and at least {SMALLEST_EDGE:e} \
         is needed to compute"
    )]
    TooSmall { triangle: usize, edge: f64 },
}

/// Checks everything that [`MeshFault`] lists and reports the first fault.
pub fn validate(mesh: &TriangleMesh) -> Result<(), MeshFault> {
    let used = check_surface(&mesh.positions, &mesh.triangles)?;
    if let Some(vertex) = used.iter().position(|&used| !used) {
        return Err(MeshFault::UnusedVertex(vertex + 1));
    }
    check_material(mesh)
}

/// Checks an obstacle's surface: finite coordinates, indices in range, every triangle with an area.
pub fn check_obstacle(surface: &Surface) -> Result<(), MeshFault> {
    check_triangles(&surface.positions, &surface.triangles).map(|_| ())
}

/// The part of [`validate`] that does not need material coordinates. Returns the used vertices.
pub(super) fn check_surface(positions: &[Vec3], triangles: &[[u32; 3]]) -> Result<Vec<bool>, MeshFault> {
    let used = check_triangles(positions, triangles)?;
    check_edges(triangles, positions.len())?;
    Ok(used)
}

pub(super) fn check_triangles(positions: &[Vec3], triangles: &[[u32; 3]]) -> Result<Vec<bool>, MeshFault> {
    if triangles.is_empty() {
        return Err(MeshFault::Empty);
    }
    if positions.len() > i32::MAX as usize {
        return Err(MeshFault::TooManyVertices(positions.len()));
    }
    if let Some(vertex) = positions.iter().position(|p| !p.is_finite()) {
        return Err(MeshFault::NonFinitePosition(vertex + 1));
    }
    if let Some(vertex) = positions.iter().position(|p| p.abs().max_element() > LARGEST_COORDINATE) {
        let p = positions[vertex].to_array();
        let value = p.into_iter().fold(0.0, |most: f32, x| if x.abs() > most.abs() { x } else { most });
        return Err(MeshFault::TooFar { vertex: vertex + 1, value });
    }
    let mut used = vec![false; positions.len()];
    for (t, corners) in triangles.iter().enumerate() {
        for (i, &v) in corners.iter().enumerate() {
            let vertex = u64::from(v) + 1;
            match used.get_mut(v as usize) {
                Some(used) => *used = true,
                None => return Err(MeshFault::IndexOutOfRange { triangle: t + 1, vertex, vertices: positions.len() }),
            }
            if corners[..i].contains(&v) {
                return Err(MeshFault::RepeatedVertex { triangle: t + 1, vertex });
            }
        }
    }
    if let Some(t) = triangles.iter().position(|corners| is_flat(positions, corners)) {
        return Err(MeshFault::ZeroArea(t + 1));
    }
    Ok(used)
}

fn is_flat(positions: &[Vec3], corners: &[u32; 3]) -> bool {
    let [a, b, c] = corners.map(|v| positions[v as usize].as_dvec3());
    let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
    // `<=` also catches a triangle with coincident corners.
    (b - a).cross(c - a).length() <= SMALLEST_SHAPE * longest
}

/// Marks triangles without area or with a repeated corner. Only triangles with valid indices and finite corners are
/// examined; [`check_obstacle`] reports the others.
pub(crate) fn needles(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<bool> {
    let known = |corners: &[u32; 3]| corners.iter().all(|&v| positions.get(v as usize).is_some_and(|p| p.is_finite()));
    triangles.iter().map(|corners| known(corners) && is_flat(positions, corners)).collect()
}

/// Sorts the directed edges. An edge takes 8 bytes, because this is the largest array while a mesh is read.
fn check_edges(triangles: &[[u32; 3]], vertices: usize) -> Result<(), MeshFault> {
    // There are v (v - 1) directed edges and each can belong to one triangle, so a longer list repeats an edge among
    // its first entries. This bounds the memory for a file that repeats short faces.
    let enough = triangles.len().min(vertices.saturating_mul(vertices - 1) / 3 + 1);
    let mut edges: Vec<u64> = triangles[..enough]
        .iter()
        .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
        .map(|(from, to)| u64::from(from.min(to)) << 33 | u64::from(from.max(to)) << 1 | u64::from(from > to))
        .collect();
    edges.sort_unstable();
    for group in edges.chunk_by(|a, b| a >> 1 == b >> 1) {
        let mixed = group.len() == 2 && group[0] == group[1];
        if group.len() < 2 || (group.len() == 2 && !mixed) {
            continue;
        }
        let edge = [(group[0] >> 33) as u32, (group[0] >> 1) as u32];
        let owners: Vec<usize> =
            (0..triangles.len()).filter(|&t| edge.iter().all(|v| triangles[t].contains(v))).collect();
        let edge = edge.map(|v| u64::from(v) + 1);
        return Err(match owners[..] {
            [a, b, c, ..] => MeshFault::NonManifoldEdge { edge, triangles: [a + 1, b + 1, c + 1], count: owners.len() },
            [a, b] => MeshFault::MixedOrientation { edge, triangles: [a + 1, b + 1] },
            _ => unreachable!("an edge found twice has two triangles, whose corners differ"),
        });
    }
    Ok(())
}

/// The part of [`validate`] for material coordinates.
pub(super) fn check_material(mesh: &TriangleMesh) -> Result<(), MeshFault> {
    if mesh.material_uv.len() != mesh.triangles.len() {
        return Err(MeshFault::MaterialCount { triangles: mesh.triangles.len(), coordinates: mesh.material_uv.len() });
    }
    for (t, uv) in mesh.material_uv.iter().enumerate() {
        if !uv.iter().all(|p| p.is_finite()) {
            return Err(MeshFault::NonFiniteMaterial(t + 1));
        }
        let [a, b, c] = uv.map(|p| p.as_dvec2());
        let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
        if material::doubled_area(uv).abs() <= SMALLEST_SHAPE * longest {
            return Err(MeshFault::ZeroMaterialArea(t + 1));
        }
        if longest < SMALLEST_EDGE * SMALLEST_EDGE {
            return Err(MeshFault::TooSmall { triangle: t + 1, edge: longest.sqrt() });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Vec2;
    use crate::mesh::flatten_triangles;

    fn square() -> TriangleMesh {
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
        let triangles = vec![[0, 1, 2], [0, 2, 3]];
        TriangleMesh { material_uv: flatten_triangles(&positions, &triangles), positions, triangles }
    }

    /// The error of a square that `change` has damaged.
    fn fault(change: impl FnOnce(&mut TriangleMesh)) -> String {
        let mut mesh = square();
        change(&mut mesh);
        validate(&mesh).unwrap_err().to_string()
    }

    #[test]
    fn a_square_is_fine() {
        assert_eq!(validate(&square()), Ok(()));
    }

    #[test]
    fn every_fault_is_named() {
        assert_eq!(fault(|m| m.triangles.clear()), "no triangle in it");
        assert_eq!(
            fault(|m| m.positions[2].y = f32::INFINITY),
            "vertex 3 has a coordinate that is not a finite number"
        );
        assert_eq!(
            fault(|m| m.positions[2].y = -3e38),
            "vertex 3 has the coordinate -3e38; beyond 1e9 nothing can be computed in single precision"
        );
        assert_eq!(
            fault(|m| m.material_uv.iter_mut().flatten().for_each(|uv| *uv *= 1e-9)),
            "triangle 1 is too small at rest: its longest edge is 1.414e-9, and at least 1e-7 is needed to compute"
        );
        assert_eq!(fault(|m| m.triangles[1][1] = 9), "triangle 2 names vertex 10, but there are only 4");
        assert_eq!(fault(|m| m.triangles[1][1] = 3), "triangle 2 names vertex 4 twice; its corners must differ");
        assert_eq!(
            fault(|m| m.triangles.push([0, 2, 1])),
            "the edge of vertices 1 and 3 belongs to 3 triangles (1, 2, 3, ..); at most two may share an edge"
        );
        assert_eq!(
            fault(|m| m.triangles[1] = [2, 0, 3]),
            "triangles 1 and 2 run along their edge of vertices 1 and 3 in the same direction; turn one of them over"
        );
        assert_eq!(
            fault(|m| m.positions.push(Vec3::Z)),
            "vertex 5 belongs to no triangle and so has no mass; remove it"
        );
        assert_eq!(
            fault(|m| m.material_uv.truncate(1)),
            "2 triangles have 1 triples of material coordinates; every triangle needs one"
        );
        assert_eq!(
            fault(|m| m.material_uv[0][0].x = f32::NAN),
            "triangle 1 has a material coordinate that is not a finite number"
        );
        assert_eq!(
            fault(|m| m.positions[3] = Vec3::new(0.5, 0.5, 0.0)),
            "triangle 2 has no area in space: its corners lie on one line"
        );
        assert_eq!(
            fault(|m| m.material_uv[1] = [Vec2::ZERO; 3]),
            "triangle 2 has no area in material space: its texture coordinates lie on one line"
        );
    }
}
