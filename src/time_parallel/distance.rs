//! How far two states of one mesh are apart: distances of vertices, the same after the best rigid motion, and the
//! relative difference of curvature [Liang and Lin 2018, Eq. 17]. Sums are in f64, in the order of the mesh.

use glam::{DMat3, DQuat, DVec3};

use crate::forces::dihedral_angle;
use crate::math::Vec3;
use crate::mesh::{Hinge, TriangleMesh, hinges};

/// Distance of two states of one mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distance {
    /// Root mean square of the distances of the vertices, meters.
    pub rms_m: f64,
    /// Largest distance of a vertex, meters.
    pub max_m: f64,
    /// The vertex with the largest distance.
    pub max_vertex: usize,
    /// `rms_m` after the rotation and translation of the second state that make it smallest, meters.
    pub aligned_rms_m: f64,
    /// Eq. 17 with the dihedral angle theta as curvature: sum |theta - theta'| / sum |theta|, theta of the first state.
    /// Not finite where the first state is flat and the second is not.
    pub eq17_theta: f64,
    /// Eq. 17 with the curvature theta l / a, 1/m: l = length of the edge, a = a third of the area of both triangles.
    pub eq17_curvature: f64,
}

/// Compares states of one mesh.
pub struct Comparison {
    triangles: Vec<[u32; 3]>,
    hinges: Vec<Hinge>,
}

impl Comparison {
    /// For states of a mesh of these triangles, of which every edge has at most two.
    pub fn new(triangles: Vec<[u32; 3]>) -> Comparison {
        let mesh = TriangleMesh { triangles, ..TriangleMesh::default() };
        Comparison { hinges: hinges(&mesh), triangles: mesh.triangles }
    }

    /// The distance of state `b` from state `a`. Both have a position per vertex of the mesh, meters.
    pub fn distance(&self, a: &[Vec3], b: &[Vec3]) -> Distance {
        assert_eq!(a.len(), b.len());
        let (max_vertex, max_squared) = a
            .iter()
            .zip(b)
            .map(|(a, b)| a.as_dvec3().distance_squared(b.as_dvec3()))
            .enumerate()
            .fold((0, 0.0), |most, next| if next.1 > most.1 { next } else { most });
        let [mut theta, mut theta_all, mut curvature, mut curvature_all] = [0.0; 4];
        for hinge in &self.hinges {
            let [(angle_a, scale_a), (angle_b, scale_b)] = [a, b].map(|x| self.bend(hinge, x));
            theta += (angle_a - angle_b).abs();
            theta_all += angle_a.abs();
            curvature += (angle_a * scale_a - angle_b * scale_b).abs();
            curvature_all += (angle_a * scale_a).abs();
        }
        let relative = |difference: f64, all: f64| if difference == 0.0 { 0.0 } else { difference / all };
        Distance {
            rms_m: rms(a, b),
            max_m: max_squared.sqrt(),
            max_vertex,
            aligned_rms_m: aligned_rms(a, b),
            eq17_theta: relative(theta, theta_all),
            eq17_curvature: relative(curvature, curvature_all),
        }
    }

    /// Dihedral angle at an edge, and what makes a curvature of it, 1/m; 0 for triangles without area.
    fn bend(&self, hinge: &Hinge, x: &[Vec3]) -> (f64, f64) {
        let corners = hinge.vertices.map(|v| x[v as usize]);
        let (angle, _) = dihedral_angle(corners);
        let area: f64 = hinge
            .triangles
            .iter()
            .map(|&t| {
                let [p, q, r] = self.triangles[t as usize].map(|v| x[v as usize].as_dvec3());
                0.5 * (q - p).cross(r - p).length()
            })
            .sum();
        let length = corners[0].as_dvec3().distance(corners[1].as_dvec3());
        (f64::from(angle), if area > 0.0 { 3.0 * length / area } else { 0.0 })
    }
}

/// Root mean square of the distances of vectors, in their unit. 0 for none.
pub fn rms(a: &[Vec3], b: &[Vec3]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| a.as_dvec3().distance_squared(b.as_dvec3())).sum();
    (sum / a.len().max(1) as f64).sqrt()
}

/// Root mean square distance after the best rotation and translation of `b` [Horn 1987].
fn aligned_rms(a: &[Vec3], b: &[Vec3]) -> f64 {
    let count = a.len().max(1) as f64;
    let [center_a, center_b] = [a, b].map(|x| x.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / count);
    let pairs = || a.iter().zip(b).map(|(a, b)| (a.as_dvec3() - center_a, b.as_dvec3() - center_b));
    let mut correlation = DMat3::ZERO;
    for (a, b) in pairs() {
        correlation += DMat3::from_cols(a * b.x, a * b.y, a * b.z);
    }
    let turn = best_rotation(correlation);
    (pairs().map(|(a, b)| a.distance_squared(turn * b)).sum::<f64>() / count).sqrt()
}

