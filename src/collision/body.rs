//! Obstacles as bodies: what lies inside of one, where its surface is nearest, where the surfaces of two cross. Looks
//! at all triangles of a body, in f64; a step asks for it only where obstacles leave cloth no room.

use super::elementary::{CandidateKind, closest_offset};
use crate::math::{DVec3, Vec3};
use crate::mesh::{edge_crosses_triangle, triangles_meet};

/// How far beyond a surface counts as its other side, meters.
const BEYOND_M: f64 = 1e-6;

/// The surface of an obstacle at some time.
#[derive(Clone, Copy)]
pub struct Body<'a> {
    /// Positions, xyz, of all vertices that the triangles are numbered over.
    pub x: &'a [f32],
    /// Its triangles.
    pub triangles: &'a [[u32; 3]],
}

/// The nearest point of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// The point, meters.
    pub point: DVec3,
    /// Its distance, meters.
    pub distance_m: f64,
    /// Corners of its triangle.
    pub corners: [u32; 3],
    /// Their weights in the point.
    pub weights: [f64; 3],
}

/// Where two triangles of two surfaces cross.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crossing {
    /// Ends of what they share, meters.
    pub ends: [DVec3; 2],
    /// Corners of the triangle of either surface.
    pub corners: [[u32; 3]; 2],
}

/// True if triangles have an inside: every edge is gone along as often in one direction as in the other.
pub fn is_closed(triangles: &[[u32; 3]]) -> bool {
    let mut edges: Vec<([u32; 2], bool)> = Vec::with_capacity(3 * triangles.len());
    for &[a, b, c] in triangles {
        edges.extend([(a, b), (b, c), (c, a)].map(|(from, to)| ([from.min(to), from.max(to)], from < to)));
    }
    edges.sort_unstable();
    !edges.is_empty()
        && edges.chunk_by(|one, other| one.0 == other.0).all(|same| {
            let forward = same.iter().filter(|edge| edge.1).count();
            2 * forward == same.len()
        })
}

impl<'a> Body<'a> {
    fn at(&self, vertex: u32) -> Vec3 {
        Vec3::from_slice(&self.x[3 * vertex as usize..])
    }

    fn corners(&self, triangle: [u32; 3]) -> [DVec3; 3] {
        triangle.map(|v| self.at(v).as_dvec3())
    }

