//! CPU twin of `contact.wgsl`: one record per contact.
//!
//! Friction follows Coulomb's law as an implicit drag: force -c u_t at the end of the step with c = mu F / max(|u_t|,
//! [`STICK_SPEED_M_S`]). A drag taken implicitly slows sliding down and never turns it around. F is the smaller of the
//! repulsion now and the one predicted for the end: equal at rest and in steady sliding, less for bodies that part. In the
//! step of an impact the prediction says nothing useful (k dt |u_n| ignores how light the bodies are), so F follows one
//! step later, from the depth that was reached.

use super::contact_element::{ContactElement, NO_VERTEX};
use super::element::{CONTACT_RECORD_FLOATS, vertex};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;

/// Below this speed friction is proportional to it, m/s: a body that sticks creeps at this times (tangential over largest
/// friction force), 4 micrometres in a step of 1/250 s at most.
pub const STICK_SPEED_M_S: f32 = 1e-3;

/// Energy of the repulsion at `positions`, joules (for tests and reports). Weights stay those of the element.
pub fn contact_energy(element: &ContactElement, positions: [Vec3; 4]) -> f64 {
    let apart = (0..4).map(|a| positions[a].as_dvec3() * f64::from(element.weights[a]));
    let depth = f64::from(element.thickness_m) - apart.sum::<crate::math::DVec3>().length();
    0.5 * f64::from(element.stiffness_n_m) * depth.max(0.0).powi(2)
}

/// Fills `records` (12 floats per contact; layout in `contact`). Bytes per contact: 64 element + 48 velocities read, 48
/// written.
pub fn contact(cpu: &CpuExecutor, step_s: f32, elements: &[ContactElement], velocities: &[f32], records: &mut [f32]) {
    cpu.for_ranges_mut(records, CONTACT_RECORD_FLOATS, 256, |range, records| {
        for (element, record) in elements[range].iter().zip(records.as_chunks_mut().0) {
            *record = one_record(step_s, element, velocities);
        }
    });
}

