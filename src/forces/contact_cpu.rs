//! CPU twin of `contact.wgsl`: one record per contact.
//!
//! Repulsion is the negative gradient of a barrier, as in incremental potential contact [Li et al. 2020a]: force k h (h
//! - d) / d at the gap d below the thickness h, a spring of stiffness k for shallow contacts, without bound for deep
//! ones, so that what presses on them never has to be carried by an impact zone. One Newton step on it moves a gap by
//! at most d (h - d) / h: what an impact has left deep gets out within a few steps and is not thrown. There is no
//! damper: backward Euler takes the energy of the spring. A record linearizes the force where the gap will be at the
//! end of the step. In a first solve that is the gap at the start, or where the barrier alone stops the masses that
//! come from farther; in a second one (`at_end`) the gap that the first one found. A linearized force that would pull
//! where velocities and gravity lead to is no contact.
//!
//! Friction follows Coulomb's law: the drag c = mu F / max(|u_t|, [`STICK_SPEED_M_S`]) with the push F. In a first
//! solve that is the repulsion if velocities stay, or what stops what comes in; in a second one mu is scaled so that F
//! is what the first one pressed with (`step/normal_forces.rs`). The drag is implicit where it could turn sliding
//! around within the step; where it is small beside the masses it is a constant force, as the law says. An implicit
//! drag made with the slip at the start of the step lets that grow by no more than driving over friction force in a
//! step. So in a second solve what the first one has let slip faster than at the start is taken to slide and has the
//! constant force.

use super::contact::ContactStep;
use super::contact_element::{ContactElement, NO_VERTEX};
use super::element::{CONTACT_RECORD_FLOATS, vertex};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;

/// Below this speed friction is proportional to it, m/s: a body that sticks creeps at this times (tangential over
/// largest friction force).
pub const STICK_SPEED_M_S: f32 = 4e-5;

/// Gap over thickness below which the barrier goes on along its tangent.
pub const LEAST_GAP: f32 = 0.1;

/// Contacts that may act on a vertex with equal drag before an explicit drag could turn it around.
const SHARING: f32 = 8.0;

/// Energy of the repulsion at `positions`, joules (for tests and reports): k h (h ln(h / d) - (h - d)). Weights stay
/// those of the element.
pub fn contact_energy(element: &ContactElement, positions: [Vec3; 4]) -> f64 {
    let apart = (0..4).map(|a| positions[a].as_dvec3() * f64::from(element.weights[a]));
    let (gap, h) = (apart.sum::<crate::math::DVec3>().length(), f64::from(element.thickness_m));
    if gap >= h { 0.0 } else { f64::from(element.stiffness_n_m) * h * (h * (h / gap).ln() - (h - gap)) }
}

/// A barrier's force as a step's linear system has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearBarrier {
    /// Gap where it is linearized, metres.
    pub at_m: f32,
    /// Force there, N.
    pub force_n: f32,
    /// What the force grows by as the gap closes, N/m.
    pub slope_n_m: f32,
    /// Whether it is linearized where it stops what comes in, closer than the gap at the start of the step.
    pub impact: bool,
}

impl LinearBarrier {
    /// The linearized force at a gap, N; negative where it pulls.
    #[inline(always)]
    pub fn at(&self, gap_m: f32) -> f32 {
        self.force_n + self.slope_n_m * (self.at_m - gap_m)
    }
}

/// The barrier of a contact, linearized for a solve. `free_m`: the gap at the end of the step if velocities stay; in a
/// second solve (`at_end`) those that the first one has found.
#[inline(always)]
pub fn linearized(element: &ContactElement, free_m: f32, stiffness_ratio: f32, at_end: bool) -> LinearBarrier {
    let (k, h) = (element.stiffness_n_m, element.thickness_m);
    let least = LEAST_GAP * h;
    // m (d - free) / dt^2 = k h (h - d) / d with k = ratio m / dt^2.
    let b = stiffness_ratio * h - free_m;
    let stopped = 0.5 * ((b * b + 4.0 * stiffness_ratio * h * h).sqrt() - b);
    let (at_m, impact) = match at_end {
        true => (free_m.clamp(least, h), false),
        false => {
            let start = element.distance_m.clamp(least, h);
            (start.min(stopped), stopped < start)
        }
    };
    LinearBarrier { at_m, force_n: k * h * (h - at_m) / at_m, slope_n_m: k * (h / at_m) * (h / at_m), impact }
}

/// Fills `records` (12 floats per contact; layout in `contact`). Bytes per contact: 64 element + 48 velocities read, 48
/// written.
pub(super) fn contact(
    cpu: &CpuExecutor,
    step: &ContactStep,
    elements: &[ContactElement],
    velocities: &[f32],
    start_velocities: &[f32],
    records: &mut [f32],
) {
    cpu.for_ranges_mut(records, CONTACT_RECORD_FLOATS, 256, |range, records| {
        for (element, record) in elements[range].iter().zip(records.as_chunks_mut().0) {
            *record = one_record(step, element, velocities, start_velocities);
        }
    });
}

