//! Advances the own rows by a solved step and sets prescribed rows.

use super::advance_cpu;
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource, gpu_struct};

const TEXT: &str = include_str!("advance.wgsl");
static ADVANCE: KernelSource = KernelSource::new::<AdvanceParams>("integrator/advance.wgsl", TEXT, "advance");
static SCATTER: KernelSource = KernelSource::new::<ScatterParams>("integrator/advance.wgsl", TEXT, "scatter")
    .with_structs(&[ScatterEntry::LAYOUT]);

gpu_struct! {
    struct AdvanceParams { rows: u32, first: u32, step_s: f32 }
}
gpu_struct! {
    struct ScatterParams { count: u32, first: u32 }
}
gpu_struct! {
    struct ScatterEntry { row: u32, value: [f32; 3] }
}

/// The integrator's kernels on one executor.
pub struct Advance {}

impl Advance {
    /// Prepares the kernels.
    pub fn new(_executor: &Executor) -> Advance {
        Advance {}
    }

    /// v += dv, x += dt v for the own rows, which begin at value `own_start` of the local vectors.
    pub fn advance(&self, executor: &Executor, step_s: f32, dv: &DeviceVec<f32>, own_start: usize, velocities: &mut DeviceVec<f32>, positions: &mut DeviceVec<f32>) {
        let own = own_start..own_start + dv.len();
        match executor {
            Executor::Cpu(cpu) => advance_cpu::advance(cpu, step_s, dv.as_slice(), &mut velocities.as_mut_slice()[own.clone()], &mut positions.as_mut_slice()[own]),
            Executor::Gpu(gpu) => {
                let params = AdvanceParams { rows: (dv.len() / 3) as u32, first: (own_start / 3) as u32, step_s };
                gpu.run(&ADVANCE, &[dv.binding(), velocities.binding_mut(), positions.binding_mut()], &params, (dv.len() / 3) as u64);
            }
        }
    }

    /// Sets own rows `rows` of `out` (own rows begin at value `first`) to `values`.
    pub fn scatter(&self, executor: &Executor, rows: &[u32], values: &[[f32; 3]], first: usize, out: &mut DeviceVec<f32>) {
        match executor {
            Executor::Cpu(_) => advance_cpu::scatter(rows, values, first, out.as_mut_slice()),
            Executor::Gpu(gpu) => {
                let entries: Vec<ScatterEntry> = rows.iter().zip(values).map(|(&row, &value)| ScatterEntry { row, value }).collect();
                let entries = DeviceVec::upload(executor, &entries);
                let params = ScatterParams { count: rows.len() as u32, first: (first / 3) as u32 };
                gpu.run(&SCATTER, &[entries.binding(), out.binding_mut()], &params, rows.len() as u64);
            }
        }
    }
}
