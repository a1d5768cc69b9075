//! Irregular, nearly equilateral triangulations of a rectangle and of a disc.
//!
//! Only +, -, *, / and square roots in f64 are used, and the predicates of the triangulation are exact. Therefore every
//! machine gives the same bits.

use std::f64::consts::{PI, TAU};

use delaunator::{Point, triangulate};

use crate::math::DVec2;

/// Rounds of smoothing. After them the smallest angle hardly changes any more.
const ROUNDS: u32 = 24;
/// A cell that is longer than this times its width is triangulated as if it were square, because the Delaunay
/// triangulation of far stretched points is numerically useless.
const STRETCH: f64 = 4.0;

/// Vertices and triangles: first the vertices of the boundary, then the inner ones. Triangles are counter-clockwise.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Irregular {
    pub points: Vec<DVec2>,
    pub triangles: Vec<[u32; 3]>,
}

/// Triangulates a rectangle with exactly `triangles` (at least 2) triangles. Vertices 0 to 3 are the corners (0, 0),
/// (w, 0), (0, h), (w, h). The boundary is divided evenly.
pub(super) fn irregular_rectangle(size_m: [f64; 2], triangles: usize) -> Irregular {
    let [columns, rows, extra] = boundary(size_m, triangles.max(2));
    let edge = [size_m[0] / columns as f64, size_m[1] / rows as f64];
    // Lengths are counted in edges, so that very large and very small sheets need no special case.
    let mean = edge[0].sqrt() * edge[1].sqrt();
    let unit = if edge[0] > STRETCH * edge[1] || edge[1] > STRETCH * edge[0] { edge } else { [mean, mean] };
    let extent = DVec2::new(size_m[0] / unit[0], size_m[1] / unit[1]);
    let rim = boundary_points(extent, columns, rows, extra);
    let inner = inner_vertices(triangles.max(2), rim.len());
    let mut mesh = filled(rim, scattered(extent, inner));
    mesh.points.iter_mut().for_each(|p| *p = DVec2::new(p.x / extent.x * size_m[0], p.y / extent.y * size_m[1]));
    mesh
}

/// Triangulates a disc around the origin with exactly `triangles` (at least 4) triangles. The boundary is a regular
/// polygon with its vertices on the circle, counter-clockwise from the x axis.
pub(super) fn irregular_disc(radius_m: f64, triangles: usize) -> Irregular {
    let triangles = triangles.max(4);
    // As for the rectangle, lengths are counted in edges of equilateral triangles.
    let radius = (triangles as f64 * 3f64.sqrt() / 4.0 / PI).sqrt();
    let rim = (TAU * radius).round().clamp(3.0, triangles as f64) as usize;
    // Euler asks for an even number of vertices on the boundary exactly if the number of triangles is even.
    let rim = rim + (rim + triangles) % 2;
    let corners = (0..rim).map(|i| radius * direction(i as f64 / rim as f64));
    let inner = inner_vertices(triangles, rim);
    let mut mesh = filled(corners.collect(), sunflower(radius - 0.5, inner));
    mesh.points.iter_mut().for_each(|p| *p = *p / radius * radius_m);
    mesh
}

/// Euler: a triangulated polygon with b vertices on its boundary and i inside has 2 i + b - 2 triangles.
fn inner_vertices(triangles: usize, rim: usize) -> usize {
    (triangles + 2 - rim) / 2
}

/// Triangulates a convex polygon with the vertices `rim` and `inner` vertices, which are moved to the centroids of their
/// neighborhoods, with a Delaunay triangulation in every round [Chen 2004].
fn filled(rim: Vec<DVec2>, inner: Vec<DVec2>) -> Irregular {
    let fixed = rim.len();
    let mut points = rim;
    points.extend(inner);
    let mut triangles = delaunay(&points);
    for _ in 0..if points.len() > fixed { ROUNDS } else { 0 } {
        smooth(&mut points, &triangles, fixed);
        triangles = delaunay(&points);
    }
    debug_assert_eq!(triangles.len(), 2 * points.len() - fixed - 2);
    Irregular { points, triangles }
}