#[inline(always)]
fn one_record(
    step: &ContactStep,
    element: &ContactElement,
    velocities: &[f32],
    start_velocities: &[f32],
) -> [f32; CONTACT_RECORD_FLOATS] {
    let &ContactStep { step_s, stiffness_ratio, at_end, fall_m, rows } = step;
    let (mut u, mut u_start, mut cloth) = (Vec3::ZERO, Vec3::ZERO, 0.0);
    for (&v, &w) in element.vertices.iter().zip(&element.weights) {
        if v != NO_VERTEX {
            u += vertex(velocities, v) * w;
            u_start += vertex(start_velocities, v) * w;
            cloth += if v < rows { w } else { 0.0 };
        }
    }
    let n = Vec3::from(element.normal);
    let un = n.dot(u);
    // The gap at the end of the step if velocities stay.
    let free_m = element.distance_m + step_s * un;
    let barrier = linearized(element, free_m, stiffness_ratio, at_end);
    let push = barrier.at(free_m);
    // Written so that what is no number makes no contact.
    if !(barrier.at(free_m + cloth * n.dot(Vec3::from(fall_m))) > 0.0) {
        return [0.0; CONTACT_RECORD_FLOATS];
    }
    let ut = u - n * un;
    let mass = step_s * step_s * element.stiffness_n_m / stiffness_ratio;
    let slip = ut.length();
    let normal_n = if barrier.impact { barrier.force_n } else { push.max(0.0) };
    let drag = step_s * (element.friction * normal_n / slip.max(STICK_SPEED_M_S));
    let slides = at_end && slip > (u_start - n * n.dot(u_start)).length().max(STICK_SPEED_M_S);
    let beta = if slides { 0.0 } else { drag * (SHARING * drag / mass).min(1.0) };
    let g = n * (step_s * push) - ut * drag;
    let [w0, w1, w2, w3] = element.weights;
    [w0, w1, w2, w3, n.x, n.y, n.z, step_s * step_s * barrier.slope_n_m, beta, g.x, g.y, g.z]
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

    fn record_of(element: &ContactElement, v: [Vec3; 4]) -> [f32; CONTACT_RECORD_FLOATS] {
        record_at(false, element, v)
    }

    fn record_at(at_end: bool, element: &ContactElement, v: [Vec3; 4]) -> [f32; CONTACT_RECORD_FLOATS] {
        let flat: Vec<f32> = v.iter().flat_map(|v| v.to_array()).collect();
        let mut record = [f32::NAN; CONTACT_RECORD_FLOATS];
        let step = ContactStep { step_s: DT, stiffness_ratio: RATIO, at_end, fall_m: [0.0; 3], rows: 4 };
        contact(&CpuExecutor::new(1), &step, &[*element], &flat, &flat, &mut record);
        record
    }

    const DT: f32 = 1.0 / 256.0;
    const RATIO: f32 = 8.0;

    #[test]
    fn force_is_the_negative_gradient_of_the_energy_and_alpha_its_second_derivative() {
        let (x, element) = resting(0.006);
        let record = record_of(&element, [Vec3::ZERO; 4]);
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
                assert!((force + slope).abs() < 1e-3 * 1.333, "corner {a} axis {axis}: {force} {slope}");
            }
            let second = (energy(a, 2, h) + energy(a, 2, -h) - 2.0 * energy(a, 2, 0.0)) / f64::from(h * h);
            let jacobian = f64::from(element.weights[a] * element.weights[a] * record[7] / (DT * DT));
            assert!((second - jacobian).abs() < 2e-3 * 555.6, "corner {a}: {jacobian} {second}");
        }
        assert!((record[11] - DT * 2.0 * 0.4 / 0.6).abs() < 1e-6, "k h (h - d) / d = 200 * 0.01 * 0.004 / 0.006");
    }

    #[test]
    fn impulses_of_free_bodies_balance() {
        let (_, element) = resting(0.003);
        let v = [Vec3::new(0.3, -0.2, -0.1), Vec3::X * 0.1, Vec3::Y * -0.4, Vec3::new(0.0, 0.2, 0.05)];
        let record = record_of(&element, v);
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
        let at = |element: &ContactElement, speed: f32| {
            record_of(element, [Vec3::Z * speed, Vec3::ZERO, Vec3::ZERO, Vec3::ZERO])
        };
        assert_eq!(at(&apart, 0.0), [0.0; CONTACT_RECORD_FLOATS]);
        // 0.1 mm out of reach: within it at the end of the step from 25.6 mm/s on.
        assert_eq!(at(&apart, -0.0255), [0.0; CONTACT_RECORD_FLOATS]);
        assert!(at(&apart, -0.0257)[11] > 0.0);
        // 6 of 10 mm apart: the tangent of the barrier, 6 * 4 / 10 mm long, is left from 0.614 m/s on.
        let (_, deep) = resting(0.006);
        assert!(at(&deep, 0.61)[11] > 0.0);
        assert_eq!(at(&deep, 0.62), [0.0; CONTACT_RECORD_FLOATS]);
    }

    /// Stepped with first solves alone. Never through, whatever its speed; from a depth not faster out than a quarter
    /// of the thickness in a step.
    #[test]
    fn repulsion_stops_and_does_not_throw() {
        let (_, element) = resting(0.001);
        let mass = element.stiffness_n_m * DT * DT / RATIO;
        for (gap, speed) in [(0.001f32, -3.0f32), (0.001, 0.0), (0.003, -0.1), (0.02, -6.0), (0.0101, -300.0)] {
            let (mut gap, mut v) = (gap, speed);
            for step in 0..100 {
                let at = ContactElement { vertices: [0, NO_VERTEX, NO_VERTEX, NO_VERTEX], distance_m: gap, ..element };
                let record = record_of(&at, [Vec3::Z * v; 4]);
                v += record[11] / (mass + record[7]);
                gap += DT * v;
                assert!(gap > 0.0 && v <= 0.26 * 0.01 / DT, "from {speed} m/s, step {step}: {gap} m, {v} m/s");
            }
            assert!(gap > 0.0099, "{gap} m after 100 steps");
        }
    }

    /// A load that presses m a on it, steadily, of any size: the gap is that of the barrier, and nothing moves.
    #[test]
    fn every_load_is_carried() {
        let (_, element) = resting(0.0099);
        let mass = element.stiffness_n_m * DT * DT / RATIO;
        for load in [10.0f32, 1e3, 1e4] {
            let (mut gap, mut v) = (0.0099f32, 0.0f32);
            for step in 0..200 {
                let at = ContactElement { vertices: [0, NO_VERTEX, NO_VERTEX, NO_VERTEX], distance_m: gap, ..element };
                let before = v;
                let record = record_of(&at, [Vec3::Z * v; 4]);
                let first = v + (record[11] - DT * mass * load) / (mass + record[7]);
                let again = record_at(true, &at, [Vec3::Z * first; 4]);
                v = first + (again[11] - DT * mass * load - mass * (first - before)) / (mass + again[7]);
                gap += DT * v;
                assert!(gap > 0.0, "load {load}, step {step}: {gap} m");
            }
            let expected = 0.01 / (1.0 + mass * load / (200.0 * 0.01));
            assert!((gap / expected - 1.0).abs() < 1e-3 && v.abs() < 1e-5, "load {load}: {gap} m, not {expected}, {v}");
        }
    }

    /// Sliding steadily under its weight, the normal force is the weight; an impact has the force that stops it.
    #[test]
    fn friction_is_that_of_the_normal_force() {
        let (_, element) = resting(0.0098);
        let fixed = ContactElement { vertices: [0, NO_VERTEX, NO_VERTEX, NO_VERTEX], ..element };
        let weight = 200.0 * 0.01 * 0.02 / 0.98;
        for at_end in [false, true] {
            for speed in [0.05f32, 1.0, 10.0] {
                let record = record_at(at_end, &fixed, [Vec3::X * speed; 4]);
                assert!((record[9] + 0.5 * weight * DT).abs() < 1e-4 * weight * DT, "{} at {speed} m/s", record[9]);
            }
        }
        let mass = 200.0 * DT * DT / RATIO;
        let far = ContactElement { distance_m: 0.011, ..fixed };
        let record = record_of(&far, [Vec3::new(10.0, 0.0, -20.0); 4]);
        let stops = mass * 20.0;
        assert!(-record[9] > 0.5 * 0.8 * stops && -record[9] < 0.5 * stops, "{} of {stops}", record[9]);
    }

    /// A point on a plane: (m + beta) dv = g along the plane, m down to the mass that the stiffness is made for.
    #[test]
    fn friction_slows_down_and_never_turns_around() {
        let (_, element) = resting(0.006);
        let fixed = ContactElement { vertices: [0, NO_VERTEX, NO_VERTEX, NO_VERTEX], ..element };
        let least = element.stiffness_n_m * DT * DT / RATIO;
        for mass in [least, 10.0 * least, 1.0] {
            for speed in [1e-6f32, 1e-4, 1e-2, 0.1, 1.0, 10.0, 100.0] {
                let record = record_of(&fixed, [Vec3::X * speed; 4]);
                // One contact, or several that act on the same point.
                for contacts in [1.0, 3.0, 20.0] {
                    let after = speed + contacts * record[9] / (mass + contacts * record[8]);
                    assert!(after >= -1e-5 * speed && after < speed, "{mass} kg at {speed} m/s: {after} m/s");
                }
                // At most Coulomb's impulse, mu k h (h - d) / d dt = 2/3 dt; all of it where the point slides.
                let coulomb = 0.5 * 2.0 * 0.4 / 0.6 * DT;
                assert!(-record[9] <= coulomb * 1.0001);
                assert!(speed < STICK_SPEED_M_S || (record[9] + coulomb).abs() < 1e-5 * DT);
            }
        }
        let smooth = ContactElement { friction: 0.0, ..fixed };
        assert_eq!(record_of(&smooth, [Vec3::X; 4])[8..11], [0.0; 3]);
    }
}
