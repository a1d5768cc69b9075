//! Sparse matrix-vector product of one section of a rank's rows [Bell and Garland 2008; Li et al. 2020, Sec. 3.2.2].
//! Knows nothing of ranks: `pipelined` decides which section is multiplied when.

use super::spmv_cpu;
use crate::assembly::SellMatrix;
use crate::gpu::{DeviceVec, Executor};

/// The SpMV kernel on one executor.
pub struct Spmv {}

impl Spmv {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Spmv {
        Spmv {}
    }

    /// y = A x, or y += A x with `accumulate`, for the rows of `section`. x: xyz per column; y: xyz per own row.
    pub fn apply(&self, executor: &Executor, matrix: &SellMatrix, section: usize, accumulate: bool, x: &DeviceVec<f32>, y: &mut DeviceVec<f32>) {
        match executor {
            Executor::Cpu(_) => self.apply_host(executor, matrix, section, accumulate, x.as_slice(), y),
        }
    }

    /// As [`Spmv::apply`] with x in host memory, for example a sub-vector in a received message: the cpu executor reads it
    /// in place, a device uploads it.
    pub fn apply_host(&self, executor: &Executor, matrix: &SellMatrix, section: usize, accumulate: bool, x: &[f32], y: &mut DeviceVec<f32>) {
        assert_eq!(y.len(), matrix.rows * 3);
        match executor {
            Executor::Cpu(cpu) => spmv_cpu::spmv(cpu, matrix.sections[section].clone(), accumulate, matrix.row_of_lane.as_slice(), matrix.slice_offsets.as_slice(), matrix.columns.as_slice(), matrix.values.as_slice(), x, y.as_mut_slice()),
        }
    }
}