/// The direction after a part of a full turn from the x axis. Sine and cosine of the standard library may differ from
/// machine to machine, this series does not.
fn direction(part: f64) -> DVec2 {
    // A sixteenth of the angle is at most 0.4; the first term left out is below 1e-17.
    let angle = part * TAU / 16.0;
    let mut point = DVec2::ZERO;
    let mut term = 1.0;
    for order in 0..14u32 {
        let sign = if order % 4 < 2 { 1.0 } else { -1.0 };
        if order % 2 == 0 {
            point.x += sign * term
        } else {
            point.y += sign * term
        }
        term *= angle / f64::from(order + 1);
    }
    (0..4).for_each(|_| point = point.rotate(point));
    point / point.length()
}

/// `count` points on the spiral of a sunflower, evenly spread over a disc.
fn sunflower(radius: f64, count: usize) -> Vec<DVec2> {
    let golden = direction((3.0 - 5f64.sqrt()) / 2.0);
    let mut at = DVec2::X;
    let mut points = Vec::with_capacity(count);
    for i in 0..count {
        points.push(at * radius * ((i as f64 + 0.5) / count as f64).sqrt());
        at = at.rotate(golden);
        at /= at.length();
    }
    points
}

/// Edges along bottom and top, edges along left and right, and additional edges (0 or 1) on the longer side.
fn boundary(size_m: [f64; 2], triangles: usize) -> [usize; 3] {
    // An equilateral triangle with edges of length 1 has an area of sqrt(3) / 4.
    let unit_area = triangles as f64 * 3f64.sqrt() / 4.0;
    let ratio = size_m[0] / size_m[1];
    let most = triangles as f64;
    let mut columns = (unit_area * ratio).sqrt().round().clamp(1.0, most) as usize;
    let mut rows = (unit_area / ratio).sqrt().round().clamp(1.0, most) as usize;
    // The number of vertices on the boundary is even exactly if the number of triangles is.
    let extra = triangles % 2;
    let surplus = (2 * (columns + rows) + extra).saturating_sub(triangles + 2) / 2;
    // A narrow strip has no inner vertices. Then the longer side has the edges that are left.
    if columns > rows {
        columns -= surplus.min(columns - 1);
    } else {
        rows -= surplus.min(rows - 1);
    }
    [columns, rows, extra]
}

fn boundary_points(extent: DVec2, columns: usize, rows: usize, extra: usize) -> Vec<DVec2> {
    let DVec2 { x: w, y: h } = extent;
    let mut points = [[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]].map(DVec2::from).to_vec();
    let wide = columns > rows;
    let (top, right) = if wide { (columns + extra, rows) } else { (columns, rows + extra) };
    let inside = |n: usize, length: f64| (1..n).map(move |i| length * i as f64 / n as f64);
    points.extend(inside(columns, w).map(|x| DVec2::new(x, 0.0)));
    points.extend(inside(top, w).map(|x| DVec2::new(x, h)));
    points.extend(inside(rows, h).map(|y| DVec2::new(0.0, y)));
    points.extend(inside(right, h).map(|y| DVec2::new(w, y)));
    points
}

/// `count` jittered points, evenly spread over the rectangle without a margin along its boundary.
fn scattered(extent: DVec2, count: usize) -> Vec<DVec2> {
    if count == 0 {
        return Vec::new();
    }
    let margin = (0.3 * extent).min(DVec2::splat(0.6));
    let inside = extent - 2.0 * margin;
    let rows = ((count as f64 * inside.y / inside.x).sqrt().round() as usize).clamp(1, count);
    let mut random = Random(0);
    let mut points = Vec::with_capacity(count);
    for row in 0..rows {
        let in_row = (row + 1) * count / rows - row * count / rows;
        for i in 0..in_row {
            let place = DVec2::new(i as f64 + random.next(), row as f64 + random.next());
            points.push(margin + inside * place / DVec2::new(in_row as f64, rows as f64));
        }
    }
    points
}

/// The generator splitmix64 [Steele et al. 2014], as numbers from 0 to 1.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn delaunay(points: &[DVec2]) -> Vec<[u32; 3]> {
    let points: Vec<Point> = points.iter().map(|p| Point { x: p.x, y: p.y }).collect();
    // The triangles of the crate are clockwise where y points up.
    triangulate(&points).triangles.chunks_exact(3).map(|t| [t[0] as u32, t[2] as u32, t[1] as u32]).collect()
}

