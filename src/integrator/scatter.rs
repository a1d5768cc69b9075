//! Kernel that sets prescribed rows (pins) of a vector. The host uploads them in every step, because a cloth has few of
//! them.

use super::scatter_cpu;
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource, gpu_struct};

static SCATTER: KernelSource =
    KernelSource::new::<ScatterParams>("integrator/scatter.wgsl", include_str!("scatter.wgsl"), "scatter")
        .with_structs(&[ScatterEntry::LAYOUT]);

gpu_struct! {
    struct ScatterParams { count: u32, first: u32 }
}
gpu_struct! {
    struct ScatterEntry { row: u32, value: [f32; 3] }
}

/// The kernel on one executor.
pub struct Scatter {}

impl Scatter {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Scatter {
        Scatter {}
    }

    /// Sets own rows `rows` of `out` (own rows begin at value `first`) to `values`.
    pub fn apply(
        &self,
        executor: &Executor,
        rows: &[u32],
        values: &[[f32; 3]],
        first: usize,
        out: &mut DeviceVec<f32>,
    ) {
        match executor {
            Executor::Cpu(_) => scatter_cpu::scatter(rows, values, first, out.as_mut_slice()),
            Executor::Gpu(gpu) => {
                let entries: Vec<ScatterEntry> =
                    rows.iter().zip(values).map(|(&row, &value)| ScatterEntry { row, value }).collect();
                let entries = DeviceVec::upload(executor, &entries);
                let params = ScatterParams { count: rows.len() as u32, first: (first / 3) as u32 };
                gpu.run(&SCATTER, &[entries.binding(), out.binding_mut()], &params, rows.len() as u64);
            }
        }
    }
}