/// The rotation R with the largest trace of R^T `correlation`, `correlation` = sum a b^T: the eigenvector of the
/// largest eigenvalue of a symmetric matrix of four rows [Horn 1987], found by Jacobi rotations.
fn best_rotation(correlation: DMat3) -> DQuat {
    let s = |row: usize, column: usize| correlation.col(column)[row];
    let antisymmetric = [s(2, 1) - s(1, 2), s(0, 2) - s(2, 0), s(1, 0) - s(0, 1)];
    let trace = s(0, 0) + s(1, 1) + s(2, 2);
    let mut m = [[0.0; 4]; 4];
    m[0][0] = trace;
    for i in 0..3 {
        m[0][i + 1] = antisymmetric[i];
        m[i + 1][0] = antisymmetric[i];
        for j in 0..3 {
            m[i + 1][j + 1] = s(i, j) + s(j, i) - if i == j { trace } else { 0.0 };
        }
    }
    let mut vectors = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    // Jacobi's method converges quadratically: 4 rows are diagonal to rounding after 5 or 6 sweeps.
    for _ in 0..10 {
        for (p, q) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
            if m[p][q] == 0.0 {
                continue;
            }
            let ratio = (m[q][q] - m[p][p]) / (2.0 * m[p][q]);
            let tangent = ratio.signum() / (ratio.abs() + ratio.hypot(1.0));
            let cosine = 1.0 / tangent.hypot(1.0);
            let sine = tangent * cosine;
            for row in m.iter_mut().chain(vectors.iter_mut()) {
                (row[p], row[q]) = (cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]);
            }
            let (row_p, row_q) = (m[p], m[q]);
            for k in 0..4 {
                m[p][k] = cosine * row_p[k] - sine * row_q[k];
                m[q][k] = sine * row_p[k] + cosine * row_q[k];
            }
        }
    }
    let largest = (1..4).fold(0, |best, i| if m[i][i] > m[best][best] { i } else { best });
    let [w, x, y, z] = vectors.map(|row| row[largest]);
    DQuat::from_xyzw(x, y, z, w).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    /// A strip of four triangles, bent by `angle` at its middle edge (x = 1).
    fn strip(angle: f32) -> (Vec<[u32; 3]>, Vec<Vec3>) {
        let turned = Vec3::new(1.0 + angle.cos(), angle.sin(), 0.0);
        let positions = [Vec3::ZERO, Vec3::X, turned].into_iter().flat_map(|p| [p, p + Vec3::Z]).collect();
        (vec![[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5]], positions)
    }

    #[test]
    fn equal_states_have_no_distance() {
        let (triangles, x) = strip(0.3);
        let distance = Comparison::new(triangles).distance(&x, &x);
        assert!(distance.aligned_rms_m < 1e-7, "{distance:?}");
        assert_eq!(Distance { aligned_rms_m: 0.0, ..distance }, Distance::default());
    }

    #[test]
    fn a_rigid_motion_is_a_distance_but_no_curvature_and_aligned_away() {
        let (triangles, x) = strip(0.7);
        let turn = Quat::from_axis_angle(Vec3::new(1.0, 2.0, -0.5).normalize(), 2.9);
        let moved: Vec<Vec3> = x.iter().map(|p| turn * *p + Vec3::new(3.0, 0.0, -4.0)).collect();
        let distance = Comparison::new(triangles).distance(&x, &moved);
        assert!(distance.rms_m > 4.0 && distance.max_m >= distance.rms_m, "{distance:?}");
        assert!(distance.aligned_rms_m < 1e-6, "{distance:?}");
        assert!(distance.eq17_theta < 1e-5 && distance.eq17_curvature < 1e-5, "{distance:?}");
    }

    #[test]
    fn a_translation_has_its_length() {
        let (triangles, x) = strip(0.0);
        let moved: Vec<Vec3> = x.iter().map(|p| *p + Vec3::new(0.0, 3.0, 4.0)).collect();
        let distance = Comparison::new(triangles).distance(&x, &moved);
        assert_eq!((distance.rms_m, distance.max_m), (5.0, 5.0));
    }

    #[test]
    fn eq_17_is_relative_to_the_bends_of_the_first() {
        // The middle edge is the only bend: 0.4 against 0.3 differs by a third of 0.3, whatever the curvature's scale.
        let (triangles, a) = strip(0.3);
        let (_, b) = strip(0.4);
        let distance = Comparison::new(triangles).distance(&a, &b);
        assert!((distance.eq17_theta - 1.0 / 3.0).abs() < 1e-5, "{distance:?}");
        assert!((distance.eq17_curvature - 1.0 / 3.0).abs() < 1e-5, "{distance:?}");
    }

    #[test]
    fn eq_17_of_a_flat_first_state_is_not_finite() {
        let (triangles, flat) = strip(0.0);
        let (_, bent) = strip(0.4);
        assert!(Comparison::new(triangles).distance(&flat, &bent).eq17_theta.is_infinite());
    }

    #[test]
    fn half_a_turn_is_found() {
        // The largest angle, for which the quaternion's scalar part is zero.
        let (triangles, x) = strip(1.0);
        let turned: Vec<Vec3> = x.iter().map(|p| Vec3::new(-p.x, p.y, -p.z)).collect();
        let distance = Comparison::new(triangles).distance(&x, &turned);
        assert!(distance.aligned_rms_m < 1e-6, "{distance:?}");
    }
}
