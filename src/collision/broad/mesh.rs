//! Triangles of cloth and obstacles as one mesh, and which triangle owns which vertex and edge. Holds no positions.

use thiserror::Error;

use super::cut::cut;
use crate::mesh::pieces;
use crate::partition::chunk_rows;

/// Why triangles do not make a [`CollisionMesh`].
#[derive(Debug, Error, PartialEq)]
pub enum CollisionMeshError {
    /// A corner is not a vertex of the mesh.
    #[error("triangle {triangle} uses vertex {vertex}, but the mesh has {vertices} vertices (0 to {})", vertices.saturating_sub(1))]
    VertexOutOfRange {
        /// Triangle, counting from 0.
        triangle: usize,
        /// Vertex at that corner.
        vertex: u32,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// Two corners are the same vertex.
    #[error("triangle {triangle} uses vertex {vertex} twice; its three corners must differ")]
    RepeatedVertex {
        /// Triangle, counting from 0.
        triangle: usize,
        /// Vertex at that corner.
        vertex: u32,
    },
    /// A triangle has corners in the cloth and in an obstacle.
    #[error("triangle {triangle} joins cloth and obstacle vertices (cloth vertices are those below {cloth_vertices})")]
    JoinsClothAndObstacle {
        /// Triangle, counting from 0.
        triangle: usize,
        /// First vertex of the obstacles.
        cloth_vertices: usize,
    },
    /// More cloth vertices than vertices.
    #[error("{cloth_vertices} cloth vertices were declared, but the mesh has only {vertices} vertices")]
    ClothVertices {
        /// Number of cloth vertices that was declared.
        cloth_vertices: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// Corners are numbered with 32 bits.
    #[error("the mesh has {count} {what}; collision detection takes at most 1431655765")]
    TooLarge {
        /// "vertices" or "triangles".
        what: &'static str,
        /// Their number.
        count: usize,
    },
}

/// Cloth and obstacles as one mesh. Every vertex and every edge is assigned to exactly one of its triangles
/// (representative triangles [Curtis et al. 2008]), so that testing every pair of triangles once, with the features that
/// the two own, tests every pair of features once. A vertex in no triangle takes no part.
#[derive(Clone, Debug)]
pub struct CollisionMesh {
    /// Vertices of cloth and obstacles.
    pub vertices: usize,
    /// Vertices from this one on belong to obstacles.
    pub cloth_vertices: usize,
    /// Triangles: cloth first, then obstacles, each patch by patch, a patch sorted by smallest vertex, so that
    /// neighbors in the list are neighbors in memory. Corners in the order they were given.
    pub triangles: Vec<[u32; 3]>,
    /// Number of cloth triangles; they come first.
    pub cloth_triangles: usize,
    /// Edges, smaller vertex first, ascending: comparing two edges compares their places in this list.
    pub edges: Vec<[u32; 2]>,
    /// Per triangle: bit k (0..3) is set if it owns corner k, bit 3 + k if it owns the edge from corner k to k + 1.
    pub owned: Vec<u8>,
    /// First triangle of every patch, and the end. A patch is a few dozen neighboring triangles of one piece.
    pub patches: Vec<u32>,
    /// Per vertex: the smallest vertex of its piece. A piece is a connected component, of cloth or of an obstacle.
    pub pieces: Vec<u32>,
}

/// Edge from corner `k` to the next one, smaller vertex first.
#[inline]
pub(super) fn edge_of([a, b, c]: [u32; 3], k: usize) -> [u32; 2] {
    let [from, to] = [[a, b], [b, c], [c, a]][k];
    if from < to { [from, to] } else { [to, from] }
}

impl CollisionMesh {
    /// The mesh of `triangles` (in any order) over `vertices` vertices, of which those below `cloth_vertices` are cloth.
    pub fn new(
        vertices: usize,
        cloth_vertices: usize,
        mut triangles: Vec<[u32; 3]>,
    ) -> Result<CollisionMesh, CollisionMeshError> {
        // A corner of a triangle must be a 32-bit number.
        const MOST: usize = (u32::MAX / 3) as usize;
        for (what, count) in [("vertices", vertices), ("triangles", triangles.len())] {
            if count > MOST {
                return Err(CollisionMeshError::TooLarge { what, count });
            }
        }
        if cloth_vertices > vertices {
            return Err(CollisionMeshError::ClothVertices { cloth_vertices, vertices });
        }
        for (triangle, &corners) in triangles.iter().enumerate() {
            if let Some(&vertex) = corners.iter().find(|&&v| v as usize >= vertices) {
                return Err(CollisionMeshError::VertexOutOfRange { triangle, vertex, vertices });
            }
            let [a, b, c] = corners;
            if a == b || b == c || c == a {
                return Err(CollisionMeshError::RepeatedVertex { triangle, vertex: if b == c { b } else { a } });
            }
            let cloth = corners.map(|v| (v as usize) < cloth_vertices);
            if cloth[0] != cloth[1] || cloth[0] != cloth[2] {
                return Err(CollisionMeshError::JoinsClothAndObstacle { triangle, cloth_vertices });
            }
        }
        // Obstacle vertices come last, so this puts the cloth first, too.
        triangles.sort_by_key(|t| t.iter().min().copied());
        let cloth_triangles = triangles.partition_point(|t| (t[0] as usize) < cloth_vertices);
        let pieces = pieces(vertices, &triangles);
        let mut patches = vec![0];
        // `cut` finds the triangles of a part by their smallest vertices, so these must still be sorted.
        cut(&mut triangles, &pieces, 0..cloth_vertices, chunk_rows(cloth_vertices), &mut patches);
        cut(&mut triangles, &pieces, cloth_vertices..vertices, vertices, &mut patches);
        let mut mesh = CollisionMesh {
            vertices,
            cloth_vertices,
            owned: vec![0; triangles.len()],
            pieces,
            patches,
            triangles,
            cloth_triangles,
            edges: Vec::new(),
        };
        mesh.assign_features();
        Ok(mesh)
    }

    /// Gives every feature to the one of its triangles that owns the fewest so far (to the first of several), so that
    /// the work per pair of triangles stays even.
    fn assign_features(&mut self) {
        let mut sides: Vec<([u32; 2], u32)> = Vec::with_capacity(3 * self.triangles.len());
        for (t, &corners) in self.triangles.iter().enumerate() {
            sides.extend((0..3).map(|k| (edge_of(corners, k), (t * 3 + k) as u32)));
        }
        sides.sort_unstable();
        for same in sides.chunk_by(|a, b| a.0 == b.0) {
            self.edges.push(same[0].0);
            self.assign(same.iter().map(|side| side.1), 3);
        }
        let mut corners: Vec<(u32, u32)> = Vec::with_capacity(3 * self.triangles.len());
        for (t, triangle) in self.triangles.iter().enumerate() {
            corners.extend((0..3).map(|k| (triangle[k], (t * 3 + k) as u32)));
        }
        corners.sort_unstable();
        for same in corners.chunk_by(|a, b| a.0 == b.0) {
            self.assign(same.iter().map(|corner| corner.1), 0);
        }
    }

    fn assign(&mut self, places: impl Iterator<Item = u32>, shift: u32) {
        let owner = places.min_by_key(|&place| (self.owned[place as usize / 3].count_ones(), place));
        if let Some(place) = owner {
            self.owned[place as usize / 3] |= 1 << (shift + place % 3);
        }
    }

    /// Bytes of the mesh; every rank holds all of it.
    pub fn bytes(&self) -> u64 {
        let lists = size_of_val(&self.triangles[..]) + size_of_val(&self.edges[..]) + size_of_val(&self.owned[..]);
        (lists + size_of_val(&self.pieces[..]) + size_of_val(&self.patches[..])) as u64
    }
}