    /// The box around its triangles: the lowest and the highest coordinates.
    pub fn bounds(&self) -> [DVec3; 2] {
        let all = self.triangles.iter().flat_map(|&t| self.corners(t));
        all.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[low, high], p| [low.min(p), high.max(p)])
    }

    /// Whether a closed body holds a point, by the solid angle that its surface fills as seen from there.
    pub fn holds(&self, point: DVec3) -> bool {
        let angle: f64 = self
            .triangles
            .iter()
            .map(|&triangle| {
                let [a, b, c] = self.corners(triangle).map(|p| p - point);
                let [x, y, z] = [a, b, c].map(DVec3::length);
                // [van Oosterom and Strackee 1983]
                2.0 * a.dot(b.cross(c)).atan2(x * y * z + a.dot(b) * z + b.dot(c) * x + c.dot(a) * y)
            })
            .sum();
        angle.abs() > std::f64::consts::TAU
    }

    /// Whether `point` is inside and still is where it leaves through the surface that is nearest to it, `nearest`:
    /// where parts of a closed body overlap, the surface of each is within the other.
    pub fn buries(&self, point: DVec3, nearest: &Nearest) -> bool {
        let way = (nearest.point - point).try_normalize();
        self.holds(point) && way.is_some_and(|way| self.holds(nearest.point + BEYOND_M * way))
    }

    /// The nearest point of the surface, the first of several; none of a surface without triangles.
    pub fn nearest(&self, point: DVec3) -> Option<Nearest> {
        let mut nearest: Option<Nearest> = None;
        for &corners in self.triangles {
            let [a, b, c] = self.corners(corners);
            let (low, high) = (a.min(b).min(c), a.max(b).max(c));
            let beside = (low - point).max(point - high).max(DVec3::ZERO).length();
            if nearest.is_some_and(|nearest| beside >= nearest.distance_m) {
                continue;
            }
            let (weights, offset) = closest_offset(CandidateKind::VertexFace, [point, a, b, c]);
            let distance_m = offset.length();
            if nearest.is_none_or(|nearest| distance_m < nearest.distance_m) {
                let weights = [1, 2, 3].map(|i| -weights[i]);
                nearest = Some(Nearest { point: point - offset, distance_m, corners, weights });
            }
        }
        nearest
    }

    /// Where triangles of this surface and another cross that reach into the box from `low` to `high`.
    pub fn crossings(&self, other: &Body, region: [DVec3; 2]) -> Vec<Crossing> {
        let others: Vec<[u32; 3]> = other.reaching_into(region).collect();
        let own = self.reaching_into(region);
        own.flat_map(|one| others.iter().filter_map(move |&another| self.crossing(one, other, another))).collect()
    }

    /// Where triangles of this surface that have no corner in common cross, as of [`Body::crossings`].
    pub fn crossings_with_itself(&self, region: [DVec3; 2]) -> Vec<Crossing> {
        let triangles: Vec<[u32; 3]> = self.reaching_into(region).collect();
        let mut found = Vec::new();
        for (i, &one) in triangles.iter().enumerate() {
            for &another in &triangles[i + 1..] {
                if !one.iter().any(|&v| another.iter().any(|&w| self.at(v) == self.at(w))) {
                    found.extend(self.crossing(one, self, another));
                }
            }
        }
        found
    }

    /// Where a triangle of this surface and one of another cross.
    fn crossing(&self, one: [u32; 3], other: &Body, another: [u32; 3]) -> Option<Crossing> {
        let x = [one.map(|v| self.at(v)), another.map(|v| other.at(v))];
        // Numbers that two surfaces have in common mean nothing.
        let meet = triangles_meet([[0, 1, 2], [3, 4, 5]], x);
        meet.then(|| shared(x)).flatten().map(|ends| Crossing { ends, corners: [one, another] })
    }

    /// Triangles whose box shares a point with the box from `low` to `high`.
    pub fn reaching_into(&self, [low, high]: [DVec3; 2]) -> impl Iterator<Item = [u32; 3]> + '_ {
        self.triangles.iter().copied().filter(move |&triangle| {
            let [a, b, c] = self.corners(triangle);
            a.min(b).min(c).cmple(high).all() && a.max(b).max(c).cmpge(low).all()
        })
    }

    /// Whether a triangle of another mesh shares a point with the surface.
    pub fn crosses(&self, triangle: [Vec3; 3]) -> bool {
        let [a, b, c] = triangle.map(|p| p.as_dvec3());
        let mut near = self.reaching_into([a.min(b).min(c), a.max(b).max(c)]);
        near.any(|own| triangles_meet([[0, 1, 2], [3, 4, 5]], [triangle, own.map(|v| self.at(v))]))
    }
}

/// The ends of what two triangles that meet have in common: where edges go through the other one's plane.
fn shared(x: [[Vec3; 3]; 2]) -> Option<[DVec3; 2]> {
    let mut points = Vec::new();
    for (edges, [a, b, c]) in [(x[0], x[1]), (x[1], x[0])] {
        for (p, q) in [(edges[0], edges[1]), (edges[1], edges[2]), (edges[2], edges[0])] {
            if edge_crosses_triangle(p, q, a, b, c) {
                let [p, q, a, b, c] = [p, q, a, b, c].map(|v| v.as_dvec3());
                let normal = (b - a).cross(c - a);
                let (from, to) = ((p - a).dot(normal), (q - a).dot(normal));
                let share = if from == to { 0.5 } else { (from / (from - to)).clamp(0.0, 1.0) };
                points.push(p + (q - p) * share);
            }
        }
    }
    let first = *points.first()?;
    let last = points.iter().copied().max_by(|p, q| p.distance(first).total_cmp(&q.distance(first)))?;
    Some([first, last])
}

