//! The residual b - A x in double precision, from the matrix values of the file. It decides whether the f32 solve has
//! converged.
//!
//! x is stored as a pair of f32 (48 bits), so that a halo row has the same bits on every rank that reads it. The
//! residual is computed on the host for every executor of the solve.

use super::rank_system::RankSystem;
use super::system::Values;
use crate::assembly::sell::BLOCK;
use crate::gpu::{CpuExecutor, DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::math::DIM;
use crate::solver::{HaloExchange, ReductionTree, TrafficCounter};
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Transport, TransportError};

/// The solution on one rank's rows and the buffers that its residual needs. All values are scaled: the matrix is
/// divided by `matrix_scale`, the right-hand side by `rhs_scale`.
pub(super) struct Residual<'a> {
    system: &'a RankSystem,
    cpu: CpuExecutor,
    host: Executor,
    halo: HaloExchange,
    high: DeviceVec<f32>,
    low: DeviceVec<f32>,
    x: Vec<f64>,
    /// The halves of the best x so far.
    best: (Vec<f32>, Vec<f32>),
    tree: ReductionTree,
    /// b - A x of the own rows.
    pub(super) r: Vec<f64>,
    /// Bytes received by halo exchanges of residuals.
    pub(super) traffic: TrafficCounter,
}

impl<'a> Residual<'a> {
    /// Starts with x = 0, r = b.
    pub(super) fn new(system: &'a RankSystem, queue: Vec<QueueNode>, threads: usize) -> Residual<'a> {
        let host = Executor::cpu(1);
        let len = system.plan.local_rows * DIM;
        let mut residual = Residual {
            halo: HaloExchange::new(system.plan.clone(), queue),
            high: DeviceVec::zeros(&host, len),
            low: DeviceVec::zeros(&host, len),
            x: vec![0.0; len],
            best: Default::default(),
            tree: ReductionTree::new(&system.partition),
            r: Vec::new(),
            traffic: TrafficCounter::default(),
            cpu: CpuExecutor::new(threads),
            system,
            host,
        };
        residual.reset();
        residual
    }

    /// Sets x = 0, r = b.
    pub(super) fn reset(&mut self) {
        let scale = self.system.rhs_scale.recip();
        self.r.clear();
        self.r.extend(self.system.arrays.rhs.iter().map(|b| b * scale));
        self.high.fill_zero(&self.host);
        self.low.fill_zero(&self.host);
        self.keep();
        self.traffic = TrafficCounter::default();
    }

    /// Marks x as the best so far.
    pub(super) fn keep(&mut self) {
        self.best = (self.high.as_slice().to_vec(), self.low.as_slice().to_vec());
    }

    /// Goes back to the best x. The residual is out of date until [`Residual::update`].
    pub(super) fn restore(&mut self) {
        self.high.as_mut_slice().copy_from_slice(&self.best.0);
        self.low.as_mut_slice().copy_from_slice(&self.best.1);
    }

    /// Adds scale * d to x on the own rows.
    pub(super) fn add<T: Copy + Into<f64>>(&mut self, scale: f64, d: &[T]) {
        let own = self.system.plan.own.start * DIM..self.system.plan.own.end * DIM;
        let (high, low) = (&mut self.high.as_mut_slice()[own.clone()], &mut self.low.as_mut_slice()[own]);
        for ((high, low), d) in high.iter_mut().zip(low).zip(d) {
            let x = *high as f64 + *low as f64 + scale * (*d).into();
            *high = x as f32;
            *low = (x - *high as f64) as f32;
        }
    }

    /// Sets r = b - A x; all ranks must call it together.
    pub(super) fn update(
        &mut self,
        transport: &mut dyn Transport,
        recorder: &mut Recorder,
    ) -> Result<(), TransportError> {
        self.halo.start(&self.host, transport, &[&self.high, &self.low], recorder)?;
        let halves = &mut [&mut self.high, &mut self.low];
        self.halo.finish(&self.host, transport, halves, recorder, &mut self.traffic)?;
        let start = recorder.now();
        for (x, (high, low)) in self.x.iter_mut().zip(self.high.as_slice().iter().zip(self.low.as_slice())) {
            *x = *high as f64 + *low as f64;
        }
        let scale = self.system.rhs_scale.recip();
        for (r, b) in self.r.iter_mut().zip(&self.system.arrays.rhs) {
            *r = b * scale;
        }
        let arrays = &self.system.arrays;
        subtract_product(&self.cpu, self.system, 1.0, &self.x, &mut self.r);
        let blocks = arrays.columns.len() as u64;
        let block_bytes = match &arrays.values {
            Values::F32(_) => 4 * BLOCK as u64 + 4,
            Values::F64(_) => 8 * BLOCK as u64 + 4,
        };
        let vectors = size_of_val(&self.x[..]) + 2 * size_of_val(&self.r[..]);
        let bytes = blocks * block_bytes + vectors as u64;
        recorder.end(EventName::Residual, Activity::Compute, start, bytes, blocks * 2 * BLOCK as u64);
        Ok(())
    }

    /// 2-norm of r over all ranks. The result has the same bits for every number of ranks.
    pub(super) fn norm(&mut self, transport: &mut dyn Transport) -> Result<f64, TransportError> {
        let chunk = self.system.partition.chunk_rows() * DIM;
        let sums: Vec<[f64; 1]> = self.r.chunks(chunk).map(|r| [r.iter().map(|v| v * v).sum::<f64>()]).collect();
        Ok(self.tree.all_reduce(transport, &sums)?[0].sqrt())
    }

    /// x of the own rows, in scaled units.
    pub(super) fn solution(&self) -> Vec<f64> {
        let own = self.system.plan.own.start * DIM..self.system.plan.own.end * DIM;
        let halves = self.high.as_slice()[own.clone()].iter().zip(&self.low.as_slice()[own]);
        halves.map(|(high, low)| *high as f64 + *low as f64).collect()
    }
}

/// Subtracts `factor` * A x from r, with A in scaled units.
pub(super) fn subtract_product(cpu: &CpuExecutor, system: &RankSystem, factor: f64, x: &[f64], r: &mut [f64]) {
    let (arrays, scale) = (&system.arrays, factor * system.matrix_scale.recip());
    match &arrays.values {
        Values::F32(values) => subtract(cpu, &arrays.offsets, &arrays.columns, values, scale, x, r),
        Values::F64(values) => subtract(cpu, &arrays.offsets, &arrays.columns, values, scale, x, r),
    }
}

/// Subtracts scale * A x from r; each row is summed in ascending column order. A block reads 36 or 72 bytes of values
/// and 4 bytes of columns.
fn subtract<T: Copy + Into<f64> + Sync>(
    cpu: &CpuExecutor,
    offsets: &[u32],
    columns: &[u32],
    values: &[T],
    scale: f64,
    x: &[f64],
    r: &mut [f64],
) {
    let blocks = values.as_chunks::<BLOCK>().0;
    let x = x.as_chunks::<DIM>().0;
    cpu.for_ranges_mut(r, DIM, 64, |rows, r| {
        for (row, r) in rows.zip(r.as_chunks_mut::<DIM>().0) {
            let mut sum = [0.0f64; DIM];
            let range = offsets[row] as usize..offsets[row + 1] as usize;
            for (block, &column) in blocks[range.clone()].iter().zip(&columns[range]) {
                let x = &x[column as usize];
                for i in 0..DIM {
                    for j in 0..DIM {
                        let a: f64 = block[i * DIM + j].into();
                        sum[i] += a * x[j];
                    }
                }
            }
            for i in 0..DIM {
                r[i] -= scale * sum[i];
            }
        }
    });
}
