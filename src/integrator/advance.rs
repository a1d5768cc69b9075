//! Advances the own rows by a solved step and sets prescribed rows.

use super::advance_cpu;
use crate::gpu::{DeviceVec, Executor};

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
        }
    }

    /// Sets own rows `rows` of `out` (own rows begin at value `first`) to `values`.
    pub fn scatter(&self, executor: &Executor, rows: &[u32], values: &[[f32; 3]], first: usize, out: &mut DeviceVec<f32>) {
        match executor {
            Executor::Cpu(_) => advance_cpu::scatter(rows, values, first, out.as_mut_slice()),
        }
    }
}