/// Distance of a segment and a triangle, meters.
pub fn segment_triangle_m([p, q]: [DVec3; 2], [a, b, c]: [DVec3; 3]) -> f64 {
    let [low_p, low_q, low_a, low_b, low_c] = [p, q, a, b, c].map(|x| x.as_vec3());
    if edge_crosses_triangle(low_p, low_q, low_a, low_b, low_c) {
        return 0.0;
    }
    let ends = [p, q].map(|end| closest_offset(CandidateKind::VertexFace, [end, a, b, c]).1.length());
    let edges = [(a, b), (b, c), (c, a)];
    let across = edges.map(|(from, to)| closest_offset(CandidateKind::EdgeEdge, [p, q, from, to]).1.length());
    ends.into_iter().chain(across).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::shapes;

    fn body(x: &[Vec3]) -> Vec<f32> {
        x.iter().flat_map(|p| p.to_array()).collect()
    }

    #[test]
    fn a_ball_holds_what_is_inside_whichever_way_it_is_wound() {
        let ball = shapes::sphere(0.5, 4);
        let x = body(&ball.positions);
        let turned: Vec<[u32; 3]> = ball.triangles.iter().map(|&[a, b, c]| [a, c, b]).collect();
        for triangles in [&ball.triangles, &turned] {
            assert!(is_closed(triangles) && !is_closed(&triangles[1..]));
            let ball = Body { x: &x, triangles };
            assert!(ball.holds(DVec3::new(0.3, -0.2, 0.25)) && !ball.holds(DVec3::new(0.6, 0.1, 0.0)));
            assert!(ball.holds(DVec3::Y * 0.48) && !ball.holds(DVec3::Y * 0.51));
            let nearest = ball.nearest(DVec3::new(0.0, 0.0, 0.9)).unwrap();
            assert!((nearest.distance_m - 0.4).abs() < 0.01 && nearest.point.distance(DVec3::Z * 0.5) < 0.05);
            assert!((nearest.weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            assert_eq!(ball.bounds()[0].y, -0.5);
        }
    }

    #[test]
    fn a_body_buries_what_is_where_its_parts_overlap() {
        let ball = shapes::sphere(0.5, 6);
        let count = ball.positions.len() as u32;
        let both = |apart: f32| -> Vec<f32> {
            let moved = ball.positions.iter().map(|p| *p + Vec3::X * apart);
            body(&ball.positions.iter().copied().chain(moved).collect::<Vec<_>>())
        };
        let second = ball.triangles.iter().map(|t| t.map(|v| v + count));
        let triangles: Vec<[u32; 3]> = ball.triangles.iter().copied().chain(second).collect();
        let buries = |x: &[f32], point: DVec3| {
            let two = Body { x, triangles: &triangles };
            two.buries(point, &two.nearest(point).unwrap())
        };
        let all = [DVec3::splat(-2.0), DVec3::splat(2.0)];
        // The middle of the overlap, which is 0.2 thick; inside of one ball alone; outside.
        let overlapping = both(0.8);
        assert!(buries(&overlapping, DVec3::X * 0.4));
        assert!(!buries(&overlapping, DVec3::new(-0.3, 0.1, 0.0)) && !buries(&overlapping, DVec3::new(0.4, 0.5, 0.0)));
        let two = Body { x: &overlapping, triangles: &triangles };
        let [one, other] = [0..ball.triangles.len(), ball.triangles.len()..triangles.len()]
            .map(|range| Body { x: &overlapping, triangles: &triangles[range] });
        assert_eq!(two.crossings_with_itself(all).len(), one.crossings(&other, all).len());
        // Balls that only come near each other.
        let near = both(1.001);
        assert!(!buries(&near, DVec3::X * 0.499) && !buries(&near, DVec3::X * 0.5005));
        assert!(Body { x: &near, triangles: &triangles }.crossings_with_itself(all).is_empty());
    }

    #[test]
    fn two_balls_cross_in_a_circle() {
        let ball = shapes::sphere(0.5, 6);
        let x = body(&ball.positions);
        let moved: Vec<f32> = ball.positions.iter().flat_map(|p| (*p + Vec3::X * 0.8).to_array()).collect();
        let [one, other] = [&x, &moved].map(|x| Body { x, triangles: &ball.triangles });
        let found = one.crossings(&other, [DVec3::splat(-2.0), DVec3::splat(2.0)]);
        assert!(found.len() > 12, "{}", found.len());
        for end in found.iter().flat_map(|crossing| crossing.ends) {
            // The circle of x = 0.4 has a radius of 0.3; facets lie up to 1 cm below the ball.
            assert!((end.x - 0.4).abs() < 0.02 && (end.y.hypot(end.z) - 0.3).abs() < 0.03, "{end}");
        }
        assert!(one.crossings(&other, [DVec3::splat(-2.0), DVec3::splat(-0.1)]).is_empty());
        let triangle = [Vec3::ZERO, Vec3::X, Vec3::X * 0.1 + Vec3::Y * 0.1];
        assert!(one.crosses(triangle) && !one.crosses(triangle.map(|p| 0.1 * p)));
        assert_eq!(segment_triangle_m([DVec3::Z, DVec3::NEG_Z], triangle.map(|p| (p - 0.1 * Vec3::X).as_dvec3())), 0.0);
        let above = segment_triangle_m([DVec3::Z, DVec3::new(0.5, 0.01, 0.25)], triangle.map(|p| p.as_dvec3()));
        assert!((above - 0.25).abs() < 1e-12);
    }
}
