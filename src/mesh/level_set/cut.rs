//! Cuts a triangulated surface where a function is negative.

use std::collections::HashMap;

use super::field::{Field, LevelSet};
use super::topology::{compact, largest_piece};
use crate::math::DVec3;

/// Vertices nearer to the cut than this share of an edge are moved onto it, so that no slivers arise.
const NEAR: f64 = 0.3;
/// Halvings that find where an edge crosses the cut.
const HALVINGS: usize = 30;

/// The largest connected part of the surface on which `keep` is not negative. `edge` = about the length of its edges.
pub(super) fn cut(
    mut points: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    surface: &LevelSet,
    keep: &Field,
    edge: f64,
) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let mut values: Vec<f64> = points.iter().map(|&p| keep(p)).collect();
    for (point, value) in points.iter_mut().zip(&mut values) {
        if value.abs() < NEAR * edge {
            *point = surface.onto_rim(*point, 2.0 * NEAR * edge, 1);
            *value = 0.0;
        }
    }
    let mut between: HashMap<[u32; 2], u32> = HashMap::new();
    let mut kept = Vec::new();
    for corners in triangles {
        let [below, above] =
            [-1.0, 1.0].map(|sign| corners.iter().filter(|&&v| sign * values[v as usize] > 0.0).count());
        if above == 0 {
            continue;
        }
        if below == 0 {
            kept.push(corners);
            continue;
        }
        // The corners from the first that is kept on, with the points where edges cross the cut.
        let mut polygon = Vec::new();
        for i in 0..3 {
            let (a, b) = (corners[i], corners[(i + 1) % 3]);
            let (va, vb) = (values[a as usize], values[b as usize]);
            if va >= 0.0 {
                polygon.push(a);
            }
            if va * vb < 0.0 {
                let key = [a.min(b), a.max(b)];
                polygon.push(*between.entry(key).or_insert_with(|| {
                    let [mut keeps, mut drops] = if va > 0.0 { [a, b] } else { [b, a] }.map(|v| points[v as usize]);
                    for _ in 0..HALVINGS {
                        let middle = (keeps + drops) / 2.0;
                        if keep(middle) >= 0.0 { keeps = middle } else { drops = middle }
                    }
                    points.push(surface.onto(keeps, edge, 2));
                    points.len() as u32 - 1
                }));
            }
        }
        match polygon[..] {
            [a, b, c] => kept.push([a, b, c]),
            [a, b, c, d] => {
                let length = |s: u32, t: u32| points[s as usize].distance_squared(points[t as usize]);
                kept.extend(if length(a, c) <= length(b, d) { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] });
            }
            _ => {}
        }
    }
    compact(points, largest_piece(kept))
}
