//! Which vertices of seams the vertices of cloth are near, along the cloth at rest.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Triangles with the lengths of their sides at rest, meters: from corner 0 to 1, from 1 to 2, from 2 to 0.
pub(super) type Sides = ([u32; 3], [f64; 3]);

/// How far from a vertex of a seam vertices are near it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reach {
    /// Within this many rings.
    pub rings: usize,
    /// Or within this way along edges at rest from a vertex of these rings, meters.
    pub beyond_m: f64,
}

/// Pairs of a vertex and one of `seams` that it is near, ascending.
pub(super) fn near_seams(
    triangles: impl Iterator<Item = Sides>,
    vertices: usize,
    seams: impl Iterator<Item = u32>,
    reach: Reach,
) -> Vec<[u32; 2]> {
    let mut is_sewn = vec![false; vertices];
    seams.for_each(|v| is_sewn[v as usize] = true);
    if !is_sewn.contains(&true) {
        return Vec::new();
    }
    let mut edges: Vec<(u32, u32, f64)> = Vec::new();
    for (corners, sides_m) in triangles {
        for (side, length_m) in sides_m.into_iter().enumerate() {
            let [a, b] = [corners[side], corners[(side + 1) % 3]];
            edges.extend([(a, b, length_m), (b, a, length_m)]);
        }
    }
    edges.sort_unstable_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2)));
    edges.dedup_by_key(|&mut (a, b, _)| (a, b));
    let from = |v: u32| {
        let first = edges.partition_point(|edge| edge.0 < v);
        edges[first..].iter().take_while(move |edge| edge.0 == v)
    };
    let mut near = Vec::new();
    // Of the vertices within reach of the one at hand.
    let mut way_m = vec![f64::INFINITY; vertices];
    for target in (0..vertices as u32).filter(|&v| is_sewn[v as usize]) {
        let mut reached = vec![target];
        way_m[target as usize] = 0.0;
        let mut ring = 0;
        for _ in 0..reach.rings {
            let inner = ring..reached.len();
            ring = inner.end;
            for v in inner.map(|at| reached[at]).collect::<Vec<_>>() {
                for &(_, other, _) in from(v) {
                    if std::mem::replace(&mut way_m[other as usize], 0.0) > 0.0 {
                        reached.push(other);
                    }
                }
            }
        }
        let mut next: BinaryHeap<(Reverse<u64>, u32)> = reached.iter().map(|&v| (Reverse(0), v)).collect();
        while let Some((Reverse(bits), v)) = next.pop() {
            // The bits of positive numbers have the order of the numbers.
            let so_far_m = f64::from_bits(bits);
            if so_far_m > way_m[v as usize] {
                continue;
            }
            for &(_, other, length_m) in from(v) {
                let there_m = so_far_m + length_m;
                if there_m <= reach.beyond_m && there_m < way_m[other as usize] {
                    if way_m[other as usize] == f64::INFINITY {
                        reached.push(other);
                    }
                    way_m[other as usize] = there_m;
                    next.push((Reverse(there_m.to_bits()), other));
                }
            }
        }
        for v in reached {
            way_m[v as usize] = f64::INFINITY;
            near.push([v, target]);
        }
    }
    near.sort_unstable();
    near
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vertex_is_near_within_rings_or_a_reach_more() {
        // A strip of squares: 0 to 4 above 5 to 9, one meter each; 0, 5 and 10, which has no triangle, are of seams.
        let diagonal = 2.0f64.sqrt();
        let square = |v: u32| [([v, v + 1, v + 6], [1.0, 1.0, diagonal]), ([v, v + 6, v + 5], [diagonal, 1.0, 1.0])];
        let of_rings = |rings: usize, beyond_m: f64| {
            near_seams((0..4).flat_map(square), 11, [0, 5, 10].into_iter(), Reach { rings, beyond_m })
        };
        let near = |beyond_m: f64| of_rings(1, beyond_m);
        let of = |pairs: &[[u32; 2]], target: u32| {
            pairs.iter().filter(|pair| pair[1] == target).map(|pair| pair[0]).collect::<Vec<_>>()
        };
        assert_eq!(of(&near(0.0), 0), [0, 1, 5, 6]);
        assert_eq!(of(&near(0.0), 5), [0, 5, 6]);
        assert_eq!(of(&near(0.9), 0), [0, 1, 5, 6]);
        assert_eq!(of(&near(1.1), 0), [0, 1, 2, 5, 6, 7]);
        assert_eq!(of(&near(1.5), 0), [0, 1, 2, 5, 6, 7]);
        assert_eq!(of(&near(2.1), 5), [0, 1, 2, 5, 6, 7, 8]);
        assert_eq!(of(&near(9.0), 10), [10]);
        assert!(near(9.0).is_sorted());
        assert_eq!(of(&of_rings(0, 1.1), 5), [0, 5, 6]);
        assert_eq!(of(&of_rings(2, 0.0), 0), [0, 1, 2, 5, 6, 7]);
        assert_eq!(of(&of_rings(2, 0.0), 5), [0, 1, 5, 6, 7]);
    }
}
