//! Vector kernels of PCG: start, dot product, fused update. Sums come back per chunk; `reduction` adds them.

use super::vector_cpu;
use crate::gpu::{DeviceVec, Executor};

/// The vector kernels on one executor, for a fixed number of own rows.
pub struct VectorOps {
    chunk_rows: usize,
    chunks: usize,
}

impl VectorOps {
    /// Kernels for `rows` own rows in chunks of `chunk_rows`.
    pub fn new(_executor: &Executor, rows: usize, chunk_rows: usize) -> VectorOps {
        VectorOps { chunk_rows, chunks: rows.div_ceil(chunk_rows) }
    }

    /// Number of own chunks.
    pub fn chunks(&self) -> usize {
        self.chunks
    }

    /// w . u per chunk; `u_start` = first value of u that belongs to the own rows.
    pub fn dot(&self, executor: &Executor, w: &DeviceVec<f32>, u: &DeviceVec<f32>, u_start: usize, sums: &mut Vec<f64>) {
        sums.resize(self.chunks, 0.0);
        match executor {
            Executor::Cpu(cpu) => vector_cpu::dot(cpu, self.chunk_rows, w.as_slice(), &u.as_slice()[u_start..u_start + w.len()], sums),
        }
    }

    /// r = b - w (0 on pinned rows), u = inverse_diagonal * r; sums (r . u, r . r) per chunk.
    pub fn start(&self, executor: &Executor, b: &DeviceVec<f32>, w: &DeviceVec<f32>, inverse_diagonal: &DeviceVec<f32>, r: &mut DeviceVec<f32>, u: &mut DeviceVec<f32>, u_start: usize, sums: &mut Vec<[f64; 2]>) {
        sums.resize(self.chunks, [0.0; 2]);
        match executor {
            Executor::Cpu(cpu) => {
                let own = u_start..u_start + b.len();
                vector_cpu::start(cpu, self.chunk_rows, b.as_slice(), w.as_slice(), inverse_diagonal.as_slice(), r.as_mut_slice(), &mut u.as_mut_slice()[own], sums)
            }
        }
    }

    /// p = u + beta p; s = w + beta s; x += alpha p; r -= alpha s; u = inverse_diagonal * r; sums (r . u, r . r) per chunk.
    pub fn update(&self, executor: &Executor, alpha: f32, beta: f32, w: &DeviceVec<f32>, inverse_diagonal: &DeviceVec<f32>, u: &mut DeviceVec<f32>, u_start: usize, p: &mut DeviceVec<f32>, s: &mut DeviceVec<f32>, x: &mut DeviceVec<f32>, r: &mut DeviceVec<f32>, sums: &mut Vec<[f64; 2]>) {
        sums.resize(self.chunks, [0.0; 2]);
        match executor {
            Executor::Cpu(cpu) => {
                let own = u_start..u_start + w.len();
                vector_cpu::update(cpu, self.chunk_rows, alpha, beta, w.as_slice(), inverse_diagonal.as_slice(), &mut u.as_mut_slice()[own], p.as_mut_slice(), s.as_mut_slice(), x.as_mut_slice(), r.as_mut_slice(), sums)
            }
        }
    }
}
