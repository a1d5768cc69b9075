//! The matrix of a file as an operator in double precision.

use super::precondition::inverse_block;
use super::rank_system::RankSystem;
use super::residual::subtract_product;
use crate::assembly::sell::BLOCK;
use crate::gpu::CpuExecutor;
use crate::math::DIM;
use crate::solver::DoubleOperator;

/// A rank's rows in scaled units: divided by `matrix_scale`.
pub(super) struct DoubleSystem<'a> {
    system: &'a RankSystem,
    cpu: CpuExecutor,
    inverse_diagonal: Vec<[f64; 6]>,
    diagonal: Vec<f64>,
}

impl<'a> DoubleSystem<'a> {
    pub(super) fn new(system: &'a RankSystem, threads: usize) -> DoubleSystem<'a> {
        let (arrays, own) = (&system.arrays, &system.plan.own);
        let scale = system.matrix_scale.recip();
        let blocks = (0..own.len()).map(|row| {
            let mut of_row = arrays.offsets[row] as usize..arrays.offsets[row + 1] as usize;
            let k = of_row.find(|&k| arrays.columns[k] as usize == own.start + row);
            let k = k.unwrap_or_else(|| panic!("row {row} has a diagonal block"));
            std::array::from_fn(|c| arrays.values.get(k * BLOCK + c) * scale)
        });
        let blocks: Vec<[f64; BLOCK]> = blocks.collect();
        DoubleSystem {
            system,
            cpu: CpuExecutor::new(threads),
            inverse_diagonal: blocks.iter().map(inverse_block).collect(),
            diagonal: blocks.iter().flat_map(|block| [block[0], block[4], block[8]]).collect(),
        }
    }
}

impl DoubleOperator for DoubleSystem<'_> {
    fn multiply(&self, x: &[f64], y: &mut [f64]) {
        debug_assert_eq!(y.len(), self.system.plan.own.len() * DIM);
        y.fill(0.0);
        subtract_product(&self.cpu, self.system, -1.0, x, y);
    }

    fn inverse(&self, row: usize) -> [f64; 6] {
        self.inverse_diagonal[row]
    }

    fn diagonal(&self, value: usize) -> f64 {
        self.diagonal[value]
    }
}
