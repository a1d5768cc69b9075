//! A linear system on the workers of a session. It is planned like a run, solved once, and does not need a scene.

use std::path::PathBuf;

use super::crew::Launch;
use super::options::SessionOptions;
use super::plan::{PlanError, check_workers, plan_transfers};
use super::session::{Session, SessionError, SessionPlace};
use crate::interconnect::{Plan, ScheduleKind};
use crate::linear_system::{BlockSystem, SolveParams, SolveResult, locality_order, share_between_chunks};
use crate::math::DIM;
use crate::partition::RowPartition;
use crate::solver::{ExchangeMode, PreconditionerKind};
use crate::step::ExchangePlan;

/// The reordered rows are used if they cut at most this fraction of the couplings between chunks that the file's order
/// cuts.
const CLEARLY: f64 = 0.8;

/// Options of a linear solve.
#[derive(Clone, Debug)]
pub struct SolveOptions {
    /// Number of workers.
    pub workers: usize,
    /// Topology file; none: a balanced binary tree.
    pub topology: Option<PathBuf>,
    /// Exchange mode of products.
    pub exchange: ExchangeMode,
    /// Schedule of the transfers.
    pub schedule: ScheduleKind,
    /// Solver parameters, the same on all ranks.
    pub params: SolveParams,
}

impl Default for SolveOptions {
    /// One worker, halo exchange, the parameters of [`SolveParams::default`].
    fn default() -> SolveOptions {
        SolveOptions {
            workers: 1,
            topology: None,
            exchange: ExchangeMode::Halo,
            schedule: ScheduleKind::default(),
            params: SolveParams::default(),
        }
    }
}

/// A checked solve, ready to run. All input that it can refuse has been checked.
pub struct SolvePlan {
    /// The matrix.
    pub system: BlockSystem,
    /// Right-hand side, one value per row of the file.
    pub rhs: Vec<f64>,
    /// Rows and ranks.
    pub partition: RowPartition,
    /// Work queues and how they were chosen.
    pub transfers: Plan,
    /// The topology's name.
    pub topology: String,
    /// Exchange mode of products.
    pub exchange: ExchangeMode,
    /// Solver parameters, the same on all ranks.
    pub params: SolveParams,
    /// Rows of the matrix in the file.
    pub file_rows: usize,
    /// Block row of the file of each block row of the system, if it was reordered.
    pub order: Option<Vec<u32>>,
}

impl SolvePlan {
    /// Plans the solve of `system` with right-hand side `rhs`, one value per row of the file.
    ///
    /// # Errors
    /// More workers than block rows, or a topology or schedule that does not fit.
    pub fn new(system: BlockSystem, rhs: Vec<f64>, options: &SolveOptions) -> Result<SolvePlan, PlanError> {
        let (workers, block_rows) = (options.workers, system.block_rows());
        check_workers(workers, block_rows, &format!("the matrix has only {block_rows} block rows (three rows each)"))?;
        let partition = RowPartition::new(block_rows, workers);
        let (transfers, topology) =
            plan_transfers(options.topology.as_deref(), options.schedule, workers, partition.sub_vector_rows())?;
        let file_rows = system.scalar_rows;
        let may_sweep = options.params.preconditioner != PreconditionerKind::Jacobi;
        let order = may_sweep.then(|| better_order(&system, partition.chunk_rows())).flatten();
        let (system, rhs) = match &order {
            None => (system, rhs),
            Some(order) => (system.reordered(order), blockwise(order, rhs)),
        };
        let SolveOptions { exchange, params, .. } = *options;
        Ok(SolvePlan { system, rhs, partition, transfers, topology, exchange, params, file_rows, order })
    }
}

/// Solves on worker processes; returns the results by rank and the executor's name.
///
/// # Errors
/// A worker failed or its executor is not available.
pub fn solve(
    plan: SolvePlan,
    options: &SessionOptions,
    launch: &Launch,
) -> Result<(Vec<SolveResult>, String), SessionError> {
    let SolvePlan { system, rhs, partition, transfers, exchange: mode, params, .. } = plan;
    let queues = transfers.schedule.queues;
    let exchange: Vec<ExchangePlan> = queues.into_iter().map(|queue| ExchangePlan { mode, queue }).collect();
    let mut session = Session::assemble(SessionPlace::ALONE, options, launch)?;
    let solved = session.solve(system, rhs, &partition, &exchange, params)?;
    session.dismiss();
    Ok(solved)
}

/// An order with coupled rows close together, if it cuts clearly fewer couplings between chunks than the file's order.
fn better_order(system: &BlockSystem, chunk_rows: usize) -> Option<Vec<u32>> {
    let natural: Vec<u32> = (0..system.block_rows() as u32).collect();
    let order = locality_order(system, chunk_rows);
    let share = |order: &[u32]| share_between_chunks(system, order, chunk_rows);
    (share(&order) < CLEARLY * share(&natural)).then_some(order)
}

/// Values of a vector in another order of the block rows; missing ones are zero.
fn blockwise(order: &[u32], values: Vec<f64>) -> Vec<f64> {
    let at = |index: usize| values.get(index).copied().unwrap_or(0.0);
    order.iter().flat_map(|&old| (0..DIM).map(move |c| old as usize * DIM + c)).map(at).collect()
}
