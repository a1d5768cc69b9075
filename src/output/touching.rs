//! Which obstacles triangles of the cloth touch in a frame.

use std::collections::HashMap;

use crate::collision::elementary::{CandidateKind, closest_points};
use crate::math::Vec3;
use crate::scene::Obstacles;

/// Cells that a triangle of an obstacle may cover before it is compared with all triangles instead.
const CELLS_MOST: i64 = 64;

/// The nearest obstacle of every one of `triangles` that is closer than `reach_m` at `time_s`.
pub(super) fn touched_obstacles(
    obstacles: &Obstacles,
    time_s: f64,
    triangles: &[[Vec3; 3]],
    reach_m: f32,
) -> Vec<Option<usize>> {
    let mut nearest: Vec<Option<(f32, usize)>> = vec![None; triangles.len()];
    if triangles.is_empty() || obstacles.is_empty() {
        return vec![None; triangles.len()];
    }
    let mut values = Vec::new();
    obstacles.positions_at(time_s, &mut values);
    let at = |v: u32| Vec3::from_slice(&values[v as usize * 3..][..3]);
    let boxes: Vec<[Vec3; 2]> = triangles.iter().map(|corners| around(corners, reach_m)).collect();
    let largest = boxes.iter().map(|[lo, hi]| (*hi - *lo).max_element()).fold(0.0, f32::max);
    let cells = |aabb: [Vec3; 2]| aabb.map(|p| (p / largest.max(1e-6)).to_array().map(|x| x.floor() as i64));
    let mut of_cell: HashMap<[i64; 3], Vec<u32>> = HashMap::new();
    for (triangle, &aabb) in boxes.iter().enumerate() {
        for_cells(cells(aabb), |cell| of_cell.entry(cell).or_default().push(triangle as u32));
    }
    let all: Vec<u32> = (0..triangles.len() as u32).collect();
    for (obstacle, [_, range]) in obstacles.ranges().into_iter().enumerate() {
        for corners in &obstacles.triangles()[range] {
            let corners = corners.map(at);
            let aabb = around(&corners, 0.0);
            let mut compare = |candidates: &[u32]| {
                for &triangle in candidates {
                    let triangle = triangle as usize;
                    if is_apart(aabb, boxes[triangle]) {
                        continue;
                    }
                    let distance_m = distance_m(&triangles[triangle], &corners);
                    if distance_m < nearest[triangle].map_or(reach_m, |(known_m, _)| known_m) {
                        nearest[triangle] = Some((distance_m, obstacle));
                    }
                }
            };
            let [lo, hi] = cells(aabb);
            let covered = (0..3).map(|axis| (hi[axis] - lo[axis] + 1).min(CELLS_MOST + 1)).product::<i64>();
            if covered > CELLS_MOST {
                compare(&all);
            } else {
                for_cells([lo, hi], |cell| of_cell.get(&cell).into_iter().for_each(|list| compare(list)));
            }
        }
    }
    nearest.into_iter().map(|found| found.map(|(_, obstacle)| obstacle)).collect()
}

fn for_cells([lo, hi]: [[i64; 3]; 2], mut visit: impl FnMut([i64; 3])) {
    for x in lo[0]..=hi[0] {
        for y in lo[1]..=hi[1] {
            (lo[2]..=hi[2]).for_each(|z| visit([x, y, z]));
        }
    }
}

fn around(corners: &[Vec3; 3], by_m: f32) -> [Vec3; 2] {
    let [a, b, c] = *corners;
    [a.min(b).min(c) - by_m, a.max(b).max(c) + by_m]
}

fn is_apart([lo, hi]: [Vec3; 2], [other_lo, other_hi]: [Vec3; 2]) -> bool {
    lo.cmpgt(other_hi).any() || other_lo.cmpgt(hi).any()
}

/// Distance of two triangles that do not cross.
fn distance_m(one: &[Vec3; 3], other: &[Vec3; 3]) -> f32 {
    let mut least = f32::INFINITY;
    let mut of = |kind, x| least = closest_points(kind, x).distance_squared.min(least);
    for i in 0..3 {
        of(CandidateKind::VertexFace, [one[i], other[0], other[1], other[2]]);
        of(CandidateKind::VertexFace, [other[i], one[0], one[1], one[2]]);
        for j in 0..3 {
            of(CandidateKind::EdgeEdge, [one[i], one[(i + 1) % 3], other[j], other[(j + 1) % 3]]);
        }
    }
    least.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Overrides, read_str};

    #[test]
    fn the_nearest_obstacle_within_reach_is_found() {
        let scene = r#"
            [[cloth]]
            sheet = { size_m = [0.1, 0.1], triangles = 20 }
            origin_m = [5.0, 0.0, 0.0]
            [[obstacle]]
            name = "floor"
            plane = { point_m = [0.0, 0.0, 0.0], size_m = [4.0, 4.0] }
            [[obstacle]]
            name = "ball"
            sphere = { center_m = [0.0, 1.0, 0.0], radius_m = 0.1 }
        "#;
        let scene = read_str(scene, "s.toml".as_ref()).unwrap().at(&Overrides::default()).unwrap();
        let obstacles = Obstacles::new(&scene.obstacles);
        let mut values = Vec::new();
        obstacles.positions_at(0.0, &mut values);
        let [floor, ball] = &obstacles.ranges()[..] else { panic!("two obstacles") };
        let beside = |triangles: &std::ops::Range<usize>, by_m: f32| {
            let [a, b, c] =
                obstacles.triangles()[triangles.start].map(|v| Vec3::from_slice(&values[v as usize * 3..][..3]));
            let normal = (b - a).cross(c - a).normalize();
            let middle = (a + b + c) / 3.0;
            [0.0, 1.0, 2.0]
                .map(|i: f32| middle + normal * by_m + 0.01 * (b - a).normalize() * i + normal * 0.001 * i * i)
        };
        let triangles = [beside(&floor[1], 0.002), beside(&ball[1], 0.002), beside(&ball[1], 0.02), [Vec3::Z * 9.0; 3]];
        let found = touched_obstacles(&obstacles, 0.0, &triangles, 0.004);
        assert_eq!(found, [Some(0), Some(1), None, None]);
    }
}