#[inline(always)]
fn one_record(step_s: f32, element: &ContactElement, velocities: &[f32]) -> [f32; CONTACT_RECORD_FLOATS] {
    let mut u = Vec3::ZERO;
    for (&v, &w) in element.vertices.iter().zip(&element.weights) {
        if v != NO_VERTEX {
            u += vertex(velocities, v) * w;
        }
    }
    let (n, k) = (Vec3::from(element.normal), element.stiffness_n_m);
    let un = n.dot(u);
    let depth = element.thickness_m - element.distance_m;
    let predicted = depth - step_s * un;
    // A depth below zero is a contact that the motion will close.
    if !(predicted > 0.0) {
        return [0.0; CONTACT_RECORD_FLOATS];
    }
    let ut = u - n * un;
    let friction = element.friction * (k * depth.min(predicted).max(0.0));
    let beta = step_s * (friction / ut.length().max(STICK_SPEED_M_S));
    let g = n * (step_s * k * predicted) - ut * beta;
    let [w0, w1, w2, w3] = element.weights;
    [w0, w1, w2, w3, n.x, n.y, n.z, step_s * step_s * k, beta, g.x, g.y, g.z]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Vertex 0 above the triangle 1, 2, 3 at height d; closest point at weights 1/2, 1/4, 1/4.
    fn resting(d: f32) -> ([Vec3; 4], ContactElement) {
        let x = [Vec3::new(0.25, 0.25, d), Vec3::ZERO, Vec3::X, Vec3::Y];
        let element = ContactElement {
            vertices: [0, 1, 2, 3],
            weights: [1.0, -0.5, -0.25, -0.25],
            normal: [0.0, 0.0, 1.0],
            distance_m: d,
            thickness_m: 0.01,
            stiffness_n_m: 200.0,
            friction: 0.5,
            kind: 0,
        };
        (x, element)
    }

    fn record_of(step_s: f32, element: &ContactElement, v: [Vec3; 4]) -> [f32; CONTACT_RECORD_FLOATS] {
        let flat: Vec<f32> = v.iter().flat_map(|v| v.to_array()).collect();
        let mut record = [f32::NAN; CONTACT_RECORD_FLOATS];
        contact(&CpuExecutor::new(1), step_s, &[*element], &flat, &mut record);
        record
    }

    const DT: f32 = 1.0 / 256.0;

    #[test]
    fn force_is_the_negative_gradient_of_the_energy_and_alpha_its_second_derivative() {
        let (x, element) = resting(0.006);
        let record = record_of(DT, &element, [Vec3::ZERO; 4]);
        let energy = |a: usize, axis: usize, by: f32| {
            let mut x = x;
            x[a][axis] += by;
            contact_energy(&element, x)
        };
        let h = 1e-4;
        for a in 0..4 {
            for axis in 0..3 {
                let slope = (energy(a, axis, h) - energy(a, axis, -h)) / (2.0 * f64::from(h));
                let force = f64::from(element.weights[a] * record[9 + axis] / DT);
                assert!((force + slope).abs() < 1e-3 * 0.8, "corner {a} axis {axis}: {force} {slope}");
            }
            let second = (energy(a, 2, h) + energy(a, 2, -h) - 2.0 * energy(a, 2, 0.0)) / f64::from(h * h);
            let jacobian = f64::from(element.weights[a] * element.weights[a] * record[7] / (DT * DT));
            assert!((second - jacobian).abs() < 2e-3 * 200.0, "corner {a}: {jacobian} {second}");
        }
        assert!((record[11] - DT * 0.8).abs() < 1e-6, "k (h - d) = 200 * 0.004");
    }

    #[test]
    fn impulses_of_free_bodies_balance() {
        let (_, element) = resting(0.003);
        let v = [Vec3::new(0.3, -0.2, -0.1), Vec3::X * 0.1, Vec3::Y * -0.4, Vec3::new(0.0, 0.2, 0.05)];
        let record = record_of(DT, &element, v);
        let g = Vec3::from_slice(&record[9..12]);
        assert!(g.z > 0.0 && g.x != 0.0 && record[8] > 0.0);
        let sum: f32 = element.weights.iter().sum();
        assert_eq!(sum * g, Vec3::ZERO);
        // As rows get it: the sum of w_a g.
        let total: Vec3 = element.weights.iter().map(|&w| g * w).sum();
        assert!(total.length() <= 1e-7 * g.length());
    }

    #[test]
    fn what_leaves_or_is_apart_is_not_pulled() {
        let (_, apart) = resting(0.0101);
        assert_eq!(record_of(DT, &apart, [-Vec3::Z; 4]), [0.0; CONTACT_RECORD_FLOATS]);
        assert_eq!(record_of(DT, &apart, [-Vec3::Z, Vec3::ZERO, Vec3::ZERO, Vec3::ZERO]), [0.0; CONTACT_RECORD_FLOATS]);
        // 4 mm deep: out at the end of the step from 1.024 m/s on.
        let (_, deep) = resting(0.006);
        let leaving = |speed: f32| record_of(DT, &deep, [Vec3::Z * speed, Vec3::ZERO, Vec3::ZERO, Vec3::ZERO]);
        assert_eq!(leaving(1.03), [0.0; CONTACT_RECORD_FLOATS]);
        assert!(leaving(1.0)[11] > 0.0);
    }

    /// A point of mass m on a plane: (m + beta) dv = -beta u along the plane.
    #[test]
    fn friction_slows_down_and_never_turns_around() {
        let (_, element) = resting(0.006);
        let fixed = ContactElement { vertices: [0, NO_VERTEX, NO_VERTEX, NO_VERTEX], ..element };
        for mass in [1e-6f32, 1e-3, 1.0] {
            for speed in [1e-6f32, 1e-4, 1e-2, 1.0, 10.0] {
                let record = record_of(DT, &fixed, [Vec3::X * speed; 4]);
                let (beta, g) = (record[8], record[9]);
                assert!((g + beta * speed).abs() <= 1e-5 * beta * speed);
                let after = speed + g / (mass + beta);
                assert!(after >= -1e-5 * speed && after < speed, "{mass} kg at {speed} m/s: {after} m/s");
                // At most Coulomb's impulse, mu k (h - d) dt = 0.4 dt.
                assert!(beta * speed <= 0.4 * DT * 1.0001);
            }
            // Fast sliding: the impulse is Coulomb's.
            let record = record_of(DT, &fixed, [Vec3::X * 10.0; 4]);
            assert!((record[9] + 0.4 * DT).abs() < 1e-5 * DT);
        }
        let smooth = ContactElement { friction: 0.0, ..fixed };
        assert_eq!(record_of(DT, &smooth, [Vec3::X; 4])[8..11], [0.0; 3]);
    }
}