/// Moves every vertex from `fixed` on to the mean of the centroids of its triangles, weighted by their areas.
fn smooth(points: &mut [DVec2], triangles: &[[u32; 3]], fixed: usize) {
    let mut sums = vec![(DVec2::ZERO, 0.0); points.len()];
    for corners in triangles {
        let [a, b, c] = corners.map(|v| points[v as usize]);
        let area = (b - a).perp_dot(c - a);
        for &v in corners {
            let (moment, weight) = &mut sums[v as usize];
            *moment += area * (a + b + c) / 3.0;
            *weight += area;
        }
    }
    for (point, (moment, weight)) in points.iter_mut().zip(sums).skip(fixed) {
        *point = moment / weight;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Smallest angle, degrees, and smallest area over the mean.
    fn quality(mesh: &Irregular) -> (f64, f64) {
        let (mut angle, mut least, mut sum) = (180f64, f64::INFINITY, 0.0);
        for corners in &mesh.triangles {
            let p = corners.map(|v| mesh.points[v as usize]);
            let area = (p[1] - p[0]).perp_dot(p[2] - p[0]) / 2.0;
            (least, sum) = (least.min(area), sum + area);
            for i in 0..3 {
                angle = angle.min((p[(i + 1) % 3] - p[i]).angle_to(p[(i + 2) % 3] - p[i]).to_degrees());
            }
        }
        (angle, least * mesh.triangles.len() as f64 / sum)
    }

    #[test]
    fn triangles_are_nearly_equilateral_and_as_many_as_asked_for() {
        for size_m in [[3.0, 2.0], [1.0, 1.0], [0.3, 1.0], [1.0, 0.1], [40.0, 40.0]] {
            for triangles in [47, 48, 156, 157, 469, 1875, 8000] {
                let mesh = irregular_rectangle(size_m, triangles);
                assert_eq!(mesh.triangles.len(), triangles);
                let (angle, area) = quality(&mesh);
                assert!(angle > 20.0 && area > 0.3, "{size_m:?} {triangles}: {angle} degrees, area {area}");
            }
        }
    }

    #[test]
    fn any_number_of_triangles_in_any_rectangle() {
        for size_m in [[1.0, 1.0], [1e9, 1.0], [1e-30, 1e30], [1e150, 1e150], [1e-20, 1e-20], [0.1, 3.0]] {
            for triangles in (2..40).chain([1000]) {
                let mesh = irregular_rectangle(size_m, triangles);
                assert_eq!(mesh.triangles.len(), triangles, "{size_m:?}");
                let corners = [[0.0, 0.0], [size_m[0], 0.0], [0.0, size_m[1]], size_m].map(DVec2::from);
                assert_eq!(mesh.points[..4], corners);
                assert!(quality(&mesh).1 > 0.0, "{size_m:?} {triangles}");
            }
        }
    }

    #[test]
    fn discs_are_round_and_their_triangles_nearly_equilateral() {
        for triangles in (4..40).chain([156, 157, 1875, 8000]) {
            let mesh = irregular_disc(0.15, triangles);
            assert_eq!(mesh.triangles.len(), triangles);
            let rim = 2 * mesh.points.len() - triangles - 2;
            for (i, point) in mesh.points.iter().enumerate() {
                let off = point.length() / 0.15 - 1.0;
                assert!(if i < rim { off.abs() < 1e-14 } else { off < -1e-3 }, "{triangles}, vertex {i}: {off}");
            }
            let (angle, area) = quality(&mesh);
            assert!(area > 0.25 && (triangles < 40 || angle > 20.0), "{triangles}: {angle} degrees, area {area}");
        }
        let quarters = [0.0, 0.25, 0.5, 0.75].map(direction);
        for (found, exact) in quarters.iter().zip([DVec2::X, DVec2::Y, DVec2::NEG_X, DVec2::NEG_Y]) {
            assert!(found.distance(exact) < 1e-15);
        }
    }
}
