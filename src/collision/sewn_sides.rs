//! Sides of seams that are being sewn: what lies on both sides keeps no more distance than the sewn cloth would, so
//! that the sides can meet and do not lie on each other. Continuous detection takes no notice of this: they may come
//! as close as they like, not through each other.
//!
//! The gap of a pair is at most [`SLOPE`] of the way along the cloth from one of its points to the other through the
//! seam: from the point to its side, and from the same place of the other side to the other point. It is zero where the
//! sides meet, and reaches the thickness a few thicknesses away, on any mesh. The way is looked for through the edges
//! and vertices of seams that a pair's vertices are near; pairs without any have the whole thickness.

use super::around::Around;
use super::broad::CollisionMesh;
use super::contact::Pair;
use crate::forces::NO_VERTEX;
use crate::math::Vec3;

/// Gap over the way along the cloth, as in a piece of cloth by itself.
const SLOPE: f32 = 0.5;

/// A border edge, or a vertex twice, with what it is sewn into.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    /// The sewn vertices of its ends, ascending.
    sewn: [u32; 2],
    /// Its ends in that order.
    ends: [u32; 2],
}

/// Which pairs of features are on both sides of a seam. Holds nothing while nothing is sewn.
#[derive(Clone, Debug, Default)]
pub(super) struct SewnSides {
    /// Start of every vertex's list in `near`; one more than vertices.
    first: Vec<u32>,
    /// Sides that a vertex is near, ascending.
    near: Vec<Side>,
}

