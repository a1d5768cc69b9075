//! Threads of seams: a spring with a damper between two vertices, whose length at rest shrinks until they meet.
//!
//! A thread of length l = |x_a - x_b| at rest L pulls when it is longer and does not push:
//! ```text
//! F_a = -k (l - L) n - c (n.(v_a - v_b) - dL/dt) n    n = (x_a - x_b) / l    c = k tau
//! ```
//! with l taken to the end of the step, to first order. A slack thread that shortens faster than it should is held
//! back by its damper, so that the sides do not pass each other. The stiffness is k n n' and k (1 - L / l) across it,
//! which is positive semidefinite, and k in all directions once L is 0. Each of the three directions is a record like
//! that of a hinge (layout: `bend`) with the gradients d, -d, 0, 0, so matrix, right-hand side and preconditioner need
//! to know nothing of seams. k is the stiffness of the cloth on both sides times a firmness that grows with time.

use super::element::{HINGE_RECORD_FLOATS, HingeElement};
use super::stitch_cpu;
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource, gpu_struct};
use crate::scene::Closing;

/// Records of a thread, one per direction.
pub const RECORDS_STITCH: usize = 3;

/// tau: damping of a thread over its stiffness, seconds.
pub(super) const DAMPING_S: f32 = 0.002;

gpu_struct! {
    /// A thread between two vertices.
    pub struct StitchElement {
        /// Local vertex indices.
        pub vertices: [u32; 2],
        /// k at a firmness of 1, N/m.
        pub stiffness_n_m: f32,
        /// Length at time 0, meters.
        pub first_m: f32,
    }
}

gpu_struct! {
    /// Uniform of the kernel.
    pub struct StitchParams {
        /// Step length, seconds.
        pub step_s: f32,
        /// As `StepParams::ahead_s`.
        pub ahead_s: f32,
        /// Number of threads.
        pub count: u32,
        /// Share of its way that a thread has closed at the end of the step, 0 to 1.
        pub closed: f32,
        /// Change of that share, 1/s.
        pub closing_1_s: f32,
        /// Length at rest of a closed thread, meters; shorter ones do not shrink.
        pub last_m: f32,
        /// tau, seconds.
        pub damping_s: f32,
        /// Factor on the stiffness.
        pub firmness: f32,
    }
}

static STITCH: KernelSource =
    KernelSource::new::<StitchParams>("forces/stitch.wgsl", include_str!("stitch.wgsl"), "stitch")
        .with_libraries(&[include_str!("element.wgsl")])
        .with_structs(&[StitchElement::LAYOUT]);

impl StitchElement {
    /// The places of the thread's records in the list of hinges: hinges without stiffness of their own.
    pub fn hinges(&self) -> [HingeElement; RECORDS_STITCH] {
        let [a, b] = self.vertices;
        let place = HingeElement {
            vertices: [a, b, a, b],
            shape: 0.0,
            curvature_from_angle: 0.0,
            rest_angle: 0.0,
            plastic_curvature: 0.0,
            bias: [0.0; 2],
            fabric: [0; 2],
        };
        [place; RECORDS_STITCH]
    }
}

impl StitchParams {
    /// For a step of `step_s` that ends at `end_s`.
    pub fn new(step_s: f32, ahead_s: f32, closing: &Closing, end_s: f64) -> StitchParams {
        StitchParams {
            step_s,
            ahead_s,
            count: 0,
            closed: closing.share(end_s) as f32,
            closing_1_s: closing.share_rate(end_s) as f32,
            last_m: closing.last_m as f32,
            damping_s: DAMPING_S,
            firmness: closing.firmness(end_s) as f32,
        }
    }
}

/// Fills the records of the threads: those of `records` from `first` on, on a device a multiple of
/// [`crate::gpu::WINDOW_STEP`]. `positions`, `velocities`: xyz of every local vertex.
pub fn apply(
    executor: &Executor,
    params: &StitchParams,
    elements: &DeviceVec<StitchElement>,
    positions: &DeviceVec<f32>,
    velocities: &DeviceVec<f32>,
    first: usize,
    records: &mut DeviceVec<f32>,
) {
    assert_eq!(records.len(), (first + elements.len() * RECORDS_STITCH) * HINGE_RECORD_FLOATS);
    match executor {
        Executor::Cpu(cpu) => stitch_cpu::stitch(
            cpu,
            params,
            elements.as_slice(),
            positions.as_slice(),
            velocities.as_slice(),
            &mut records.as_mut_slice()[first * HINGE_RECORD_FLOATS..],
        ),
        Executor::Gpu(gpu) => {
            const FLOATS: usize = RECORDS_STITCH * HINGE_RECORD_FLOATS;
            for window in gpu.windows(elements.len(), FLOATS * 4) {
                let (start, count) = (window.start, window.len());
                let bindings = [
                    elements.window(start, count),
                    positions.binding(),
                    velocities.binding(),
                    records.window_mut(first * HINGE_RECORD_FLOATS + start * FLOATS, count * FLOATS),
                ];
                gpu.run(&STITCH, &bindings, &StitchParams { count: count as u32, ..*params }, count as u64);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shader_and_structs_agree() {
        STITCH.check().unwrap();
    }
}
