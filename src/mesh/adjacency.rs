//! Edges, bending stencils and connected pieces of a validated mesh. Their order depends on the mesh alone.

use super::TriangleMesh;

/// An interior edge and its two triangles: the stencil of dihedral bending.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hinge {
    /// `[edge0, edge1, opposite of triangle 0, opposite of triangle 1]`, with `edge0 < edge1`.
    pub vertices: [u32; 4],
    /// Triangle 0 traverses the edge from `edge0` to `edge1`, triangle 1 in the opposite direction.
    pub triangles: [u32; 2],
}

/// Every edge once as `[smaller, larger]`, ascending.
pub fn unique_edges(mesh: &TriangleMesh) -> Vec<[u32; 2]> {
    let mut edges: Vec<u64> = mesh
        .triangles
        .iter()
        .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
        .map(|(from, to)| u64::from(from.min(to)) << 32 | u64::from(from.max(to)))
        .collect();
    edges.sort_unstable();
    edges.dedup();
    edges.into_iter().map(|edge| [(edge >> 32) as u32, edge as u32]).collect()
}

/// The interior edges, ascending by (edge0, edge1).
pub fn hinges(mesh: &TriangleMesh) -> Vec<Hinge> {
    let triangles = &mesh.triangles;
    // (edge, triangle) pairs. An edge has at most two triangles, so their order is unique.
    let mut sides: Vec<(u64, u32)> = Vec::with_capacity(3 * triangles.len());
    for (t, &[a, b, c]) in triangles.iter().enumerate() {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            sides.push((u64::from(from.min(to)) << 32 | u64::from(from.max(to)), t as u32));
        }
    }
    sides.sort_unstable();
    let mut hinges = Vec::with_capacity(sides.len() / 2);
    for pair in sides.windows(2).filter(|pair| pair[0].0 == pair[1].0) {
        let (edge, first, second) = (pair[0].0, pair[0].1, pair[1].1);
        let (edge0, edge1) = ((edge >> 32) as u32, edge as u32);
        let runs_forward =
            |t: u32| (0..3).any(|i| triangles[t as usize][i] == edge0 && triangles[t as usize][(i + 1) % 3] == edge1);
        let pair = if runs_forward(first) { [first, second] } else { [second, first] };
        // XOR with both ends of the edge leaves the opposite corner of the triangle's three indices.
        let opposite = pair.map(|t| triangles[t as usize].iter().fold(edge0 ^ edge1, |rest, &v| rest ^ v));
        hinges.push(Hinge { vertices: [edge0, edge1, opposite[0], opposite[1]], triangles: pair });
    }
    hinges
}

/// For every vertex, the smallest vertex of its connected piece.
pub fn pieces(vertices: usize, triangles: &[[u32; 3]]) -> Vec<u32> {
    let mut parent: Vec<u32> = (0..vertices as u32).collect();
    fn root(parent: &mut [u32], mut vertex: u32) -> u32 {
        while parent[vertex as usize] != vertex {
            parent[vertex as usize] = parent[parent[vertex as usize] as usize];
            vertex = parent[vertex as usize];
        }
        vertex
    }
    for &[a, b, c] in triangles {
        for other in [b, c] {
            let (one, other) = (root(&mut parent, a), root(&mut parent, other));
            parent[one.max(other) as usize] = one.min(other);
        }
    }
    // Parents are never larger than their children, so a parent is final before its children are visited.
    for vertex in 0..vertices {
        parent[vertex] = parent[parent[vertex] as usize];
    }
    parent
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mesh(triangles: &[[u32; 3]]) -> TriangleMesh {
        TriangleMesh { triangles: triangles.to_vec(), ..TriangleMesh::default() }
    }

    #[test]
    fn two_triangles_have_one_hinge() {
        let square = mesh(&[[0, 1, 2], [0, 2, 3]]);
        assert_eq!(unique_edges(&square), [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]);
        assert_eq!(hinges(&square), [Hinge { vertices: [0, 2, 3, 1], triangles: [1, 0] }]);
        assert_eq!(hinges(&mesh(&[[0, 1, 2], [3, 2, 1]])), [Hinge { vertices: [1, 2, 0, 3], triangles: [0, 1] }]);
    }

    #[test]
    fn a_tetrahedron_has_a_hinge_at_every_edge() {
        let hinges = hinges(&mesh(&[[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]));
        assert_eq!(hinges.len(), 6);
        assert!(hinges.iter().all(|h| h.vertices.iter().sum::<u32>() == 6), "four different vertices: {hinges:?}");
        assert_eq!(hinges[0], Hinge { vertices: [0, 1, 3, 2], triangles: [1, 0] });
    }
}