impl SewnSides {
    /// `pairs`: vertices that become one; `near_vertices`: a vertex and one of these that it is near, ascending.
    pub(super) fn new(
        mesh: &CollisionMesh,
        around: &Around,
        pairs: &[[u32; 2]],
        near_vertices: &[[u32; 2]],
    ) -> SewnSides {
        if pairs.is_empty() {
            return SewnSides::default();
        }
        let sewn = sets(mesh.vertices, pairs);
        let mut is_sewn = vec![false; mesh.vertices];
        pairs.iter().flatten().for_each(|&v| is_sewn[v as usize] = true);
        let (is_sewn, sewn) = (&is_sewn, &sewn);
        let side = move |a: u32, b: u32| match sewn[a as usize] <= sewn[b as usize] {
            true => Side { sewn: [a, b].map(|v| sewn[v as usize]), ends: [a, b] },
            false => Side { sewn: [b, a].map(|v| sewn[v as usize]), ends: [b, a] },
        };
        let sides_at = move |v: u32| {
            let is_side = move |&w: &u32| is_sewn[w as usize] && around.opposite(mesh, [v, w]).count() == 1;
            around.neighbors(mesh, v).filter(is_side).map(move |w| side(v, w)).chain([side(v, v)])
        };
        let (mut first, mut near) = (vec![0], Vec::new());
        let mut of_vertices = near_vertices.chunk_by(|a, b| a[0] == b[0]).peekable();
        for v in 0..mesh.vertices as u32 {
            let start = near.len();
            if let Some(of_vertex) = of_vertices.next_if(|of_vertex| of_vertex[0][0] == v) {
                of_vertex.iter().for_each(|&[_, sewn]| near.extend(sides_at(sewn)));
            }
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
        SewnSides { first, near }
    }

    /// A pair at positions `x` (xyz) with the most that its thickness may be.
    #[inline(always)]
    pub(super) fn limited(&self, pair: Pair, x: &[f32]) -> Pair {
        if self.first.is_empty() { pair } else { Pair { most_m: SLOPE * self.way_m(&pair, x), ..pair } }
    }

    /// The shortest way from one point of a pair to the other through a seam; infinite without one.
    fn way_m(&self, pair: &Pair, x: &[f32]) -> f32 {
        let at = |v: u32| Vec3::from_slice(&x[3 * v as usize..]);
        let (one, other) = pair.vertices.split_at(if pair.kind == 0 { 1 } else { 2 });
        let point = |vertices: &[u32], weights: &[f32]| {
            let present = vertices.iter().zip(weights).filter(|(v, _)| **v != NO_VERTEX);
            present.fold(Vec3::ZERO, |sum, (&v, &weight)| sum + weight.abs() * at(v))
        };
        let (weights, other_weights) = pair.weights.split_at(one.len());
        let [p, q] = [point(one, weights), point(other, other_weights)];
        let near = |&v: &u32| &self.near[self.first[v as usize] as usize..self.first[v as usize + 1] as usize];
        // Where the foot of a point is on an edge, as a share of it.
        let foot = |p: Vec3, [a, b]: [Vec3; 2]| {
            let edge = b - a;
            let squared = edge.length_squared();
            if squared > 0.0 { ((p - a).dot(edge) / squared).clamp(0.0, 1.0) } else { 0.0 }
        };
        let mut least_m = f32::INFINITY;
        for side in one.iter().flat_map(near) {
            for across in other.iter().filter(|v| **v != NO_VERTEX).flat_map(near) {
                if side.sewn != across.sewn || side.ends == across.ends {
                    continue;
                }
                let [own, others] = [side.ends.map(at), across.ends.map(at)];
                for share in [foot(p, own), foot(q, others)] {
                    let way_m = p.distance(own[0].lerp(own[1], share)) + q.distance(others[0].lerp(others[1], share));
                    least_m = least_m.min(way_m);
                }
            }
        }
        least_m
    }

    /// Bytes of the lists; every rank holds them.
    pub(super) fn bytes(&self) -> u64 {
        4 * self.first.len() as u64 + size_of_val(&self.near[..]) as u64
    }
}

/// The smallest vertex of the set that every vertex is sewn into.
fn sets(vertices: usize, pairs: &[[u32; 2]]) -> Vec<u32> {
    let mut set_of: Vec<u32> = (0..vertices as u32).collect();
    fn root(set_of: &[u32], mut v: u32) -> u32 {
        while set_of[v as usize] != v {
            v = set_of[v as usize];
        }
        v
    }
    for pair in pairs {
        let [a, b] = pair.map(|v| root(&set_of, v));
        set_of[a.max(b) as usize] = a.min(b);
    }
    for v in 0..vertices {
        set_of[v] = root(&set_of, v as u32);
    }
    set_of
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gap_of_both_sides_grows_with_the_way_through_the_seam() {
        // Two strips: 0 1 2 above 3 4 5, and 9 10 11 above 6 7 8; 3 and 9, 4 and 10 become one.
        let strip = |v: u32| [[v, v + 1, v + 4], [v, v + 4, v + 3], [v + 1, v + 2, v + 5], [v + 1, v + 5, v + 4]];
        let mesh = CollisionMesh::new(12, 12, [strip(0), strip(6)].concat()).unwrap();
        let around = Around::new(&mesh);
        let pairs = [[3, 9], [4, 10]];
        let ring =
            |v: u32| [v].into_iter().chain(around.neighbors(&mesh, v)).collect::<std::collections::BTreeSet<_>>();
        let of = |v: u32| ring(v).into_iter().filter(|v| pairs.as_flattened().contains(v)).map(move |w| [v, w]);
        let near: Vec<[u32; 2]> = (0..12).flat_map(of).collect();
        let sides = SewnSides::new(&mesh, &around, &pairs, &near);
        let row = |y: f32| (0..3).flat_map(move |x| [x as f32, y, 0.0]);
        let x: Vec<f32> = row(1.0).chain(row(0.0)).chain(row(-1.2)).chain(row(-0.2)).collect();
        let none = NO_VERTEX;
        let most_m = |sides: &SewnSides, vertices: [u32; 4], kind: u32, weights: [f32; 4]| {
            let (normal, distance_m, gap_m) = (Vec3::Y, 0.1, 0.1);
            let pair = Pair { vertices, kind, weights, normal, distance_m, gap_m, share: 1.0, most_m: f32::INFINITY };
            sides.limited(pair, &x).most_m
        };
        let near = |one: f32, other: f32| (one - other).abs() < 1e-6;
        assert_eq!(most_m(&sides, [3, 9, none, none], 0, [1.0, -1.0, 0.0, 0.0]), 0.0);
        // Along the seam, and across it.
        assert!(near(most_m(&sides, [4, 9, 10, none], 0, [1.0, -0.5, -0.5, 0.0]), 0.25));
        assert!(near(most_m(&sides, [0, 6, 9, none], 0, [1.0, -0.5, -0.5, 0.0]), 0.75));
        assert_eq!(most_m(&sides, [3, 4, 9, 10], 1, [0.5, 0.5, -0.5, -0.5]), 0.0);
        assert!(near(most_m(&sides, [3, 0, 9, 6], 1, [0.5, 0.5, -0.8, -0.2]), 0.35));
        // Beyond one ring, on one side, and without seams.
        assert_eq!(most_m(&sides, [2, 6, 9, none], 0, [1.0, -0.5, -0.5, 0.0]), f32::INFINITY);
        assert_eq!(most_m(&sides, [0, 3, 4, none], 0, [1.0, -0.5, -0.5, 0.0]), f32::INFINITY);
        assert_eq!(most_m(&SewnSides::default(), [3, 9, none, none], 0, [1.0, -1.0, 0.0, 0.0]), f32::INFINITY);
    }
}
