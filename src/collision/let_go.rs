//! Pairs of cloth and obstacles that detection leaves out: what a state has let go.

use std::ops::Range;

use super::Candidate;

/// A vertex of the cloth and the vertices of an obstacle that takes no notice of it and of its triangles and edges.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOut {
    /// Vertex of the cloth.
    pub vertex: u32,
    /// Vertices of the obstacle.
    pub obstacle: Range<u32>,
}

/// All of them. Holds nothing and costs a comparison per group of candidates while there are none.
#[derive(Clone, Debug, Default)]
pub(super) struct LetGo {
    /// By vertex.
    pairs: Vec<LeftOut>,
    cloth_vertices: u32,
}

impl LetGo {
    pub(super) fn new(mut pairs: Vec<LeftOut>, cloth_vertices: usize) -> LetGo {
        pairs.sort_unstable_by_key(|pair| (pair.vertex, pair.obstacle.start));
        LetGo { pairs, cloth_vertices: cloth_vertices as u32 }
    }

    /// Whether a candidate has such a vertex on its one side and the obstacle on the other.
    #[inline(always)]
    pub(super) fn leaves_out(&self, candidate: &Candidate) -> bool {
        !self.pairs.is_empty() && self.holds(candidate)
    }

    fn holds(&self, candidate: &Candidate) -> bool {
        let (one, other) = candidate.vertices.split_at(if candidate.is_vertex_face() { 1 } else { 2 });
        let (cloth, obstacle) = match [one[0], other[0]].map(|v| v < self.cloth_vertices) {
            [true, false] => (one, other[0]),
            [false, true] => (other, one[0]),
            _ => return false,
        };
        cloth.iter().any(|&v| {
            let first = self.pairs.partition_point(|pair| pair.vertex < v);
            let of_vertex = self.pairs[first..].iter().take_while(|pair| pair.vertex == v);
            of_vertex.into_iter().any(|pair| pair.obstacle.contains(&obstacle))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vertex_takes_its_edges_and_faces_with_it() {
        // Vertices 0 to 9 are cloth, 10 to 19 one obstacle, 20 to 29 another.
        let pairs = [(4, 20..30), (4, 10..20), (2, 10..20)];
        let pairs = pairs.map(|(vertex, obstacle)| LeftOut { vertex, obstacle }).to_vec();
        let let_go = LetGo::new(pairs, 10);
        let face = |v, corners| let_go.leaves_out(&Candidate::vertex_face(v, corners));
        let edges = |one, other| let_go.leaves_out(&Candidate::edge_edge(one, other));
        assert!(face(2, [10, 11, 12]) && !face(2, [20, 21, 22]) && face(4, [20, 21, 22]));
        assert!(face(11, [1, 2, 3]) && !face(21, [1, 2, 3]) && face(21, [3, 4, 5]) && !face(11, [6, 7, 8]));
        assert!(edges([2, 3], [11, 12]) && edges([12, 11], [9, 2]) && !edges([2, 3], [20, 21]));
        assert!(!face(2, [4, 5, 6]) && !edges([2, 3], [4, 5]), "cloth and cloth");
        assert!(!LetGo::default().leaves_out(&Candidate::vertex_face(2, [10, 11, 12])));
    }
}
