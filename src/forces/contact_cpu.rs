//! CPU twin of `contact.wgsl`: one record per contact.
//!
//! Repulsion asks for the gap back within [`RELEASE_STEPS`] steps, not within one: force k (depth - RELEASE_STEPS dt u_n) at
//! the end of the step, a spring with a damper. At rest only the spring is left. An undamped spring of this stiffness throws
//! off what an impact has left deep in it, at up to thickness / step, and resting cloth flutters on it. What would be out of
//! reach at the end of the step by itself is left alone; what leaves more slowly is held back by the damper. A pair out of reach
//! that its motion would close (depth below zero) is stopped at the border of its reach, not before.
//!
//! Friction follows Coulomb's law with F = the normal force of the last step, which position and velocity still tell: the
//! depth was less by dt u_n. Facets that stand for a curved surface slope against it: what slides over them closes in on the
//! next one without any force having acted, by up to [`FACET_SLOPE`] of its way along; that much does not count. A pair that
//! was out of reach then has met in an impact; it gets the impulse that stops its masses. The drag
//! c = mu F / max(|u_t|, [`STICK_SPEED_M_S`]) is implicit where it could turn sliding around within the step; where it is
//! small beside the masses it is a constant force, as the law says.

use super::contact_element::{ContactElement, NO_VERTEX};
use super::element::{CONTACT_RECORD_FLOATS, vertex};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;

/// Below this speed friction is proportional to it, m/s: a body that sticks creeps at this times (tangential over largest
/// friction force), 4 micrometres in a step of 1/250 s at most.
pub const STICK_SPEED_M_S: f32 = 1e-3;

/// Normal over tangential speed up to which closing in is taken for the slope of facets: they may be off by 6 degrees.
pub const FACET_SLOPE: f32 = 0.1;

/// Steps in which the repulsion restores the gap.
pub const RELEASE_STEPS: f32 = 10.0;

/// Contacts that may act on a vertex with equal drag before an explicit drag could turn it around.
const SHARING: f32 = 8.0;

/// Energy of the repulsion at `positions`, joules (for tests and reports). Weights stay those of the element.
pub fn contact_energy(element: &ContactElement, positions: [Vec3; 4]) -> f64 {
    let apart = (0..4).map(|a| positions[a].as_dvec3() * f64::from(element.weights[a]));
    let depth = f64::from(element.thickness_m) - apart.sum::<crate::math::DVec3>().length();
    0.5 * f64::from(element.stiffness_n_m) * depth.max(0.0).powi(2)
}

/// Fills `records` (12 floats per contact; layout in `contact`). Bytes per contact: 64 element + 48 velocities read, 48
/// written.
pub(super) fn contact(
    cpu: &CpuExecutor,
    step_s: f32,
    stiffness_ratio: f32,
    elements: &[ContactElement],
    velocities: &[f32],
    records: &mut [f32],
) {
    cpu.for_ranges_mut(records, CONTACT_RECORD_FLOATS, 256, |range, records| {
        for (element, record) in elements[range].iter().zip(records.as_chunks_mut().0) {
            *record = one_record(step_s, stiffness_ratio, element, velocities);
        }
    });
}

