//! Sides of seams that are being sewn: features within one ring of vertices that become one do not keep their
//! distance. Continuous detection takes no notice of this: they may come as close as they like, not through each other.

use super::Candidate;
use super::around::Around;
use super::broad::CollisionMesh;

/// Which pairs of features are on both sides of a seam. Holds nothing while nothing is sewn.
#[derive(Clone, Debug, Default)]
pub(super) struct SewnSides {
    /// Start of every vertex's list in `near`; one more than vertices.
    first: Vec<u32>,
    /// Vertices of seams among a vertex and its neighbors, ascending.
    near: Vec<u32>,
    /// The smallest vertex of the set that a vertex is sewn into.
    set_of: Vec<u32>,
}

impl SewnSides {
    /// `pairs`: vertices that become one.
    pub(super) fn new(mesh: &CollisionMesh, around: &Around, pairs: &[[u32; 2]]) -> SewnSides {
        if pairs.is_empty() {
            return SewnSides::default();
        }
        let mut set_of: Vec<u32> = (0..mesh.vertices as u32).collect();
        fn root(set_of: &[u32], mut v: u32) -> u32 {
            while set_of[v as usize] != v {
                v = set_of[v as usize];
            }
            v
        }
        let mut is_sewn = vec![false; mesh.vertices];
        for pair in pairs {
            let [a, b] = pair.map(|v| root(&set_of, v));
            set_of[a.max(b) as usize] = a.min(b);
            pair.iter().for_each(|&v| is_sewn[v as usize] = true);
        }
        for v in 0..mesh.vertices as u32 {
            set_of[v as usize] = root(&set_of, v);
        }
        let (mut first, mut near) = (vec![0], Vec::new());
        for v in 0..mesh.vertices as u32 {
            let start = near.len();
            near.extend([v].into_iter().chain(around.neighbors(mesh, v)).filter(|&v| is_sewn[v as usize]));
            near[start..].sort_unstable();
            let mut kept = start;
            for at in start..near.len() {
                if at == start || near[at] != near[kept - 1] {
                    near[kept] = near[at];
                    kept += 1;
                }
            }
            near.truncate(kept);
            first.push(near.len() as u32);
        }
        SewnSides { first, near, set_of }
    }

    /// Whether the features of a candidate lie at different vertices that become one.
    #[inline(always)]
    pub(super) fn leaves_out(&self, candidate: &Candidate) -> bool {
        !self.set_of.is_empty() && self.holds(candidate)
    }

    fn holds(&self, candidate: &Candidate) -> bool {
        let (one, other) = candidate.vertices.split_at(if candidate.is_vertex_face() { 1 } else { 2 });
        let near = |v: u32| &self.near[self.first[v as usize] as usize..self.first[v as usize + 1] as usize];
        one.iter().flat_map(|&v| near(v)).any(|&a| {
            let meets = |&b: &u32| a != b && self.set_of[a as usize] == self.set_of[b as usize];
            other.iter().any(|&w| near(w).iter().any(meets))
        })
    }

    /// Bytes of the lists; every rank holds them.
    pub(super) fn bytes(&self) -> u64 {
        4 * (self.first.len() + self.near.len() + self.set_of.len()) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_ring_on_either_side_lets_its_thickness_go() {
        // Two strips: 0 1 2 / 3 4 5 and 6 7 8 / 9 10 11; 3 and 9 become one.
        let strip = |v: u32| [[v, v + 1, v + 4], [v, v + 4, v + 3], [v + 1, v + 2, v + 5], [v + 1, v + 5, v + 4]];
        let mesh = CollisionMesh::new(12, 12, [strip(0), strip(6)].concat()).unwrap();
        let around = Around::new(&mesh);
        let sides = SewnSides::new(&mesh, &around, &[[3, 9]]);
        let face = |v, corners| sides.leaves_out(&Candidate::vertex_face(v, corners));
        assert!(face(3, [6, 10, 9]) && face(0, [6, 10, 9]) && face(4, [6, 7, 10]));
        assert!(!face(5, [6, 10, 9]) && !face(2, [6, 7, 10]) && !face(0, [7, 8, 11]));
        assert!(sides.leaves_out(&Candidate::edge_edge([3, 4], [9, 10])));
        assert!(!face(0, [3, 4, 0]), "both on one side");
        assert!(!SewnSides::default().leaves_out(&Candidate::vertex_face(3, [6, 10, 9])));
    }
}
