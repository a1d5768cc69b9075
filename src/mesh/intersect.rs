//! Intersection of a segment and a triangle, exact for the given f32 coordinates.

use robust::{Coord, Coord3D, orient2d, orient3d};

use crate::math::Vec3;

/// True if four points lie in one plane. Exact in the sense of [`edge_crosses_triangle`].
pub(super) fn in_one_plane(a: Vec3, b: Vec3, c: Vec3, d: Vec3) -> bool {
    orient(a, b, c, d) == 0.0
}

/// True if the closed segment pq and the closed triangle abc share a point. Exact for finite f32 coordinates whose
/// products neither overflow nor underflow in f64 (sizes from 1e-60 to 1e60).
///
/// Touching counts: coplanar overlap, an end on the face, a corner on the edge and a shared vertex. Callers that test
/// neighbors skip pairs with a common vertex. A segment of length zero is a point; a triangle without area is its three
/// edges.
pub fn edge_crosses_triangle(p: Vec3, q: Vec3, a: Vec3, b: Vec3, c: Vec3) -> bool {
    if clearly_apart(p, q, [a, b, c]) {
        return false;
    }
    let (side_p, side_q) = (orient(a, b, c, p), orient(a, b, c, q));
    if side_p == 0.0 && side_q == 0.0 {
        return match widest_projection(&[a, b, c]) {
            Some(dropped) => coplanar_edge_meets_face(p, q, [a, b, c], dropped),
            None => segments_meet(p, q, a, b) || segments_meet(p, q, b, c) || segments_meet(p, q, c, a),
        };
    }
    if (side_p > 0.0 && side_q > 0.0) || (side_p < 0.0 && side_q < 0.0) {
        return false;
    }
    let turns = [orient(p, q, a, b), orient(p, q, b, c), orient(p, q, c, a)];
    !(turns.iter().any(|&t| t > 0.0) && turns.iter().any(|&t| t < 0.0))
}

/// True if a plane separates the segment and the triangle by more than the rounding of f64. This avoids nearly all
/// exact tests, which are slowest where their result is zero, as everywhere on a flat sheet.
fn clearly_apart(p: Vec3, q: Vec3, face: [Vec3; 3]) -> bool {
    /// Larger than the error of the few hundred roundings below, each of relative size 2^-53.
    const ROUNDING: f64 = 1e-13;
    let origin = face[0].as_dvec3();
    let [p, q] = [p, q].map(|v| v.as_dvec3() - origin);
    let corners = face.map(|v| v.as_dvec3() - origin);
    let extent = [p, q, corners[1], corners[2]].iter().fold(0.0, |most: f64, v| most.max(v.abs().max_element()));
    let all_beyond =
        |margin: f64, sides: &[f64]| sides.iter().all(|&s| s > margin) || sides.iter().all(|&s| s < -margin);

    let normal = corners[1].cross(corners[2]);
    let margin = ROUNDING * extent.powi(3);
    if all_beyond(margin, &[normal.dot(p), normal.dot(q)]) {
        return true;
    }
    let margin = margin * extent;
    for i in 0..3 {
        let outward = (corners[(i + 1) % 3] - corners[i]).cross(normal);
        if outward.dot(p - corners[i]) > margin && outward.dot(q - corners[i]) > margin {
            return true;
        }
    }
    let across = (q - p).cross(normal);
    all_beyond(margin, &corners.map(|corner| across.dot(corner - p)))
}

/// Drops the coordinate `dropped`. This is exact.
fn flat(v: Vec3, dropped: usize) -> Coord<f32> {
    Coord { x: v[(dropped + 1) % 3], y: v[(dropped + 2) % 3] }
}

/// The coordinate to drop so that the first three of the coplanar `points` that are not collinear span the largest
/// area; none if all are collinear.
fn widest_projection(points: &[Vec3]) -> Option<usize> {
    let area = |dropped: usize, third: Vec3| {
        orient2d(flat(points[0], dropped), flat(points[1], dropped), flat(third, dropped)).abs()
    };
    points[2..].iter().find_map(|&third| {
        let widest = (0..3).max_by(|&i, &j| area(i, third).total_cmp(&area(j, third)))?;
        (area(widest, third) > 0.0).then_some(widest)
    })
}

fn coplanar_edge_meets_face(p: Vec3, q: Vec3, [a, b, c]: [Vec3; 3], dropped: usize) -> bool {
    let turn = |a: Vec3, b: Vec3, c: Vec3| orient2d(flat(a, dropped), flat(b, dropped), flat(c, dropped));
    let inside = |v: Vec3| {
        let turns = [turn(a, b, v), turn(b, c, v), turn(c, a, v)];
        turns.iter().all(|&t| t >= 0.0) || turns.iter().all(|&t| t <= 0.0)
    };
    inside(p)
        || inside(q)
        || [(a, b), (b, c), (c, a)].into_iter().any(|(s, t)| coplanar_segments_meet(turn, [p, q], [s, t]))
}

