//! What the stages of detection pass on: pairs of features that may touch, and pairs that do within a step. Plain data,
//! the same on every executor.

use bytemuck::{Pod, Zeroable};

/// The two ways to read the four vertices of a [`Candidate`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u32)]
pub enum CandidateKind {
    /// A vertex, then the three corners of a face in the order of the mesh.
    VertexFace = 0,
    /// Two edges, each with its smaller vertex first, the smaller edge (as a pair of vertices) first.
    EdgeEdge = 1,
}

/// A pair of features that may touch: plain data, the same on every executor. The derived order sorts all pairs of a
/// query into one list that does not depend on who found them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Pod, Zeroable)]
#[repr(C)]
pub struct Candidate {
    /// Vertices as [`CandidateKind`] says.
    pub vertices: [u32; 4],
    /// A [`CandidateKind`] as number, so that the candidate stays plain data.
    pub kind: u32,
}

impl Candidate {
    /// The candidate of a vertex and a face, whose corners come in the order of the mesh.
    #[inline]
    pub fn vertex_face(vertex: u32, [a, b, c]: [u32; 3]) -> Candidate {
        Candidate { vertices: [vertex, a, b, c], kind: CandidateKind::VertexFace as u32 }
    }

    /// The candidate of two edges; the same for every order of the edges and of their ends.
    #[inline]
    pub fn edge_edge(one: [u32; 2], other: [u32; 2]) -> Candidate {
        let sorted = |[a, b]: [u32; 2]| if a < b { [a, b] } else { [b, a] };
        let (one, other) = (sorted(one), sorted(other));
        let ([a0, a1], [b0, b1]) = if one < other { (one, other) } else { (other, one) };
        Candidate { vertices: [a0, a1, b0, b1], kind: CandidateKind::EdgeEdge as u32 }
    }

    /// How to read the vertices.
    #[inline]
    pub fn kind(&self) -> CandidateKind {
        if self.is_vertex_face() { CandidateKind::VertexFace } else { CandidateKind::EdgeEdge }
    }

    /// True for a vertex and a face, false for two edges.
    #[inline]
    pub fn is_vertex_face(&self) -> bool {
        self.kind == CandidateKind::VertexFace as u32
    }
}

/// A pair that continuous collision detection found to touch within a step: plain data, the same on every executor.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Impact {
    /// The pair that touches.
    pub candidate: Candidate,
    /// A lower bound of the first time of contact, in [0, 1] over the step; the pair is apart before it.
    pub toi: f32,
}

impl Impact {
    /// Sort key: one order of all impacts of a step, whoever found them.
    #[inline]
    pub fn key(&self) -> (Candidate, u32) {
        (self.candidate, self.toi.to_bits())
    }
}
