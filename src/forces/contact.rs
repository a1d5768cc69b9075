//! Contact elements: repulsion and Coulomb friction as implicit forces; element and velocities -> contact record.
//!
//! With u = sum(w_a v_a) the relative velocity at the start of the step (obstacles: that of the coming step), n the
//! normal, d the gap along n of the weighted points, h the thickness, k the stiffness: the force k h (h - d) / d of a
//! barrier, linearized (`contact_cpu.rs`). A record is 12 floats, 48 bytes:
//! ```text
//! [0..4) weights w    [4..7) normal n    [7] alpha    [8] beta    [9..12) g
//! ```
//! Block of corners (a, b): w_a w_b (alpha n n' + beta (I - n n')); right-hand side of corner a: w_a g. An element that
//! would not push has a record of zeros.

use super::contact_cpu;
use super::contact_element::ContactElement;
use super::element::CONTACT_RECORD_FLOATS;
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource, gpu_struct};

static CONTACT: KernelSource =
    KernelSource::new::<ContactParams>("forces/contact.wgsl", include_str!("contact.wgsl"), "contact")
        .with_structs(&[ContactElement::LAYOUT]);

gpu_struct! {
    struct ContactParams {
        fall_m: [f32; 3],
        step_s: f32,
        count: u32,
        stiffness_ratio: f32,
        at_end: u32,
        rows: u32,
    }
}

/// What contact records are made for.
#[derive(Clone, Copy, Debug)]
pub struct ContactStep {
    /// Length of the step.
    pub step_s: f32,
    /// The elements' stiffness over effective mass / step^2.
    pub stiffness_ratio: f32,
    /// Whether velocities are a guess of those at the end of the step rather than those of its start.
    pub at_end: bool,
    /// How far cloth falls in the step from what its velocities say; zero with a guess of the end.
    pub fall_m: [f32; 3],
    /// Local vertices that are cloth; obstacles follow.
    pub rows: u32,
}

/// The contact kernel on one executor.
pub struct Contact {}

impl Contact {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Contact {
        Contact {}
    }

    /// Fills `records`. `start_velocities`: those at the start of the step, which without `step.at_end` are
    /// `velocities`, too. Velocities: xyz of every local vertex.
    pub fn apply(
        &self,
        executor: &Executor,
        step: &ContactStep,
        elements: &DeviceVec<ContactElement>,
        velocities: &DeviceVec<f32>,
        start_velocities: &DeviceVec<f32>,
        records: &mut DeviceVec<f32>,
    ) {
        assert_eq!(records.len(), elements.len() * CONTACT_RECORD_FLOATS);
        match executor {
            Executor::Cpu(cpu) => contact_cpu::contact(
                cpu,
                step,
                elements.as_slice(),
                velocities.as_slice(),
                start_velocities.as_slice(),
                records.as_mut_slice(),
            ),
            Executor::Gpu(gpu) => {
                for window in gpu.windows(elements.len(), size_of::<ContactElement>()) {
                    let (first, count) = (window.start, window.len());
                    let bindings = [
                        elements.window(first, count),
                        velocities.binding(),
                        start_velocities.binding(),
                        records.window_mut(first * CONTACT_RECORD_FLOATS, count * CONTACT_RECORD_FLOATS),
                    ];
                    let &ContactStep { step_s, stiffness_ratio, at_end, fall_m, rows } = step;
                    let (count, at_end) = (count as u32, u32::from(at_end));
                    let params = ContactParams { fall_m, step_s, count, stiffness_ratio, at_end, rows };
                    gpu.run(&CONTACT, &bindings, &params, count as u64);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::forces::NO_VERTEX;
    use crate::test_support::device;
    use crate::test_support::seeded::Seeded;

    #[test]
    fn shader_and_structs_agree() {
        CONTACT.check().unwrap();
    }

    #[test]
    fn device_equals_the_native_twin() {
        let Some(gpu) = device::executor_binding(1 << 16) else { return };
        let mut seeded = Seeded::new(5);
        let vertices = 300;
        let velocities: Vec<f32> = (0..vertices * 3).map(|_| seeded.uniform(-0.5, 0.5)).collect();
        let starts: Vec<f32> = (0..vertices * 3).map(|_| seeded.uniform(-0.5, 0.5)).collect();
        // More than one window of elements.
        let elements: Vec<ContactElement> = (0..1500)
            .map(|i| {
                let z = seeded.uniform(-1.0, 1.0);
                let (s, c) = seeded.uniform(0.0, 6.0).sin_cos();
                let flat = (1.0 - z * z).sqrt();
                let mut vertices = [0; 4].map(|_| seeded.below(vertices));
                let mut weights = [1.0, -0.25, -0.5, -0.25];
                if i % 3 == 0 {
                    (vertices[3], weights) = (NO_VERTEX, [1.0, -0.75, -0.25, 0.0]);
                }
                ContactElement {
                    vertices,
                    weights,
                    normal: [flat * c, flat * s, z],
                    distance_m: seeded.uniform(0.0, 0.0012),
                    thickness_m: 0.001,
                    stiffness_n_m: 500.0,
                    friction: if i % 5 == 0 { 0.0 } else { 0.4 },
                    kind: 0,
                }
            })
            .collect();
        for at_end in [false, true] {
            let run = |executor: &Executor| {
                let (elements, velocities) =
                    (DeviceVec::upload(executor, &elements), DeviceVec::upload(executor, &velocities));
                let starts = DeviceVec::upload(executor, &starts);
                let mut records = DeviceVec::zeros(executor, elements.len() * CONTACT_RECORD_FLOATS);
                let fall_m = if at_end { [0.0; 3] } else { [0.0, 1e-5, -1.5e-4] };
                let step = ContactStep { step_s: 0.004, stiffness_ratio: 8.0, at_end, fall_m, rows: 200 };
                Contact::new(executor).apply(executor, &step, &elements, &velocities, &starts, &mut records);
                records.read(executor)
            };
            let (device, native) = (run(&gpu), run(&Executor::cpu(2)));
            assert_eq!(gpu.take_fault(), None);
            let rows = native.as_chunks::<CONTACT_RECORD_FLOATS>().0;
            let active = rows.iter().filter(|record| record[7] > 0.0).count();
            assert!(active > 300 && active < 1200, "{active} of 1500 repel");
            for (i, (device, native)) in device.as_chunks::<CONTACT_RECORD_FLOATS>().0.iter().zip(rows).enumerate() {
                let scale = native[8..].iter().fold(1e-6f32, |largest, v| largest.max(v.abs()));
                for (c, (d, n)) in device.iter().zip(native).enumerate() {
                    // alpha and the weights are products of two numbers, the others differences of some.
                    let size = if c < 8 { n.abs() } else { scale };
                    assert!((d - n).abs() <= 2e-5 * size, "record {i}[{c}]: {d} on the device, {n}");
                }
            }
        }
    }
}