/// True if two coplanar segments share a point. They must not be collinear unless they share an end. `turn` is the
/// orientation in their plane.
fn coplanar_segments_meet(turn: impl Fn(Vec3, Vec3, Vec3) -> f64, [p, q]: [Vec3; 2], [s, t]: [Vec3; 2]) -> bool {
    let same_side = |x: f64, y: f64| (x > 0.0 && y > 0.0) || (x < 0.0 && y < 0.0);
    let (of_s, of_t, of_p, of_q) = (turn(p, q, s), turn(p, q, t), turn(s, t, p), turn(s, t, q));
    if of_s == 0.0 && of_t == 0.0 && of_p == 0.0 && of_q == 0.0 {
        return collinear_segments_meet([p, q], [s, t]);
    }
    !same_side(of_s, of_t) && !same_side(of_p, of_q)
}

/// Collinear segments overlap exactly if their boxes do.
fn collinear_segments_meet([p, q]: [Vec3; 2], [s, t]: [Vec3; 2]) -> bool {
    p.min(q).cmple(s.max(t)).all() && s.min(t).cmple(p.max(q)).all()
}

/// True if two closed segments in space share a point. A segment of length zero is a point.
fn segments_meet(p: Vec3, q: Vec3, s: Vec3, t: Vec3) -> bool {
    if orient(p, q, s, t) != 0.0 {
        return false;
    }
    // The projection must not collapse the common plane. Two coincident points do not define a plane.
    let points = if p == q { [s, t, p, p] } else { [p, q, s, t] };
    match widest_projection(&points) {
        None => collinear_segments_meet([p, q], [s, t]),
        Some(dropped) => {
            let turn = |a: Vec3, b: Vec3, c: Vec3| orient2d(flat(a, dropped), flat(b, dropped), flat(c, dropped));
            coplanar_segments_meet(turn, [p, q], [s, t])
        }
    }
}

fn orient(a: Vec3, b: Vec3, c: Vec3, d: Vec3) -> f64 {
    let coord = |v: Vec3| Coord3D { x: v.x, y: v.y, z: v.z };
    orient3d(coord(a), coord(b), coord(c), coord(d))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_against_thin_and_collapsed_triangles() {
        let crosses = |p: [f32; 3], q: [f32; 3], a: [f32; 3], b: [f32; 3], c: [f32; 3]| {
            let [p, q, a, b, c] = [p, q, a, b, c].map(Vec3::from);
            let found = edge_crosses_triangle(p, q, a, b, c);
            for (b, c) in [(b, c), (c, b)] {
                assert_eq!(found, edge_crosses_triangle(p, q, a, b, c));
                assert_eq!(found, edge_crosses_triangle(q, p, c, a, b));
            }
            found
        };
        let (o, x, xx) = ([0.; 3], [1., 0., 0.], [2., 0., 0.]);
        assert!(crosses([0.5, -1., 0.], [0.5, 1., 0.], o, x, xx), "a line for a triangle, crossed");
        assert!(crosses([2., -1., 0.], [2., 1., 0.], o, x, xx), "crossed at its end");
        assert!(!crosses([2.1, -1., 0.], [2.1, 1., 0.], o, x, xx), "passed by");
        assert!(!crosses([0.5, -1., 1e-30], [0.5, 1., 1e-30], o, x, xx), "passed above");
        assert!(crosses([1.5, 0., 0.], [9., 0., 0.], o, x, xx), "along it");
        assert!(!crosses([2.5, 0., 0.], [9., 0., 0.], o, x, xx), "behind it");
        assert!(crosses(x, x, o, o, xx) && !crosses([1., 1e-30, 0.], [1., 1e-30, 0.], o, o, xx), "a point on a line");
        assert!(crosses(x, x, x, x, x) && !crosses(o, o, x, x, x), "points");
        assert!(crosses([-1., 0., 0.], [3., 0., 0.], x, x, x), "a point for a triangle, on the edge");
        assert!(!crosses([-1., 0., 0.], [3., 1e-7, 0.], x, x, x), "beside the edge");
        // The area is 2^-48 for sides of length 1, so the projection must be chosen by exact areas.
        let third = [1.0 + f32::EPSILON, 1.0 + f32::EPSILON, 1.0];
        assert!(crosses([0.5, 0.5, 0.5], [0.5, 0.5, 2.], o, [1., 1., 1.], third), "a needle, touched");
        assert!(!crosses([0.25, 0.5, 0.5], [0.25, 0.5, 2.], o, [1., 1., 1.], third), "a needle, missed");
    }
}
