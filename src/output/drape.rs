//! The drape coefficient of round pieces of cloth that hang from a round stand [Cusick 1968]: how much of the cloth that
//! the stand does not hold is still seen from above.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::f64::consts::PI;

use super::FrameMesh;
use crate::math::{DVec2, Vec3};
use crate::mesh::pieces;

/// Cells along the longer side of a piece when its shadow is measured.
const CELLS: usize = 1000;

/// Drape of one piece.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drape {
    /// (shadow - stand) / (flat piece - stand), areas: 1 for a stiff plate, 0 for cloth that hangs straight down.
    pub coefficient: f64,
    /// Number of folds: how often the rim goes out beyond its mean distance from the middle.
    pub folds: usize,
    /// Smallest and largest distance of the rim from the middle, seen from above, meters.
    pub rim_m: [f64; 2],
}

/// Drape of every piece, in the order of their first vertices. `flat` is the start, where the pieces are level, `draped`
/// the same mesh later; `up` = index of the vertical axis.
pub fn drape(flat: &FrameMesh, draped: &FrameMesh, stand_radius_m: f64, up: usize) -> Vec<Drape> {
    let piece_of = pieces(flat.positions.len(), &flat.triangles);
    let mut triangles: BTreeMap<u32, Vec<[u32; 3]>> = BTreeMap::new();
    for corners in &flat.triangles {
        triangles.entry(piece_of[corners[0] as usize]).or_default().push(*corners);
    }
    let seen = |positions: &[Vec3]| -> Vec<DVec2> {
        let level = |p: &Vec3| DVec2::new(f64::from(p[(up + 1) % 3]), f64::from(p[(up + 2) % 3]));
        positions.iter().map(level).collect()
    };
    let (start, end) = (seen(&flat.positions), seen(&draped.positions));
    let stand = PI * stand_radius_m * stand_radius_m;
    triangles
        .values()
        .map(|piece| {
            let whole: f64 = piece.iter().map(|t| area(t.map(|v| start[v as usize])).abs()).sum();
            let rim = rim(piece);
            let middle = rim.iter().map(|&v| start[v as usize]).sum::<DVec2>() / rim.len().max(1) as f64;
            let radii: Vec<f64> = rim.iter().map(|&v| end[v as usize].distance(middle)).collect();
            let ends = radii.iter().fold([f64::INFINITY, 0.0], |[low, high]: [f64; 2], &r| [low.min(r), high.max(r)]);
            Drape { coefficient: (shadow(piece, &end) - stand) / (whole - stand), folds: folds(&radii), rim_m: ends }
        })
        .collect()
}

fn area([a, b, c]: [DVec2; 3]) -> f64 {
    (b - a).perp_dot(c - a) / 2.0
}

/// Area that the triangles cover together, seen from above.
fn shadow(triangles: &[[u32; 3]], points: &[DVec2]) -> f64 {
    let corners = || triangles.iter().flatten().map(|&v| points[v as usize]);
    let low = corners().fold(DVec2::INFINITY, DVec2::min);
    let cell = (corners().fold(DVec2::NEG_INFINITY, DVec2::max) - low).max_element() / CELLS as f64;
    let mut covered = vec![false; CELLS * CELLS];
    for t in triangles {
        let [a, b, c] = t.map(|v| (points[v as usize] - low) / cell);
        let twice = area([a, b, c]);
        if twice == 0.0 {
            continue;
        }
        let first = a.min(b).min(c).floor().max(DVec2::ZERO);
        let last = a.max(b).max(c).ceil().min(DVec2::splat(CELLS as f64));
        for row in first.y as usize..last.y as usize {
            for column in first.x as usize..last.x as usize {
                let p = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
                covered[row * CELLS + column] |=
                    [[a, b, p], [b, c, p], [c, a, p]].into_iter().all(|part| area(part) / twice >= 0.0);
            }
        }
    }
    covered.iter().filter(|&&covered| covered).count() as f64 * cell * cell
}

/// Vertices along the boundary of a piece with one boundary, in order.
fn rim(triangles: &[[u32; 3]]) -> Vec<u32> {
    let sides = || triangles.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
    let all: HashSet<[u32; 2]> = sides().collect();
    let next: HashMap<u32, u32> = sides().filter(|&[a, b]| !all.contains(&[b, a])).map(|[a, b]| (a, b)).collect();
    let Some(&first) = next.keys().min() else { return Vec::new() };
    let mut rim = vec![first];
    while let Some(&after) = next.get(&rim[rim.len() - 1]).filter(|&&v| v != first && rim.len() < next.len()) {
        rim.push(after);
    }
    rim
}

/// Number of times that values along a closed line rise above their mean. Values are first averaged over a twentieth of
/// the line, because wrinkles of the rim are not folds.
fn folds(values: &[f64]) -> usize {
    let n = values.len();
    let half = n / 40;
    let mean = values.iter().sum::<f64>() / n as f64;
    let smooth: Vec<f64> = (0..n)
        .map(|i| (0..=2 * half).map(|j| values[(i + n + j - half) % n]).sum::<f64>() / (2 * half + 1) as f64)
        .collect();
    (0..n).filter(|&i| smooth[i] <= mean && smooth[(i + 1) % n] > mean).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{NestedSheet, Outline};

    /// A disc of radius 1, of which what lies beyond radius 0.6 goes to `place` of the radius and the angle.
    fn disc(place: impl Fn(f32, f32) -> (f32, f32)) -> FrameMesh {
        let sheet = NestedSheet::new(Outline::Disc(1.0), 8_000);
        let move_to = |uv: crate::math::Vec2| {
            let (radius, angle) = (uv.length(), uv.y.atan2(uv.x));
            let (radius, height) = if radius > 0.6 { place(radius, angle) } else { (radius, 0.0) };
            Vec3::new(radius * angle.cos(), height, -radius * angle.sin())
        };
        let positions = sheet.coordinates(3).into_iter().map(move_to).collect();
        FrameMesh { positions, triangles: sheet.triangles(3).to_vec() }
    }

    #[test]
    fn plates_cones_and_folds() {
        let flat = disc(|radius, _| (radius, 0.0));
        let plate = drape(&flat, &flat, 0.6, 1)[0];
        assert!((plate.coefficient - 1.0).abs() < 0.02, "{plate:?}");
        // A skirt at 60 degrees to the level: half as wide.
        let cone = drape(&flat, &disc(|radius, _| (0.6 + (radius - 0.6) * 0.5, (0.6 - radius) * 0.866)), 0.6, 1)[0];
        let expected = (0.8 * 0.8 - 0.36) / 0.64;
        assert!((cone.coefficient - expected).abs() < 0.02, "{cone:?} instead of {expected}");
        assert!((cone.rim_m[0] - 0.8).abs() < 1e-3 && (cone.rim_m[1] - 0.8).abs() < 1e-3, "{cone:?}");
        let star = drape(&flat, &disc(|radius, angle| (radius * (1.0 + 0.1 * (7.0 * angle).cos()), 0.0)), 0.6, 1)[0];
        assert_eq!(star.folds, 7);
    }
}
