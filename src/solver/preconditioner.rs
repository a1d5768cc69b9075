//! The preconditioner trait of PCG, and block Jacobi. `two_level` has the sweeps of the Schwarz preconditioner.
//!
//! A preconditioner runs the vector updates of an iteration and computes its sums, because each one fuses them with
//! M^-1 r in its own way. The chain sweep also computes a part of the next product.

use super::operator::Operator;
use super::reduction::ReductionTree;
use super::vector::{ChunkSums, PcgVectors, Scalars, VectorOps};
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor};
use crate::partition::RowPartition;
use crate::telemetry::{Activity, EventName};
use crate::transport::{Transport, TransportError};

/// M^-1 for one solve with the matrix `A`, which is symmetric positive definite on the rows that are not pinned.
pub trait Preconditioner<A: Operator> {
    /// r = b - w, u = M^-1 r; r and u are zero on pinned rows.
    fn start(
        &mut self,
        rank: &mut RankContext<'_>,
        sums: &mut IterationSums,
        b: &DeviceVec<f32>,
        v: &mut PcgVectors,
    ) -> Result<(), TransportError>;

    /// w = A u; writes r . u, r . r and w . u of the own chunks to `sums`.
    fn product(
        &mut self,
        rank: &mut RankContext<'_>,
        operator: &mut A,
        sums: &mut IterationSums,
        v: &mut PcgVectors,
    ) -> Result<(), TransportError>;

    /// p = u + beta p; s = w + beta s; x += alpha p; r -= alpha s; u = M^-1 r. `sums`: those of the last product, over
    /// all ranks.
    fn advance(&mut self, rank: &mut RankContext<'_>, scalars: Scalars, sums: &IterationSums, v: &mut PcgVectors);
}

/// The sums of one iteration over the own chunks and over all chunks.
pub struct IterationSums {
    tree: ReductionTree,
    /// r . u, r . r, w . u of every own chunk.
    pub(super) scalars: Vec<ChunkSums>,
    /// Sums of w over the own chunks, three values each, for a coarse level; empty where there is none.
    pub(super) restricted: Vec<f64>,
    /// Sums of w over all chunks, three values each.
    pub(super) all_restricted: Vec<f64>,
}

impl IterationSums {
    pub(super) fn new(partition: &RowPartition) -> IterationSums {
        let tree = ReductionTree::new(partition);
        IterationSums { tree, scalars: Vec::new(), restricted: Vec::new(), all_restricted: Vec::new() }
    }

    /// r . u, r . r, w . u over all ranks. The same message carries the sums of w.
    pub(super) fn all_reduce(&mut self, transport: &mut dyn Transport) -> Result<ChunkSums, TransportError> {
        self.tree.all_reduce_and_gather(transport, &self.scalars, &self.restricted, &mut self.all_restricted)
    }

    /// Bytes of the own message of the last sum.
    pub(super) fn message_bytes(&self) -> u64 {
        self.tree.message_bytes()
    }
}

/// Block Jacobi: the inverse 3x3 diagonal blocks, fused with the updates of the iteration.
pub struct Jacobi {
    ops: VectorOps,
}

impl Jacobi {
    /// For the rows of rank `rank`.
    pub fn new(executor: &Executor, partition: &RowPartition, rank: usize) -> Jacobi {
        Jacobi { ops: VectorOps::new(executor, partition.rows_of(rank).len(), partition.chunk_rows()) }
    }

    /// M^-1 with the diagonal of a matrix: xx, xy, xz, yy, yz, zz per own row; zeros mark a pinned row.
    pub fn of<'a>(&'a mut self, inverse_diagonal: &'a DeviceVec<f32>) -> JacobiOf<'a> {
        JacobiOf { ops: &mut self.ops, inverse_diagonal }
    }
}

/// [`Jacobi`] with the diagonal of one matrix.
pub struct JacobiOf<'a> {
    ops: &'a mut VectorOps,
    inverse_diagonal: &'a DeviceVec<f32>,
}

impl<A: Operator> Preconditioner<A> for JacobiOf<'_> {
    fn start(
        &mut self,
        rank: &mut RankContext<'_>,
        sums: &mut IterationSums,
        b: &DeviceVec<f32>,
        v: &mut PcgVectors,
    ) -> Result<(), TransportError> {
        sums.restricted.clear();
        // r = b - w; u = D^-1 r; r.u, r.r
        self.ops.start(rank.executor, b, &v.w, self.inverse_diagonal, &mut v.r, &mut v.u, v.own_start);
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
        // w.u
        let start = rank.recorder.before_kernels();
        self.ops.dot(rank.executor, &v.w, &v.u, v.own_start);
        self.ops.sums(rank.executor, &mut sums.scalars);
        let (bytes, flops) = (v.w.bytes() * 2, v.w.len() as u64 * 2);
        rank.recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, flops);
        Ok(())
    }

    fn advance(&mut self, rank: &mut RankContext<'_>, scalars: Scalars, _: &IterationSums, v: &mut PcgVectors) {
        // p = u + beta p; s = w + beta s; x += alpha p; r -= alpha s; u = D^-1 r; r.u, r.r
        v.update(rank, self.ops, scalars, self.inverse_diagonal);
    }
}