#[inline(always)]
fn one_record(
    step_s: f32,
    stiffness_ratio: f32,
    element: &ContactElement,
    velocities: &[f32],
) -> [f32; CONTACT_RECORD_FLOATS] {
    let mut u = Vec3::ZERO;
    for (&v, &w) in element.vertices.iter().zip(&element.weights) {
        if v != NO_VERTEX {
            u += vertex(velocities, v) * w;
        }
    }
    let (n, k) = (Vec3::from(element.normal), element.stiffness_n_m);
    let un = n.dot(u);
    let depth = element.thickness_m - element.distance_m;
    let release_s = RELEASE_STEPS * step_s;
    // A depth below zero is a contact that the motion will close.
    let acts = depth - step_s * un > 0.0;
    if !acts {
        return [0.0; CONTACT_RECORD_FLOATS];
    }
    let ut = u - n * un;
    let mass = step_s * step_s * k / stiffness_ratio;
    let before = depth + step_s * un;
    let impact = (depth.min(0.0) - step_s * un) / (step_s * step_s);
    let slip = ut.length();
    let parting = un.max(0.0) + (un + FACET_SLOPE * slip).min(0.0);
    let normal_force = if before > 0.0 { k * (before - release_s * parting).max(0.0) } else { mass * impact };
    let drag = step_s * (element.friction * normal_force / slip.max(STICK_SPEED_M_S));
    let beta = drag * (SHARING * drag / mass).min(1.0);
    let g = n * (step_s * k * (if depth > 0.0 { depth } else { RELEASE_STEPS * depth } - release_s * un)) - ut * drag;
    let [w0, w1, w2, w3] = element.weights;
    [w0, w1, w2, w3, n.x, n.y, n.z, step_s * release_s * k, beta, g.x, g.y, g.z]
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
        contact(&CpuExecutor::new(1), step_s, RATIO, &[*element], &flat, &mut record);
        record
    }

    const DT: f32 = 1.0 / 256.0;
    const RATIO: f32 = 8.0;

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
            let jacobian = f64::from(element.weights[a] * element.weights[a] * record[7] / (DT * RELEASE_STEPS * DT));
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
    fn what_gets_out_or_is_apart_is_left_alone() {
        let (_, apart) = resting(0.0101);
        assert_eq!(record_of(DT, &apart, [-Vec3::Z; 4]), [0.0; CONTACT_RECORD_FLOATS]);
        let closing = |speed: f32| record_of(DT, &apart, [-Vec3::Z * speed, Vec3::ZERO, Vec3::ZERO, Vec3::ZERO]);
        // 0.1 mm out of reach: within it at the end of the step from 25.6 mm/s on.
        assert_eq!(closing(0.0255), [0.0; CONTACT_RECORD_FLOATS]);
        // Stopped at the border: the impulse of ten times the stiffness for the way inside alone.
        let (way, stiffness) = (1.0 * DT - 0.0001, RELEASE_STEPS * apart.stiffness_n_m);
        assert!((closing(1.0)[11] / (DT * stiffness * way) - 1.0).abs() < 1e-4);
        // 4 mm deep: out at the end of the step from 1.024 m/s on.
        let (_, deep) = resting(0.006);
        let leaving = |speed: f32| record_of(DT, &deep, [Vec3::Z * speed, Vec3::ZERO, Vec3::ZERO, Vec3::ZERO]);
        assert_eq!(leaving(1.03), [0.0; CONTACT_RECORD_FLOATS]);
        // Driven out up to a tenth of that, held back above.
        assert!(leaving(0.1)[11] > 0.0 && leaving(0.103)[11] < 0.0 && leaving(1.0)[8] == 0.0);
    }

    /// The repulsion's own response: what an impact left deep comes out slowly, and what moves against it is stopped.
    #[test]
    fn repulsion_stops_and_does_not_throw() {
        let (_, element) = resting(0.001);
        let mass = element.stiffness_n_m * DT * DT / RATIO;
        for speed in [-3.0f32, -0.1, 0.0] {
            let (mut depth, mut v) = (0.009f32, speed);
            for step in 0..100 {
                let at = ContactElement {
                    vertices: [0, NO_VERTEX, NO_VERTEX, NO_VERTEX],
                    distance_m: element.thickness_m - depth,
                    ..element
                };
                let record = record_of(DT, &at, [Vec3::Z * v; 4]);
                v += record[11] / (mass + record[7]);
                depth -= DT * v;
                // A tenth of the gap in a step, and what the masses' inertia keeps of the impact.
                assert!(v <= 0.101 * 0.009 / DT && (step == 0 || v >= -1e-3 * 3.0), "step {step}: {v} m/s");
            }
            assert!(depth < 1e-4, "{depth} m deep after 100 steps");
        }
    }

    /// Sliding steadily under its weight, the force of the last step is the weight.
    #[test]
    fn friction_at_rest_is_that_of_the_weight() {
        let (_, element) = resting(0.0098);
        let fixed = ContactElement { vertices: [0, NO_VERTEX, NO_VERTEX, NO_VERTEX], ..element };
        let weight = 200.0 * 0.0002;
        for speed in [0.05f32, 1.0, 10.0] {
            let record = record_of(DT, &fixed, [Vec3::X * speed; 4]);
            assert!((record[9] + 0.5 * weight * DT).abs() < 1e-4 * weight * DT, "{} at {speed} m/s", record[9]);
        }
        // Sinking at 1 mm/s it was held back by the damper as well: 9 of the 10 steps' worth. While it slides at 1 m/s that
        // is the slope of facets, which takes 0.1 m/s.
        for (speed, sinking, counts) in [(1e-3, 1e-3, 0.9e-3), (1.0, 1e-3, 0.0), (1.0, 0.15, 0.05)] {
            let deep = ContactElement { distance_m: fixed.distance_m - 0.0008, ..fixed };
            let record = record_of(DT, &deep, [Vec3::new(speed, 0.0, -sinking); 4]);
            let force = 200.0 * (0.001 + DT * (RELEASE_STEPS * counts - sinking));
            assert!((record[9] + 0.5 * force * DT).abs() < 1e-3 * force * DT, "{} {force}", record[9]);
        }
        // An impact at 2 m/s from out of reach stops the mass: 0.5 m u.
        let record = record_of(DT, &fixed, [Vec3::new(10.0, 0.0, -2.0); 4]);
        let mass = 200.0 * DT * DT / RATIO;
        assert!((record[9] + 0.5 * mass * 2.0).abs() < 1e-4 * mass, "{} of {mass}", record[9]);
    }

    /// A point on a plane: (m + beta) dv = g along the plane, m down to the mass that the stiffness is made for.
    #[test]
    fn friction_slows_down_and_never_turns_around() {
        let (_, element) = resting(0.006);
        let fixed = ContactElement { vertices: [0, NO_VERTEX, NO_VERTEX, NO_VERTEX], ..element };
        let least = element.stiffness_n_m * DT * DT / RATIO;
        for mass in [least, 10.0 * least, 1.0] {
            for speed in [1e-6f32, 1e-4, 1e-2, 0.1, 1.0, 10.0, 100.0] {
                let record = record_of(DT, &fixed, [Vec3::X * speed; 4]);
                // One contact, or several that act on the same point.
                for contacts in [1.0, 3.0, 20.0] {
                    let after = speed + contacts * record[9] / (mass + contacts * record[8]);
                    assert!(after >= -1e-5 * speed && after < speed, "{mass} kg at {speed} m/s: {after} m/s");
                }
                // At most Coulomb's impulse, mu k (h - d) dt = 0.4 dt; all of it where the point slides.
                assert!(-record[9] <= 0.4 * DT * 1.0001);
                assert!(speed < STICK_SPEED_M_S || (record[9] + 0.4 * DT).abs() < 1e-5 * DT);
            }
        }
        let smooth = ContactElement { friction: 0.0, ..fixed };
        assert_eq!(record_of(DT, &smooth, [Vec3::X; 4])[8..11], [0.0; 3]);
    }
}
