//! The two-level Schwarz preconditioner (`schwarz`) inside an iteration of PCG: u = S r + P z with the sweep S of the
//! chunks and the displacements z of the coarse level, in which (P' A P) z = P' r.
//!
//! P' r is never summed directly: it follows the recurrence of r from P' w, which the iteration's all-reduce carries.

use super::coarse::Coarse;
use super::colored::Colored;
use super::operator::{Operator, StoredMatrix};
use super::preconditioner::{IterationSums, Preconditioner};
use super::sweep::Sweeps;
use super::vector::{PcgVectors, Scalars, VectorOps};
use crate::context::RankContext;
use crate::gpu::{CpuExecutor, DeviceVec};
use crate::telemetry::{Activity, EventName};
use crate::transport::TransportError;

/// Sweeps along the rows of every chunk, on the native executor. The sweep also updates the vectors and computes
/// w = (L + D + U) u, the product with the blocks inside chunks.
pub(super) struct ChainSweep<'a> {
    pub cpu: &'a CpuExecutor,
    pub ops: &'a mut VectorOps,
    pub sweeps: &'a mut Sweeps,
    pub coarse: &'a mut Coarse,
    pub inverse_diagonal: &'a DeviceVec<f32>,
}

impl ChainSweep<'_> {
    /// u = S r + P z and w = (L + D + U) u, after the vector updates with `update` = (alpha, beta).
    pub(super) fn sweep(&mut self, update: Option<(f32, f32)>, v: &mut PcgVectors) {
        self.sweeps.sweep(self.cpu, &self.coarse.correction, update, self.inverse_diagonal, v);
    }
}

impl<'m> Preconditioner<StoredMatrix<'m>> for ChainSweep<'_> {
    fn start(
        &mut self,
        rank: &mut RankContext<'_>,
        sums: &mut IterationSums,
        b: &DeviceVec<f32>,
        v: &mut PcgVectors,
    ) -> Result<(), TransportError> {
        // r = b - w
        self.ops.start(rank.executor, b, &v.w, self.inverse_diagonal, &mut v.r, &mut v.u, v.own_start);
        // z from P' r
        let (scalars, restricted) = (&mut sums.scalars, &mut sums.restricted);
        self.sweeps.sums(self.cpu, &mut v.r, &v.u, v.own_start, scalars, restricted);
        sums.all_reduce(rank.transport)?;
        self.coarse.start(&sums.all_restricted);
        // u = S r + P z; w = (L + D + U) u; r.u, r.r
        self.sweep(None, v);
        Ok(())
    }

    fn product(
        &mut self,
        rank: &mut RankContext<'_>,
        operator: &mut StoredMatrix<'m>,
        sums: &mut IterationSums,
        v: &mut PcgVectors,
    ) -> Result<(), TransportError> {
        // w += R u with R the blocks between chunks
        operator.add_rest(rank, self.sweeps.outer(), &mut v.u, &mut v.w)?;
        // w.u, P' w
        let start = rank.recorder.before_kernels();
        let (scalars, restricted) = (&mut sums.scalars, &mut sums.restricted);
        self.sweeps.sums(self.cpu, &mut v.w, &v.u, v.own_start, scalars, restricted);
        let (bytes, flops) = (v.w.bytes() * 2, v.w.len() as u64 * 3);
        rank.recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, flops);
        Ok(())
    }

    fn advance(
        &mut self,
        rank: &mut RankContext<'_>,
        Scalars { alpha, beta }: Scalars,
        sums: &IterationSums,
        v: &mut PcgVectors,
    ) {
        let start = rank.recorder.before_kernels();
        // P' s = P' w + beta P' s; P' r -= alpha P' s; z
        self.coarse.update(&sums.all_restricted, alpha, beta);
        // p = u + beta p; s = w + beta s; x += alpha p; r -= alpha s; u = S r + P z; w = (L + D + U) u; r.u, r.r
        self.sweep(Some((alpha as f32, beta as f32)), v);
        let (bytes, flops) = (self.sweeps.sweep_bytes(), self.sweeps.sweep_flops());
        rank.recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, flops);
    }
}

/// Sweeps by color, one workgroup per chunk.
pub(super) struct ColoredSweep<'a> {
    pub ops: &'a mut VectorOps,
    pub colored: &'a mut Colored,
    pub coarse: &'a mut Coarse,
    pub inverse_diagonal: &'a DeviceVec<f32>,
}

impl<A: Operator> Preconditioner<A> for ColoredSweep<'_> {
    fn start(
        &mut self,
        rank: &mut RankContext<'_>,
        sums: &mut IterationSums,
        b: &DeviceVec<f32>,
        v: &mut PcgVectors,
    ) -> Result<(), TransportError> {
        let (executor, inverse) = (rank.executor, self.inverse_diagonal);
        // r = b - w
        self.ops.start(executor, b, &v.w, inverse, &mut v.r, &mut v.u, v.own_start);
        // z from P' r
        self.colored.sums(executor, inverse, &mut v.r, &v.u, &mut sums.scalars, &mut sums.restricted);
        sums.all_reduce(rank.transport)?;
        self.coarse.start(&sums.all_restricted);
        // u = S r + P z; r.u, r.r
        self.colored.sweep(executor, inverse, &self.coarse.correction, &v.r, &mut v.u);
        Ok(())
    }

    fn product(
        &mut self,
        rank: &mut RankContext<'_>,
        operator: &mut A,
        sums: &mut IterationSums,
        v: &mut PcgVectors,
    ) -> Result<(), TransportError> {
        // w = A u
        operator.apply(rank, &mut v.u, &mut v.w)?;
        // w.u, P' w
        let start = rank.recorder.before_kernels();
        let (scalars, restricted) = (&mut sums.scalars, &mut sums.restricted);
        self.colored.sums(rank.executor, self.inverse_diagonal, &mut v.w, &v.u, scalars, restricted);
        let (bytes, flops) = (v.w.bytes() * 5, v.w.len() as u64 * 3);
        rank.recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, flops);
        Ok(())
    }

    fn advance(&mut self, rank: &mut RankContext<'_>, scalars: Scalars, sums: &IterationSums, v: &mut PcgVectors) {
        // p = u + beta p; s = w + beta s; x += alpha p; r -= alpha s
        v.update(rank, self.ops, scalars, self.inverse_diagonal);
        let start = rank.recorder.before_kernels();
        // P' s = P' w + beta P' s; P' r -= alpha P' s; z
        self.coarse.update(&sums.all_restricted, scalars.alpha, scalars.beta);
        // u = S r + P z; r.u, r.r
        self.colored.sweep(rank.executor, self.inverse_diagonal, &self.coarse.correction, &v.r, &mut v.u);
        let (bytes, flops) = (self.colored.sweep_bytes(), self.colored.sweep_flops());
        rank.recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, flops);
    }
}
