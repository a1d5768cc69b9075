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
    if !(depth > 0.0 && predicted > 0.0) {
        return [0.0; CONTACT_RECORD_FLOATS];
    }
    let ut = u - n * un;
    let friction = element.friction * (k * depth.min(predicted));
    let beta = step_s * (friction / ut.length().max(STICK_SPEED_M_S));
    let g = n * (step_s * k * predicted) - ut * beta;
    let [w0, w1, w2, w3] = element.weights;
    [w0, w1, w2, w3, n.x, n.y, n.z, step_s * step_s * k, beta, g.x, g.y, g.z]
}
