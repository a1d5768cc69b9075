//! Triangles around each vertex (one-ring). They decide whether a point near an edge or a vertex of a surface is
//! closest there.

use super::broad::CollisionMesh;

/// Triangles around every vertex of a mesh.
#[derive(Clone, Debug)]
pub(super) struct Around {
    first: Vec<u32>,
    triangles: Vec<u32>,
}

impl Around {
    pub(super) fn new(mesh: &CollisionMesh) -> Around {
        let mut first = vec![0; mesh.vertices + 1];
        for &vertex in mesh.triangles.as_flattened() {
            first[vertex as usize + 1] += 1;
        }
        for vertex in 0..mesh.vertices {
            first[vertex + 1] += first[vertex];
        }
        let mut next = first.clone();
        let mut triangles = vec![0; 3 * mesh.triangles.len()];
        for (triangle, corners) in (0..).zip(&mesh.triangles) {
            for &vertex in corners {
                triangles[next[vertex as usize] as usize] = triangle;
                next[vertex as usize] += 1;
            }
        }
        Around { first, triangles }
    }

    /// Corners of the triangles around a vertex, in the order of the mesh.
    pub(super) fn faces<'a>(&'a self, mesh: &'a CollisionMesh, vertex: u32) -> impl Iterator<Item = [u32; 3]> + 'a {
        let (start, end) = (self.first[vertex as usize], self.first[vertex as usize + 1]);
        self.triangles[start as usize..end as usize].iter().map(|&t| mesh.triangles[t as usize])
    }

    /// Vertices that share an edge with a vertex; most of them twice.
    pub(super) fn neighbors<'a>(&'a self, mesh: &'a CollisionMesh, vertex: u32) -> impl Iterator<Item = u32> + 'a {
        self.faces(mesh, vertex).flatten().filter(move |&other| other != vertex)
    }

    /// Third corners of the triangles at an edge.
    pub(super) fn opposite<'a>(&'a self, mesh: &'a CollisionMesh, [a, b]: [u32; 2]) -> impl Iterator<Item = u32> + 'a {
        self.faces(mesh, a).filter(move |face| face.contains(&b)).flatten().filter(move |&v| v != a && v != b)
    }

    /// Bytes of both lists; every rank holds them.
    pub(super) fn bytes(&self) -> u64 {
        4 * (self.first.len() + self.triangles.len()) as u64
    }
}
