//! A mesh with vertices joined along seams, and why it would not be cloth.

use std::collections::HashMap;

use super::{TriangleMesh, ascending};
use crate::math::Vec3;

/// A mesh with every set of paired vertices as one vertex. The triangles and their material coordinates are those of
/// the mesh before, so a vertex of a seam has one place at rest for every panel.
#[derive(Clone, Debug, PartialEq)]
pub struct SewnMesh {
    /// Joined vertices lie at the mean of their places.
    pub mesh: TriangleMesh,
    /// The vertex here of every vertex before. Vertices keep the order of the first of their set.
    pub vertex_of: Vec<u32>,
}

/// Why joining vertices does not give cloth. Vertices and triangles are those of the mesh before, from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SewnFault {
    /// Two corners of a triangle become one.
    Collapsed {
        /// The triangle.
        triangle: u32,
        /// The corners.
        corners: [u32; 2],
    },
    /// An edge gets more than two triangles.
    Manifold {
        /// The edge in the first of them.
        edge: [u32; 2],
        /// The first of them.
        triangle: u32,
        /// The number of triangles.
        count: usize,
    },
    /// Two triangles run along their common edge in the same direction.
    Orientation {
        /// The edge in the first of them.
        edge: [u32; 2],
        /// The triangles.
        triangles: [u32; 2],
    },
}

impl SewnFault {
    /// The vertices that the fault is at.
    pub fn vertices(&self) -> [u32; 2] {
        match *self {
            SewnFault::Collapsed { corners, .. } => corners,
            SewnFault::Manifold { edge, .. } | SewnFault::Orientation { edge, .. } => edge,
        }
    }
}

impl SewnMesh {
    /// Joins the vertices of every pair of `mesh`, and with them those that they are joined with.
    ///
    /// # Errors
    /// The result is not an oriented manifold.
    pub fn new(mesh: &TriangleMesh, pairs: &[[u32; 2]]) -> Result<SewnMesh, SewnFault> {
        let first = first_of_sets(mesh.positions.len(), pairs);
        let mut vertex_of = vec![0u32; first.len()];
        let mut count = 0u32;
        for v in 0..first.len() {
            if first[v] as usize == v {
                (vertex_of[v], count) = (count, count + 1);
            } else {
                vertex_of[v] = vertex_of[first[v] as usize];
            }
        }
        let triangles: Vec<[u32; 3]> = mesh.triangles.iter().map(|t| t.map(|v| vertex_of[v as usize])).collect();
        check(mesh, &triangles)?;
        let mut sums = vec![(crate::math::DVec3::ZERO, 0u32); count as usize];
        for (&vertex, p) in vertex_of.iter().zip(&mesh.positions) {
            let (sum, members) = &mut sums[vertex as usize];
            (*sum, *members) = (*sum + p.as_dvec3(), *members + 1);
        }
        let positions: Vec<Vec3> = sums.iter().map(|(sum, members)| (*sum / f64::from(*members)).as_vec3()).collect();
        Ok(SewnMesh { mesh: TriangleMesh { positions, triangles, material_uv: mesh.material_uv.clone() }, vertex_of })
    }
}

/// The smallest vertex of the set of every vertex, in ascending order of the vertices.
fn first_of_sets(vertices: usize, pairs: &[[u32; 2]]) -> Vec<u32> {
    let mut first: Vec<u32> = (0..vertices as u32).collect();
    fn root(first: &mut [u32], mut v: u32) -> u32 {
        while first[v as usize] != v {
            first[v as usize] = first[first[v as usize] as usize];
            v = first[v as usize];
        }
        v
    }
    for &[a, b] in pairs {
        let [a, b] = ascending([root(&mut first, a), root(&mut first, b)]);
        first[b as usize] = a;
    }
    for v in 0..first.len() {
        first[v] = first[first[v] as usize];
    }
    first
}

