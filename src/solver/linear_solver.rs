//! Solver of a rank for consecutive systems with the same elastic pattern: product, preconditioners, vectors and PCG.

use super::exchange::{ExchangeMode, HaloExchange};
use super::operator::{Operator, StoredMatrix};
use super::pcg::{Pcg, PcgError, PcgInfo, PcgParams};
use super::pipelined::PipelinedSpmv;
use super::preconditioner::{Jacobi, Preconditioner};
use super::schwarz::Schwarz;
use super::vector::PcgVectors;
use crate::assembly::SystemMatrix;
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::partition::{HaloPlan, RowPartition};
use crate::scene::PreconditionerKind;
use crate::transport::TransportError;

/// A x = b on a rank's rows.
#[derive(Clone, Copy)]
pub struct LinearSystem<'a> {
    /// The matrix A.
    pub matrix: SystemMatrix<'a>,
    /// Inverse diagonal blocks xx, xy, xz, yy, yz, zz per own row; zeros mark a pinned row.
    pub inverse_diagonal: &'a DeviceVec<f32>,
    /// Right-hand side b, xyz per own row.
    pub rhs: &'a DeviceVec<f32>,
}

/// The solver of one rank.
pub struct LinearSolver {
    /// Matrix-vector products and the exchange of halo rows.
    pub spmv: PipelinedSpmv,
    /// Start value in `x`, solution in `x`.
    pub vectors: PcgVectors,
    jacobi: Jacobi,
    schwarz: Option<Schwarz>,
    pcg: Pcg,
}

impl LinearSolver {
    /// Solver of the rows of rank `plan.rank`, whose work queue is `queue`. `schwarz`: None for Jacobi alone.
    pub fn new(
        executor: &Executor,
        partition: &RowPartition,
        plan: HaloPlan,
        mode: ExchangeMode,
        queue: &[QueueNode],
        schwarz: Option<Schwarz>,
    ) -> LinearSolver {
        let vectors = PcgVectors::new(executor, plan.own.clone(), plan.local_rows);
        let jacobi = Jacobi::new(executor, partition, plan.rank);
        let halo = HaloExchange::new(plan, queue.to_vec());
        let spmv = PipelinedSpmv::new(executor, mode, halo, queue.to_vec(), partition.sub_vector_rows());
        LinearSolver { spmv, vectors, jacobi, schwarz, pcg: Pcg::new(partition) }
    }

    /// Sets the preconditioner up for new values of the matrix. All ranks call it together, before they solve with this
    /// matrix.
    ///
    /// # Errors
    /// A transfer failed.
    pub fn set_up(&mut self, rank: &mut RankContext<'_>, system: &LinearSystem<'_>) -> Result<(), TransportError> {
        let Some(schwarz) = &mut self.schwarz else { return Ok(()) };
        schwarz.set_up(rank, self.spmv.halo(), &system.matrix, system.inverse_diagonal, &mut self.vectors.u)
    }

    /// Solves A x = b for x = `vectors.x` with the matrix of the last setup. It begins with Schwarz, if there is one,
    /// and goes on with Jacobi.
    ///
    /// # Errors
    /// As [`Pcg::solve`].
    pub fn solve(
        &mut self,
        rank: &mut RankContext<'_>,
        system: &LinearSystem<'_>,
        params: &PcgParams,
    ) -> Result<PcgInfo, PcgError> {
        let LinearSystem { matrix, inverse_diagonal, rhs } = *system;
        let mut operator = StoredMatrix { spmv: &mut self.spmv, matrix };
        let mut jacobi = self.jacobi.of(inverse_diagonal);
        let mut schwarz = self.schwarz.as_mut().map(|schwarz| schwarz.of(rank.executor, inverse_diagonal));
        let mut preconditioners: Vec<&mut dyn Preconditioner<_>> = Vec::new();
        if let Some(schwarz) = &mut schwarz {
            preconditioners.push(&mut **schwarz);
        }
        preconditioners.push(&mut jacobi);
        self.pcg.solve(rank, &mut operator, &mut preconditioners, rhs, &mut self.vectors, params)
    }

    /// Solves as [`LinearSolver::solve`], with Jacobi and the operator that `operator` builds on the exchange.
    ///
    /// # Errors
    /// As [`Pcg::solve`].
    pub fn solve_with<'a, A: Operator>(
        &'a mut self,
        rank: &mut RankContext<'_>,
        operator: impl FnOnce(&'a mut PipelinedSpmv) -> A,
        inverse_diagonal: &DeviceVec<f32>,
        rhs: &DeviceVec<f32>,
        params: &PcgParams,
    ) -> Result<PcgInfo, PcgError> {
        let mut jacobi = self.jacobi.of(inverse_diagonal);
        self.pcg.solve(rank, &mut operator(&mut self.spmv), &mut [&mut jacobi], rhs, &mut self.vectors, params)
    }

    /// Drops the Schwarz preconditioner.
    pub fn keep_jacobi(&mut self) {
        self.schwarz = None;
    }

    /// Preconditioner of the first descent of a solve.
    pub fn preconditioner(&self) -> PreconditionerKind {
        match self.schwarz {
            None => PreconditionerKind::Jacobi,
            Some(_) => PreconditionerKind::Schwarz,
        }
    }

    /// Device bytes of vectors and preconditioner.
    pub fn bytes(&self) -> u64 {
        self.vectors.bytes() + self.schwarz.as_ref().map_or(0, Schwarz::bytes)
    }
}
