//! Kernel that updates velocities and positions of the own rows at the end of a step.

use super::advance_cpu;
use crate::gpu::{DeviceVec, Executor, KernelSource, gpu_struct};

static ADVANCE: KernelSource =
    KernelSource::new::<AdvanceParams>("integrator/advance.wgsl", include_str!("advance.wgsl"), "advance");

gpu_struct! {
    struct AdvanceParams { rows: u32, first: u32, step_s: f32 }
}

/// The kernel on one executor.
pub struct Advance {}

impl Advance {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Advance {
        Advance {}
    }

    /// v += dv, x += dt v for the own rows, which begin at value `own_start` of the local vectors.
    pub fn advance(
        &self,
        executor: &Executor,
        step_s: f32,
        dv: &DeviceVec<f32>,
        own_start: usize,
        velocities: &mut DeviceVec<f32>,
        positions: &mut DeviceVec<f32>,
    ) {
        let own = own_start..own_start + dv.len();
        match executor {
            Executor::Cpu(cpu) => advance_cpu::advance(
                cpu,
                step_s,
                dv.as_slice(),
                &mut velocities.as_mut_slice()[own.clone()],
                &mut positions.as_mut_slice()[own],
            ),
            Executor::Gpu(gpu) => {
                let params = AdvanceParams { rows: (dv.len() / 3) as u32, first: (own_start / 3) as u32, step_s };
                gpu.run(
                    &ADVANCE,
                    &[dv.binding(), velocities.binding_mut(), positions.binding_mut()],
                    &params,
                    (dv.len() / 3) as u64,
                );
            }
        }
    }
}
