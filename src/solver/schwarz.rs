//! Two-level additive Schwarz preconditioner. Inside every chunk of rows it makes one over-relaxed symmetric block
//! Gauss-Seidel sweep [Young 1954]. Over all chunks it has a coarse level with one displacement per group of chunks.
//! [Wu, Wang and Wang 2022] use several levels of aggregates instead of the sweep.
//!
//! M^-1 = (D' + U)^-1 D' (D' + L)^-1 + P (P' A P)^-1 P' is symmetric positive definite, whatever couplings A has
//! between chunks. The native executor sweeps a chunk row by row (`sweep`), a device color by color (`colored`). Chunks
//! depend only on the number of rows, so the bits do not depend on ranks.

use super::coarse::{Coarse, GroupSums, add_block};
use super::colored::Colored;
use super::exchange::{ExchangeMode, HaloExchange, TrafficCounter};
use super::operator::StoredMatrix;
use super::preconditioner::Preconditioner;
use super::rank_pattern::RankPattern;
use super::sweep::Sweeps;
use super::two_level::{ChainSweep, ColoredSweep};
use super::vector::VectorOps;
use crate::assembly::sell::BLOCK;
use crate::assembly::{SellMatrix, SystemMatrix};
use crate::context::RankContext;
use crate::gpu::{CpuExecutor, DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::partition::{HaloPlan, RowPartition};
use crate::scene::PreconditionerKind;
use crate::transport::TransportError;

/// Largest number of rows of a chunk that the type of its columns can index.
const CHUNK_ROWS_MAX: usize = 1 << 16;
/// Minimum relative tolerance of a descent for which `auto` uses Schwarz.
const LEAST_TOLERANCE: f64 = 1e-4;

/// Sweeps over the rows of a chunk; both variants hold a copy of the matrix in the layout that they multiply.
enum Smoother {
    /// Row by row, fused with the updates of a solve and the products inside chunks. Native.
    Chain(Box<Sweeps>),
    Colors(Box<Colored>),
}

/// The preconditioner of one rank.
pub struct Schwarz {
    chunk_rows: usize,
    /// First local row that is owned.
    own_start: usize,
    smoother: Smoother,
    /// In `full` mode: first global row of the sub-vector of each section.
    sub_vectors: Vec<u32>,
    ops: VectorOps,
    coarse: Coarse,
}

impl Schwarz {
    /// True if a solve uses this preconditioner. All ranks decide alike if their executors are of one kind.
    ///
    /// `auto`: Schwarz at tolerances >= 1e-4, for systems of any size. A loose stop on a residual dominated by contacts
    /// can miss the rigid motion of the whole cloth; the coarse level removes that first. At lower tolerances Jacobi
    /// removes it, too, and rounding lets Jacobi reach a smaller residual (see [`super::Pcg::solve`]). On devices
    /// `auto` keeps Jacobi, because barriers cost too much on software devices and hardware has not been measured.
    ///
    /// # Errors
    /// Schwarz was requested and is not available; the text says why.
    pub fn wanted(
        kind: PreconditionerKind,
        executor: &Executor,
        partition: &RowPartition,
        tolerance: f64,
    ) -> Result<bool, String> {
        let native = matches!(executor, Executor::Cpu(_));
        let fits = partition.chunk_rows() <= CHUNK_ROWS_MAX;
        match kind {
            PreconditionerKind::Jacobi => Ok(false),
            PreconditionerKind::Auto => Ok(native && fits && tolerance >= LEAST_TOLERANCE),
            PreconditionerKind::Schwarz if !fits => Err(format!(
                "preconditioner schwarz takes at most {CHUNK_ROWS_MAX} rows per chunk, this system has {}; use auto or jacobi",
                partition.chunk_rows()
            )),
            PreconditionerKind::Schwarz => Ok(true),
        }
    }

    /// Builds the tables for a pattern. `mode` and `queue` are those of the products.
    pub fn new(
        executor: &Executor,
        partition: &RowPartition,
        plan: &HaloPlan,
        mode: ExchangeMode,
        queue: &[QueueNode],
        pattern: RankPattern,
    ) -> Schwarz {
        let by_color = matches!(executor, Executor::Gpu(_));
        Schwarz::with_smoother(executor, partition, plan, mode, queue, pattern, by_color)
    }

    /// As [`Schwarz::new`]; `by_color`: sweep by color on every executor.
    pub(super) fn with_smoother(
        executor: &Executor,
        partition: &RowPartition,
        plan: &HaloPlan,
        mode: ExchangeMode,
        queue: &[QueueNode],
        pattern: RankPattern,
        by_color: bool,
    ) -> Schwarz {
        let coarse = Coarse::new(partition, plan.rank);
        let smoother = if by_color {
            Smoother::Colors(Box::new(Colored::new(executor, partition, plan, pattern, &coarse)))
        } else {
            Smoother::Chain(Box::new(Sweeps::new(executor, partition, plan, mode, queue, pattern, &coarse)))
        };
        let sub_vectors = match mode {
            ExchangeMode::Halo => Vec::new(),
            ExchangeMode::Full => {
                let ranks = std::iter::once(plan.rank).chain(queue.iter().map(|node| node.vector));
                ranks.map(|rank| partition.rows_of(rank).start as u32).collect()
            }
        };
        let (chunk_rows, own_start) = (partition.chunk_rows(), plan.own.start);
        let ops = VectorOps::new(executor, plan.own.len(), chunk_rows);
        Schwarz { chunk_rows, own_start, smoother, sub_vectors, ops, coarse }
    }

    /// Sets the values of the matrix and factors the coarse level, once per step, on all ranks together. Uses `flags`,
    /// a local vector, for the pins of halo rows. Bytes per row: about 900, on a device 1,600.
    ///
    /// # Errors
    /// A transfer failed.
    pub fn set_up(
        &mut self,
        rank: &mut RankContext<'_>,
        halo: &mut HaloExchange,
        matrix: &SystemMatrix<'_>,
        inverse_diagonal: &DeviceVec<f32>,
        flags: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        let executor = rank.executor;
        let inverses = inverse_diagonal.host(executor);
        let free = inverses.as_chunks::<6>().0.iter().flat_map(|inverse| [f32::from(inverse[0] != 0.0); 3]);
        flags.write_range(executor, self.own_start * 3, &free.collect::<Vec<f32>>());
        let mut traffic = TrafficCounter::default();
        halo.start(executor, rank.transport, &[&*flags], rank.recorder)?;
        halo.finish(executor, rank.transport, &mut [flags], rank.recorder, &mut traffic)?;
        let mut entries = match &mut self.smoother {
            Smoother::Chain(sweeps) => sweeps.set_values(native(executor), matrix.elastic, flags.as_slice()),
            Smoother::Colors(colored) => colored.set_values(executor, matrix.elastic, flags),
        };
        if let Some(contact) = matrix.contact {
            self.add_contacts(executor, contact, halo.plan(), &flags.host(executor), &mut entries);
        }
        self.coarse.set_up(rank.transport, &entries)
    }

    /// The coarse entries of the contact blocks. The sweeps do not multiply these blocks, but without them the coarse
    /// level would take the contacts' part of the diagonal for a fixed support.
    fn add_contacts(
        &self,
        executor: &Executor,
        contact: &SellMatrix,
        plan: &HaloPlan,
        flags: &[f32],
        entries: &mut [GroupSums],
    ) {
        contact.for_each_block(executor, |section, row, column, block| {
            let column = match self.sub_vectors.get(section) {
                None => Some(column),
                Some(&start) => plan.local_from_global(start + column),
            };
            // Zero blocks are padding or contacts without force.
            let Some(column) = column.map(|c| c as usize).filter(|_| block != [0.0; BLOCK]) else { return };
            if flags[(self.own_start + row as usize) * 3] == 0.0 || flags[column * 3] == 0.0 {
                return;
            }
            let group = self.coarse.group(plan.global_from_local[column] as usize / self.chunk_rows) as u32;
            add_block(&mut entries[row as usize / self.chunk_rows], group, block);
        });
    }

    /// M^-1 for a solve with the matrix of the last setup, whose inverse diagonal blocks are `inverse_diagonal`.
    pub fn of<'a, 'm: 'a>(
        &'a mut self,
        executor: &'a Executor,
        inverse_diagonal: &'a DeviceVec<f32>,
    ) -> Box<dyn Preconditioner<StoredMatrix<'m>> + 'a> {
        let (ops, coarse) = (&mut self.ops, &mut self.coarse);
        match &mut self.smoother {
            Smoother::Chain(sweeps) => {
                Box::new(ChainSweep { cpu: native(executor), ops, sweeps, coarse, inverse_diagonal })
            }
            Smoother::Colors(colored) => Box::new(ColoredSweep { ops, colored, coarse, inverse_diagonal }),
        }
    }

    /// Bytes of the tables and of the copy of the matrix.
    pub fn bytes(&self) -> u64 {
        match &self.smoother {
            Smoother::Chain(sweeps) => sweeps.bytes(),
            Smoother::Colors(colored) => colored.bytes(),
        }
    }
}

/// The native executor; only it sweeps along the rows.
fn native(executor: &Executor) -> &CpuExecutor {
    match executor {
        Executor::Cpu(cpu) => cpu,
        Executor::Gpu(_) => unreachable!("the sweeps along the rows run on the native executor only"),
    }
}

#[cfg(test)]
#[path = "schwarz_tests.rs"]
mod tests;
