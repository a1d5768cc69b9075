//! Bending elements [Wang et al. 2011; Bridson et al. 2003]: positions and velocities -> hinge records.
//!
//! A record is rank one, 64 bytes instead of 624:
//! ```text
//! [0..4) g_0, h*k    [4..8) g_1, moment    [8..12) g_2, 0    [12..16) g_3, 0
//! ```
//! g = gradient of the dihedral angle, k = torsion stiffness, h = dt^2 + dt*damping; the moment holds the dt K v and damping
//! terms. Force on corner a: -moment * g_a; block (a, b): h*k * g_a g_b^T.

use super::bend_cpu;
use super::element::{FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams};
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource};

static BEND: KernelSource = KernelSource::new::<StepParams>("forces/bend.wgsl", include_str!("bend.wgsl"), "bend")
    .with_libraries(&[include_str!("element.wgsl")])
    .with_structs(&[FabricTable::LAYOUT, HingeElement::LAYOUT]);

/// The bending kernel on one executor.
pub struct Bend {}

impl Bend {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Bend {
        Bend {}
    }

    /// Fills `records` from the state of the first `params.count` of `elements`; further ones have records of their own
    /// (`fiber`). `positions`, `velocities`: xyz of every local vertex.
    #[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
    pub fn apply(
        &self,
        executor: &Executor,
        params: &StepParams,
        fabrics: &DeviceVec<FabricTable>,
        elements: &DeviceVec<HingeElement>,
        positions: &DeviceVec<f32>,
        velocities: &DeviceVec<f32>,
        records: &mut DeviceVec<f32>,
    ) {
        assert_eq!(records.len(), elements.len() * HINGE_RECORD_FLOATS);
        let hinges = params.count as usize;
        match executor {
            Executor::Cpu(cpu) => bend_cpu::bend(
                cpu,
                params,
                fabrics.as_slice(),
                &elements.as_slice()[..hinges],
                positions.as_slice(),
                velocities.as_slice(),
                &mut records.as_mut_slice()[..hinges * HINGE_RECORD_FLOATS],
            ),
            Executor::Gpu(gpu) => {
                for window in gpu.windows(hinges, HINGE_RECORD_FLOATS * 4) {
                    let (first, count) = (window.start, window.len());
                    let bindings = [
                        fabrics.binding(),
                        elements.window(first, count),
                        positions.binding(),
                        velocities.binding(),
                        records.window_mut(first * HINGE_RECORD_FLOATS, count * HINGE_RECORD_FLOATS),
                    ];
                    gpu.run(&BEND, &bindings, &StepParams { count: count as u32, ..*params }, count as u64);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shader_and_structs_agree() {
        BEND.check().unwrap();
    }
}
