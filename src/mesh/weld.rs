//! Vertices at one place: finds them where an exporter has split a seam, and joins them within a distance that the user
//! gives.

use std::collections::HashMap;

use crate::math::{DVec3, Vec3};

/// Smallest cell size of the search grid as a fraction of the extent, so that cell numbers are exact.
const CELL_OF_EXTENT: f64 = 1e-6;

/// For every vertex, the kept vertex that it is joined to: the first one within `distance`, or itself. A joined vertex
/// is at most `distance` from the kept one; joins do not chain.
pub(super) fn joined(positions: &[Vec3], distance: f64) -> Vec<u32> {
    let (low, high) = positions.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, h), &p| (l.min(p), h.max(p)));
    let extent = (high.as_dvec3() - low.as_dvec3()).max_element();
    let cell = distance.max(extent * CELL_OF_EXTENT).max(f64::MIN_POSITIVE);
    let cell_of = |p: DVec3| ((p - low.as_dvec3()) / cell).floor().to_array().map(|x| x as i64);
    let mut kept: HashMap<[i64; 3], Vec<u32>> = HashMap::new();
    let mut first = Vec::with_capacity(positions.len());
    for (vertex, p) in (0u32..).zip(positions.iter().map(|p| p.as_dvec3())) {
        let [x, y, z] = cell_of(p);
        let around = (-1..=1).flat_map(|i| (-1..=1).flat_map(move |j| (-1..=1).map(move |k| [x + i, y + j, z + k])));
        let near = around.filter_map(|cell| kept.get(&cell)).flatten().copied();
        let near = near.filter(|&other| positions[other as usize].as_dvec3().distance(p) <= distance).min();
        if near.is_none() {
            kept.entry([x, y, z]).or_default().push(vertex);
        }
        first.push(near.unwrap_or(vertex));
    }
    first
}

/// For every vertex, the first vertex at exactly the same place.
pub fn first_at_place(positions: &[Vec3]) -> Vec<u32> {
    let mut first: HashMap<[u32; 3], u32> = HashMap::with_capacity(positions.len());
    // Adding 0 turns -0 into 0.
    (0u32..)
        .zip(positions)
        .map(|(v, p)| *first.entry((*p + Vec3::ZERO).to_array().map(f32::to_bits)).or_insert(v))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_of_near_vertices_is_kept_and_nothing_is_chained() {
        let row: Vec<Vec3> = [0.0, 0.9, 1.8, 5.0, 5.0].map(|x| Vec3::new(x, 0.0, 0.0)).to_vec();
        assert_eq!(joined(&row, 1.0), [0, 0, 2, 3, 3]);
        assert_eq!(joined(&row, 0.0), [0, 1, 2, 3, 3]);
        assert_eq!(first_at_place(&[Vec3::ZERO, Vec3::X, -Vec3::ZERO, Vec3::X]), [0, 1, 0, 1]);
    }

    #[test]
    fn as_brute_force_says_on_a_grid_far_from_the_origin() {
        let points: Vec<Vec3> = (0..500u32)
            .map(|i| {
                Vec3::new(1e4, 0.0, -1e4)
                    + Vec3::new((i * 7 % 31) as f32, (i * 13 % 29) as f32, (i * 3 % 17) as f32) * 0.25
            })
            .collect();
        let mut kept: Vec<u32> = Vec::new();
        let expected: Vec<u32> = (0..500u32)
            .map(|v| {
                let near = |&k: &u32| points[k as usize].as_dvec3().distance(points[v as usize].as_dvec3()) <= 0.6;
                let first = kept.iter().copied().find(near).unwrap_or(v);
                if first == v {
                    kept.push(v);
                }
                first
            })
            .collect();
        assert!(kept.len() < 450);
        assert_eq!(joined(&points, 0.6), expected);
    }
}