/// Checks that every triangle keeps its corners and every edge has one triangle, or two that run against each other.
fn check(before: &TriangleMesh, triangles: &[[u32; 3]]) -> Result<(), SewnFault> {
    let mut first_on: HashMap<[u32; 2], (u32, usize, bool)> = HashMap::with_capacity(2 * triangles.len());
    let mut mixed: Option<SewnFault> = None;
    let mut crowded: Option<SewnFault> = None;
    for (t, corners) in triangles.iter().enumerate() {
        for side in 0..3 {
            let own = [before.triangles[t][side], before.triangles[t][(side + 1) % 3]];
            let [a, b] = [corners[side], corners[(side + 1) % 3]];
            if a == b {
                return Err(SewnFault::Collapsed { triangle: t as u32, corners: own });
            }
            let on = first_on.entry(ascending([a, b])).or_insert((t as u32, 0, a < b));
            on.1 += 1;
            let (first, count, ascends) = *on;
            let at = (0..3).find(|&i| {
                let of_first = triangles[first as usize];
                ascending([of_first[i], of_first[(i + 1) % 3]]) == ascending([a, b])
            });
            let of_first = before.triangles[first as usize];
            let edge = at.map_or(own, |i| [of_first[i], of_first[(i + 1) % 3]]);
            if count > 2 {
                crowded = Some(SewnFault::Manifold { edge, triangle: first, count });
            } else if count == 2 && ascends == (a < b) && mixed.is_none() {
                mixed = Some(SewnFault::Orientation { edge, triangles: [first, t as u32] });
            }
        }
    }
    crowded.or(mixed).map_or(Ok(()), Err)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::flatten_triangles;

    /// Two triangles beside each other, 0 1 2 and 3 4 5; 1 2 and 3 5 face each other.
    fn two() -> TriangleMesh {
        let at = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        let positions = vec![at(0.0, 0.0), at(1.0, 0.0), at(1.0, 1.0), at(1.2, 0.0), at(2.2, 0.0), at(1.2, 1.0)];
        let triangles = vec![[0, 1, 2], [3, 4, 5]];
        TriangleMesh { material_uv: flatten_triangles(&positions, &triangles), positions, triangles }
    }

    #[test]
    fn pairs_become_vertices_in_the_middle() {
        let sewn = SewnMesh::new(&two(), &[[3, 1], [5, 2]]).unwrap();
        assert_eq!(sewn.vertex_of, [0, 1, 2, 1, 3, 2]);
        assert_eq!(sewn.mesh.triangles, [[0, 1, 2], [1, 3, 2]]);
        assert_eq!(sewn.mesh.positions[1], Vec3::new(1.1, 0.0, 0.0));
        assert_eq!(sewn.mesh.material_uv, two().material_uv);
        // Three that belong together through one of them.
        assert_eq!(first_of_sets(6, &[[5, 3], [3, 1], [4, 0]]), [0, 1, 2, 1, 0, 1]);
    }

    #[test]
    fn what_would_not_be_cloth_is_named() {
        let fault = |pairs: &[[u32; 2]]| SewnMesh::new(&two(), pairs).unwrap_err();
        assert_eq!(fault(&[[0, 1]]), SewnFault::Collapsed { triangle: 0, corners: [0, 1] });
        assert_eq!(fault(&[[1, 5], [2, 3]]), SewnFault::Orientation { edge: [1, 2], triangles: [0, 1] });
        let mut three = two();
        three.positions.extend([Vec3::new(1.1, 0.0, 0.3), Vec3::new(1.1, 1.0, 0.3), Vec3::new(1.1, 0.5, 1.0)]);
        three.triangles.push([6, 8, 7]);
        three.material_uv.push(three.material_uv[0]);
        let fault = SewnMesh::new(&three, &[[3, 1], [5, 2], [6, 1], [7, 2]]).unwrap_err();
        assert_eq!(fault, SewnFault::Manifold { edge: [1, 2], triangle: 0, count: 3 });
    }
}
