//! The point of a surface that is nearest to a point [Ericson 2005, Sec. 5.1.5].

use crate::math::{DVec3, Vec3};

/// A point of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Its triangle.
    pub triangle: usize,
    /// Its barycentric coordinates in the triangle; their sum is 1.
    pub weights: [f64; 3],
    /// Distance from the point that was asked for, meters.
    pub distance_m: f64,
}

/// A surface that answers where it is nearest to points.
pub struct NearestPoint<'a> {
    positions: &'a [Vec3],
    triangles: &'a [[u32; 3]],
    /// Center and radius of a ball around every triangle.
    balls: Vec<(DVec3, f64)>,
}

impl<'a> NearestPoint<'a> {
    /// Prepares a surface. Every triangle names vertices that are there.
    pub fn new(positions: &'a [Vec3], triangles: &'a [[u32; 3]]) -> NearestPoint<'a> {
        let ball = |corners: &[u32; 3]| {
            let corners = corners.map(|v| positions[v as usize].as_dvec3());
            let center = corners.iter().sum::<DVec3>() / 3.0;
            (center, corners.iter().map(|p| p.distance(center)).fold(0.0, f64::max))
        };
        NearestPoint { positions, triangles, balls: triangles.iter().map(ball).collect() }
    }

    /// The nearest point of the surface; of several the one in the first triangle. None if there are no triangles.
    pub fn to(&self, point: DVec3) -> Option<SurfacePoint> {
        let mut best: Option<SurfacePoint> = None;
        for (triangle, &(center, radius)) in self.balls.iter().enumerate() {
            let reach = best.map_or(f64::INFINITY, |best| best.distance_m + radius);
            if point.distance_squared(center) > reach * reach {
                continue;
            }
            let corners = self.triangles[triangle].map(|v| self.positions[v as usize].as_dvec3());
            let weights = nearest_weights(point, corners);
            let distance_m = point.distance(place(corners, weights));
            if best.is_none_or(|best| distance_m < best.distance_m) {
                best = Some(SurfacePoint { triangle, weights, distance_m });
            }
        }
        best
    }
}

/// The point with these barycentric coordinates.
pub fn place(corners: [DVec3; 3], weights: [f64; 3]) -> DVec3 {
    corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2]
}

/// Barycentric coordinates of the point of a triangle that is nearest to `p`.
fn nearest_weights(p: DVec3, [a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let (ab, ac) = (b - a, c - a);
    let (d1, d2) = (ab.dot(p - a), ac.dot(p - a));
    if d1 <= 0.0 && d2 <= 0.0 {
        return [1.0, 0.0, 0.0];
    }
    let (d3, d4) = (ab.dot(p - b), ac.dot(p - b));
    if d3 >= 0.0 && d4 <= d3 {
        return [0.0, 1.0, 0.0];
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        let v = d1 / (d1 - d3);
        return [1.0 - v, v, 0.0];
    }
    let (d5, d6) = (ab.dot(p - c), ac.dot(p - c));
    if d6 >= 0.0 && d5 <= d6 {
        return [0.0, 0.0, 1.0];
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        let w = d2 / (d2 - d6);
        return [1.0 - w, 0.0, w];
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        let w = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return [0.0, 1.0 - w, w];
    }
    let sum = va + vb + vc;
    [1.0 - (vb + vc) / sum, vb / sum, vc / sum]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_edges_and_inside() {
        let corners = [DVec3::ZERO, DVec3::X, DVec3::Y];
        for (p, expected) in [
            ([-1.0, -1.0, 2.0], [0.0, 0.0]),
            ([3.0, -1.0, 0.0], [1.0, 0.0]),
            ([-1.0, 3.0, 0.0], [0.0, 1.0]),
            ([0.25, -2.0, 1.0], [0.25, 0.0]),
            ([-2.0, 0.75, 1.0], [0.0, 0.75]),
            ([1.0, 1.0, 1.0], [0.5, 0.5]),
            ([0.25, 0.5, -3.0], [0.25, 0.5]),
        ] {
            let found = place(corners, nearest_weights(DVec3::from(p), corners));
            assert!(found.distance(DVec3::new(expected[0], expected[1], 0.0)) < 1e-15, "{p:?}: {found}");
        }
    }

    #[test]
    fn the_nearest_of_many_triangles_as_sampling_says() {
        let mut number = 7u32;
        let mut random = || {
            number = number.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(number >> 8) / f64::from(1 << 24)
        };
        let positions: Vec<Vec3> = (0..90).map(|_| DVec3::new(random(), random(), random()).as_vec3()).collect();
        let triangles: Vec<[u32; 3]> = (0..30).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let surface = NearestPoint::new(&positions, &triangles);
        for _ in 0..50 {
            let p = DVec3::new(random(), random(), random());
            let found = surface.to(p).unwrap();
            let corners = |t: usize| triangles[t].map(|v| positions[v as usize].as_dvec3());
            assert!((p.distance(place(corners(found.triangle), found.weights)) - found.distance_m).abs() < 1e-12);
            for t in 0..30 {
                for i in 0..=10 {
                    for j in 0..=10 - i {
                        let (v, w) = (f64::from(i) / 10.0, f64::from(j) / 10.0);
                        let other = p.distance(place(corners(t), [1.0 - v - w, v, w]));
                        assert!(found.distance_m <= other + 1e-12, "{p}: triangle {t} is nearer");
                    }
                }
            }
        }
        assert!(NearestPoint::new(&positions, &[]).to(DVec3::ZERO).is_none());
    }
}
