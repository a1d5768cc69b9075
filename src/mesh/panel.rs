//! Meshes of flat panels: a polygon, whose border stays as it is, filled with nearly equilateral triangles.

use spade::{ConstrainedDelaunayTriangulation, Point2, Triangulation};

use crate::math::DVec2;

/// Least distance of an inner vertex from the border at first, in edge lengths.
const FROM_BORDER: f64 = 0.6;
/// Twice the area of a triangle over the square of its longest side up to which it is no triangle.
const FLAT: f64 = 1e-7;
/// Rounds that move inner vertices to the middle of their neighbors.
const ROUNDS: usize = 6;

/// A panel in its own plane.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PanelMesh {
    /// The border, then inner vertices.
    pub points: Vec<DVec2>,
    /// Counter-clockwise.
    pub triangles: Vec<[u32; 3]>,
}

/// Fills the polygon `border`, counter-clockwise and without crossings, with triangles of edges about `edge_m` long.
/// No vertex is added on the border. None if the border crosses itself or encloses nothing.
pub fn panel_mesh(border: &[DVec2], edge_m: f64) -> Option<PanelMesh> {
    let mut points = border.to_vec();
    points.extend(inner_points(border, edge_m));
    let mut triangles = fill(&points, border)?;
    for _ in 0..ROUNDS {
        relax(&mut points, border.len(), &triangles);
        triangles = fill(&points, border)?;
    }
    let mut used = vec![false; points.len()];
    triangles.iter().flatten().for_each(|&v| used[v as usize] = true);
    (!triangles.is_empty() && used.iter().all(|&used| used)).then_some(PanelMesh { points, triangles })
}

/// A lattice of equilateral triangles, as far as it keeps its distance from the border.
fn inner_points(border: &[DVec2], edge_m: f64) -> Vec<DVec2> {
    let (low, high) =
        border.iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), &p| (low.min(p), high.max(p)));
    let row_m = edge_m * 0.75f64.sqrt();
    let (rows, columns) = (((high.y - low.y) / row_m) as i64, ((high.x - low.x) / edge_m) as i64 + 1);
    let mut points = Vec::new();
    for row in 0..=rows {
        for column in 0..=columns {
            let shift = if row % 2 == 0 { 0.25 } else { 0.75 };
            let p = low + DVec2::new(edge_m * (column as f64 + shift), row_m * (row as f64 + 0.5));
            if is_inside(border, p) && distance(border, p) >= FROM_BORDER * edge_m {
                points.push(p);
            }
        }
    }
    points
}

fn sides(border: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> {
    border.iter().copied().zip(border.iter().copied().cycle().skip(1))
}

/// Whether a ray to the right crosses the border an odd number of times.
fn is_inside(border: &[DVec2], p: DVec2) -> bool {
    let crossed =
        |(a, b): (DVec2, DVec2)| (a.y > p.y) != (b.y > p.y) && p.x < a.x + (b.x - a.x) * ((p.y - a.y) / (b.y - a.y));
    sides(border).filter(|&side| crossed(side)).count() % 2 == 1
}

fn distance(border: &[DVec2], p: DVec2) -> f64 {
    let to_side = |(a, b): (DVec2, DVec2)| {
        let along = b - a;
        let share = ((p - a).dot(along) / along.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        p.distance(a + along * share)
    };
    sides(border).map(to_side).fold(f64::INFINITY, f64::min)
}

/// The Delaunay triangles within the border, of which every side is an edge.
fn fill(points: &[DVec2], border: &[DVec2]) -> Option<Vec<[u32; 3]>> {
    let vertices = points.iter().map(|p| Point2::new(p.x, p.y)).collect();
    let edges = (0..border.len()).map(|i| [i, (i + 1) % border.len()]).collect();
    let mut crosses = false;
    let triangulation =
        ConstrainedDelaunayTriangulation::<Point2<f64>>::try_bulk_load_cdt(vertices, edges, |_| crosses = true).ok()?;
    if crosses || triangulation.num_vertices() != points.len() {
        return None;
    }
    let mut triangles = Vec::new();
    for face in triangulation.inner_faces() {
        let corners = face.vertices().map(|v| v.fix().index() as u32);
        let [a, b, c] = corners.map(|v| points[v as usize]);
        // What lies between the border and a straight line along it is rounding.
        let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
        let has_area = (b - a).perp_dot(c - a) > FLAT * longest;
        if has_area && is_inside(border, (a + b + c) / 3.0) {
            // The same triangle begins with its smallest corner, wherever the triangulation began.
            let first = (0..3).min_by_key(|&i| corners[i]).unwrap_or_default();
            triangles.push([0, 1, 2].map(|i| corners[(first + i) % 3]));
        }
    }
    triangles.sort_unstable();
    Some(triangles)
}

/// Moves every inner vertex to the middle of its neighbors.
fn relax(points: &mut [DVec2], border: usize, triangles: &[[u32; 3]]) {
    let mut sums = vec![(DVec2::ZERO, 0u32); points.len()];
    for corners in triangles {
        for i in 0..3 {
            let (v, next, after) = (corners[i] as usize, corners[(i + 1) % 3] as usize, corners[(i + 2) % 3] as usize);
            let (sum, count) = &mut sums[v];
            *sum += points[next] + points[after];
            *count += 2;
        }
    }
    for (p, (sum, count)) in points.iter_mut().zip(sums).skip(border).filter(|(_, (_, count))| *count > 0) {
        *p = sum / f64::from(count);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panel_with_a_notch_is_filled_evenly() {
        // An L of 0.4 x 0.3 m without a corner of 0.2 x 0.15, cut into sides of about 1 cm.
        let corners = [[0.0, 0.0], [0.4, 0.0], [0.4, 0.15], [0.2, 0.15], [0.2, 0.3], [0.0, 0.3]].map(DVec2::from);
        let mut border = Vec::new();
        for (a, b) in sides(&corners) {
            let count = (a.distance(b) / 0.01).round() as usize;
            border.extend((0..count).map(|i| a.lerp(b, i as f64 / count as f64)));
        }
        let mesh = panel_mesh(&border, 0.01).unwrap();
        assert_eq!(mesh.points[..border.len()], border);
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| mesh.points[v as usize]);
            (b - a).perp_dot(c - a) / 2.0
        };
        let areas: Vec<f64> = mesh.triangles.iter().map(area).collect();
        assert!((areas.iter().sum::<f64>() - 0.09).abs() < 1e-9);
        assert!(areas.iter().all(|&area| area > 0.2 * 0.433e-4), "{:?}", areas.iter().copied().fold(1.0, f64::min));
        let expected = 0.09 / 0.433e-4;
        assert!((mesh.triangles.len() as f64 / expected - 1.0).abs() < 0.15, "{} {expected}", mesh.triangles.len());
    }

    #[test]
    fn a_border_that_crosses_itself_has_no_mesh() {
        let border = [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]].map(DVec2::from);
        assert_eq!(panel_mesh(&border, 0.2), None);
    }
}
