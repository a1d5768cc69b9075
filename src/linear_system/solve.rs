//! Distributed solve of a linear system: PCG in single precision inside iterative refinement in double precision
//! [Wilkinson 1963; Carson and Higham 2018].
//!
//! Convergence is judged by b - A x in f64. A single PCG in f32 reduces it to about 1e-5 of b (less for ill-conditioned
//! systems). Then A d = r is solved for a correction d, repeatedly. This converges while the f32 copy of the matrix is
//! a good preconditioner, that is, for condition numbers (after block Jacobi) up to about 1e6. Where it stops to make
//! progress, the native executor solves for the remaining corrections by PCG in f64 ([`DoublePcg`]).

use std::time::Instant;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::double::DoubleSystem;
use super::precondition::inverse_block;
use super::rank_system::{RankSystem, power_of_two};
use super::residual::Residual;
use crate::assembly::sell::{BLOCK, value_index};
use crate::assembly::{SellLayout, SellMatrix};
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::math::DIM;
use crate::solver::{
    DoubleEnd, DoublePcg, ExchangeMode, LinearSolver, LinearSystem, PcgError, PcgParams, PreconditionerKind,
    RankPattern, Schwarz,
};
use crate::telemetry::{Activity, Event, EventName, Recorder};
use crate::transport::{Transport, TransportError};

/// Smallest relative residual that a single PCG in f32 is asked for.
const INNER_TOLERANCE: f64 = 1e-5;
/// Smallest relative residual that a single PCG in f64 is asked for.
const DOUBLE_TOLERANCE: f64 = 1e-12;
/// The solve gives up if a refinement does not reduce the residual to at most this fraction of the previous one.
const PROGRESS: f64 = 0.5;
/// Number of products in the separate timing of products.
const TIMED_PRODUCTS: u32 = 20;

/// Parameters of a solve; equal on all ranks.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct SolveParams {
    /// Stop when |b - A x| <= this * |b|, 2-norms in f64.
    pub relative_tolerance: f64,
    /// Stop after this many PCG iterations in total.
    pub max_iterations: u32,
    /// Number of solves from zero (at least one), for timing.
    pub repeat: u32,
    /// True if matrix-vector products are timed separately as well.
    pub time_products: bool,
    /// Threads that compute the residual on the host.
    pub host_threads: usize,
    /// The preconditioner of PCG.
    pub preconditioner: PreconditionerKind,
    /// The events of this many first solves are kept.
    pub record_solves: u32,
}

impl Default for SolveParams {
    /// One solve to a relative residual of 1 %, as in a simulation step.
    fn default() -> SolveParams {
        SolveParams {
            relative_tolerance: 0.01,
            max_iterations: 2000,
            repeat: 1,
            time_products: false,
            host_threads: 1,
            preconditioner: PreconditionerKind::Auto,
            record_solves: 0,
        }
    }
}

/// Result figures of a solve; equal on all ranks.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SolveStats {
    /// PCG iterations, summed over all refinements.
    pub iterations: u32,
    /// True if the residual met the tolerance.
    pub converged: bool,
    /// |b - A x| / |b|, computed in f64 from the values of the file.
    pub relative_residual: f64,
    /// Corrections solved after the first PCG.
    pub refinements: u32,
    /// The part of `iterations` in double precision.
    pub double_iterations: u32,
    /// Why the solve ended.
    pub end: SolveEnd,
    /// Matrix-vector products of one solve.
    pub products: u32,
    /// The preconditioner that was used.
    pub preconditioner: PreconditionerKind,
    /// Seconds of each solve on the slowest rank, from the set-up of the preconditioner (which depends on the matrix
    /// values) to the last iteration. The residual that confirms the result is excluded; residuals that lead to a
    /// refinement are included.
    pub seconds: Vec<f64>,
    /// Bytes received by all ranks in one solve, residuals included.
    pub bytes_exchanged: u64,
    /// The part of `bytes_exchanged` that matrix-vector products cause.
    pub product_bytes: u64,
    /// Stored blocks of all ranks.
    pub blocks: u64,
    /// Block slots of all ranks, including padding.
    pub slots: u64,
    /// If timed: seconds of one product (best time, slowest rank), and bytes that the kernels of all ranks move in it.
    pub product: Option<(f64, u64)>,
}

/// Why a solve ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum SolveEnd {
    /// The residual met the tolerance.
    #[default]
    Converged,
    /// The iteration limit was reached.
    Limit,
    /// A direction p with p'Ap < 0 was found; p'Ap in scaled units.
    NotPositiveDefinite {
        /// p'Ap.
        curvature: f64,
    },
    /// A direction p with p'Ap = 0 within rounding was found, so that the right-hand side has no solution.
    Singular,
    /// Single precision cannot reduce the residual any further, and the executor has nothing else.
    SinglePrecision,
    /// Double precision cannot reduce the residual any further.
    DoublePrecision,
}

/// Result of one rank.
#[derive(Clone, Debug)]
pub struct SolveResult {
    /// Numbers of the solve.
    pub stats: SolveStats,
    /// Solution on the own rows, three values per block row (padding included), in the units of the file.
    pub x: Vec<f64>,
    /// Device, memory and events.
    pub record: SolveRecord,
}

/// Device, memory and events of one rank during its solves.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct SolveRecord {
    /// Name of the rank's device.
    pub device: String,
    /// [`Recorder::epoch_unix_ns`] of the events.
    pub epoch_unix_ns: u64,
    /// Bytes of device memory that the rank holds.
    pub memory_bytes: u64,
    /// Events of the first [`SolveParams::record_solves`] solves. Each solve counts as a step, from 1. They are not
    /// serialized because they are bulk data.
    #[serde(skip)]
    pub events: Vec<Event>,
}

/// Why a solve yields no solution.
#[derive(Debug, Error)]
pub enum SolveError {
    /// A transfer failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The requested preconditioner is not available for this system or executor.
    #[error("{0}")]
    Preconditioner(String),
}

/// Solves A x = b on all ranks together. `queue`: this rank's work queue. All ranks return the same error, except for
/// failed transfers.
///
/// # Errors
/// A transfer failed. A solve that does not converge returns `Ok` with `converged == false`, the best iterate, and its
/// residual.
pub fn solve_rank(
    executor: &Executor,
    transport: &mut dyn Transport,
    system: &RankSystem,
    mode: ExchangeMode,
    queue: &[QueueNode],
    params: &SolveParams,
) -> Result<SolveResult, SolveError> {
    // Tolerance 1: `auto` may choose Schwarz at any tolerance of the solve, because every PCG here starts from a
    // residual in f64 and rounding in one of them is corrected by the next.
    let schwarz =
        Schwarz::wanted(params.preconditioner, executor, &system.partition, 1.0).map_err(SolveError::Preconditioner)?;
    let mut solver = RankSolver::new(executor, system, mode, queue, params, schwarz);
    let mut stats = SolveStats::default();
    let mut seconds = Vec::new();
    for number in 1..=params.repeat.max(1) {
        solver.recorder.begin_step(number, number <= params.record_solves);
        transport.barrier()?;
        let mut own_seconds = 0.0;
        stats = solver.solve(transport, params, &mut own_seconds)?;
        seconds.push(all_max(transport, own_seconds)?);
    }
    solver.recorder.begin_step(0, false);
    stats.seconds = seconds;
    if params.time_products {
        stats.product = Some(solver.time_products(transport)?);
    }
    let own = [stats.bytes_exchanged, stats.product_bytes, stats.blocks, stats.slots];
    [stats.bytes_exchanged, stats.product_bytes, stats.blocks, stats.slots] = all_sum(transport, own)?;
    let unit = system.rhs_scale / system.matrix_scale;
    let x = solver.residual.solution().into_iter().map(|x| x * unit).collect();
    Ok(SolveResult { stats, x, record: solver.record() })
}

/// PCG in double precision and its operator, made when a solve needs them.
struct Double<'a> {
    system: &'a RankSystem,
    queue: Vec<QueueNode>,
    threads: usize,
    made: Option<(DoublePcg, DoubleSystem<'a>, Vec<f64>)>,
}

impl<'a> Double<'a> {
    fn parts(&mut self) -> &mut (DoublePcg, DoubleSystem<'a>, Vec<f64>) {
        let Double { system, queue, threads, made } = self;
        made.get_or_insert_with(|| {
            let pcg = DoublePcg::new(&system.partition, system.plan.clone(), queue.clone());
            (pcg, DoubleSystem::new(system, *threads), vec![0.0; system.plan.own.len() * DIM])
        })
    }
}

/// State of one rank during solves.
struct RankSolver<'a> {
    executor: &'a Executor,
    matrix: SellMatrix,
    inverse_diagonal: DeviceVec<f32>,
    rhs: DeviceVec<f32>,
    solver: LinearSolver,
    residual: Residual<'a>,
    /// None on a device.
    double: Option<Double<'a>>,
    recorder: Recorder,
    slots: usize,
}

impl<'a> RankSolver<'a> {
    fn new(
        executor: &'a Executor,
        system: &'a RankSystem,
        mode: ExchangeMode,
        queue: &[QueueNode],
        params: &SolveParams,
        schwarz: bool,
    ) -> RankSolver<'a> {
        let (partition, plan, arrays) = (&system.partition, &system.plan, &system.arrays);
        let layout = match mode {
            ExchangeMode::Halo => SellLayout::halo(&arrays.offsets, &arrays.columns, plan.own.clone()),
            ExchangeMode::Full => {
                let rows_of: Vec<_> = (0..partition.ranks()).map(|rank| partition.rows_of(rank)).collect();
                let order: Vec<usize> = queue.iter().map(|node| node.vector).collect();
                let columns = &arrays.columns;
                SellLayout::full(&arrays.offsets, columns, &plan.global_from_local, &rows_of, plan.rank, &order)
            }
        };
        let rows = plan.own.len();
        let mut matrix = SellMatrix::new(executor, rows, &layout);
        let (values, inverse_diagonal) = device_values(system, &layout);
        matrix.values = DeviceVec::upload(executor, &values);
        let pattern =
            RankPattern { offsets: &arrays.offsets, columns: &arrays.columns, block_address: &layout.block_address };
        let schwarz = schwarz.then(|| Schwarz::new(executor, partition, plan, mode, queue, pattern));
        RankSolver {
            inverse_diagonal: DeviceVec::upload(executor, &inverse_diagonal),
            rhs: DeviceVec::zeros(executor, rows * DIM),
            solver: LinearSolver::new(executor, partition, plan.clone(), mode, queue, schwarz),
            residual: Residual::new(system, queue.to_vec(), params.host_threads),
            double: matches!(executor, Executor::Cpu(_)).then(|| Double {
                system,
                queue: queue.to_vec(),
                threads: params.host_threads,
                made: None,
            }),
            recorder: Recorder::new(executor.clock().filter(|_| params.record_solves > 0)),
            slots: layout.slots(),
            executor,
            matrix,
        }
    }

    /// Splits the borrow into the solver, the system and the rank's context.
    fn parts<'b>(
        &'b mut self,
        transport: &'b mut dyn Transport,
    ) -> (&'b mut LinearSolver, LinearSystem<'b>, RankContext<'b>) {
        let system =
            LinearSystem { matrix: (&self.matrix).into(), inverse_diagonal: &self.inverse_diagonal, rhs: &self.rhs };
        let rank = RankContext { executor: self.executor, transport, recorder: &mut self.recorder };
        (&mut self.solver, system, rank)
    }

    fn record(&mut self) -> SolveRecord {
        let arrays = [&self.inverse_diagonal, &self.rhs].map(DeviceVec::bytes).iter().sum::<u64>();
        SolveRecord {
            device: self.executor.device_name(),
            epoch_unix_ns: self.recorder.epoch_unix_ns,
            memory_bytes: self.matrix.bytes() + arrays + self.solver.bytes(),
            events: self.recorder.take(),
        }
    }

    /// 2-norm of the residual over all ranks.
    fn norm(&mut self, transport: &mut dyn Transport) -> Result<f64, TransportError> {
        let start = self.recorder.now();
        let norm = self.residual.norm(transport)?;
        self.recorder.end(EventName::AllReduce, Activity::Wait, start, size_of::<f64>() as u64, 0);
        Ok(norm)
    }

    /// One solve from x = 0. It appends to `seconds`. The counts are those of this rank alone.
    fn solve(
        &mut self,
        transport: &mut dyn Transport,
        params: &SolveParams,
        seconds: &mut f64,
    ) -> Result<SolveStats, SolveError> {
        self.residual.reset();
        self.solver.spmv.traffic = Default::default();
        let preconditioner = self.solver.preconditioner();
        let (blocks, slots) = (self.matrix.blocks as u64, self.slots as u64);
        let mut stats = SolveStats { blocks, slots, preconditioner, ..Default::default() };
        let b_norm = self.norm(transport)?;
        let mut norm = b_norm;
        stats.converged = b_norm == 0.0;
        let mut clock = Instant::now();
        let (solver, system, mut rank) = self.parts(transport);
        solver.set_up(&mut rank, &system)?;
        let (mut best, mut in_double) = (norm, false);
        while !stats.converged {
            let relative = norm / b_norm;
            let wanted = params.relative_tolerance / relative;
            // The tolerance of a correction is tightened by 10 %, because rounding could otherwise require one more
            // correction.
            let wanted = if stats.iterations == 0 { wanted } else { 0.9 * wanted };
            let least = if in_double { DOUBLE_TOLERANCE } else { INNER_TOLERANCE };
            let inner = PcgParams {
                relative_tolerance: wanted.max(least),
                energy: false,
                max_iterations: params.max_iterations - stats.iterations,
                nonzero_start: false,
            };
            let end = match in_double {
                false => self.correct(transport, norm, &inner, &mut stats)?,
                true => self.correct_in_double(transport, &inner, &mut stats)?,
            };
            *seconds += clock.elapsed().as_secs_f64();
            clock = Instant::now();
            self.residual.update(transport, &mut self.recorder)?;
            norm = self.norm(transport)?;
            if norm < best {
                best = norm;
                self.residual.keep();
            }
            stats.converged = norm / b_norm <= params.relative_tolerance;
            let progress = norm / b_norm <= PROGRESS * relative;
            if stats.converged {
                break;
            }
            if stats.iterations >= params.max_iterations {
                stats.end = SolveEnd::Limit;
                break;
            }
            // A broken-off or fruitless correction ends this precision.
            if !progress && (end != SolveEnd::Converged || inner.relative_tolerance <= PROGRESS) {
                if in_double || self.double.is_none() {
                    stats.end = match end {
                        SolveEnd::Converged if in_double => SolveEnd::DoublePrecision,
                        SolveEnd::Converged => SolveEnd::SinglePrecision,
                        other => other,
                    };
                    break;
                }
                in_double = true;
            }
            if norm > best || !norm.is_finite() {
                norm = self.go_back(transport)?;
            }
            stats.refinements += 1;
        }
        if !stats.converged && (norm > best || !norm.is_finite()) {
            norm = self.go_back(transport)?;
        }
        stats.relative_residual = if b_norm > 0.0 { norm / b_norm } else { 0.0 };
        stats.product_bytes = self.solver.spmv.traffic.received_bytes;
        stats.bytes_exchanged = stats.product_bytes + self.residual.traffic.received_bytes;
        Ok(stats)
    }

    /// Goes back to the best x; returns its residual norm.
    fn go_back(&mut self, transport: &mut dyn Transport) -> Result<f64, TransportError> {
        self.residual.restore();
        self.residual.update(transport, &mut self.recorder)?;
        self.norm(transport)
    }

    /// Solves A d = r by PCG in f32 and adds d to x. `Converged`: as far as this precision can tell.
    fn correct(
        &mut self,
        transport: &mut dyn Transport,
        norm: f64,
        params: &PcgParams,
        stats: &mut SolveStats,
    ) -> Result<SolveEnd, SolveError> {
        // Division by a power of two is exact and brings the right-hand side into the range of f32.
        let scale = power_of_two(norm);
        let rhs: Vec<f32> = self.residual.r.iter().map(|r| (r / scale) as f32).collect();
        self.rhs.write_range(self.executor, 0, &rhs);
        self.solver.vectors.x.fill_zero(self.executor);
        let (solver, system, mut rank) = self.parts(transport);
        let end = match solver.solve(&mut rank, &system, params) {
            Ok(info) => {
                stats.iterations += info.iterations;
                stats.products += info.products;
                SolveEnd::Converged
            }
            Err(PcgError::NotPositiveDefinite { iteration, curvature }) => {
                // Near the accuracy limit of f32 a negative curvature can come from rounding; the f64 residual decides.
                stats.iterations += iteration;
                stats.products += iteration + 1;
                SolveEnd::NotPositiveDefinite { curvature }
            }
            Err(PcgError::NotFinite { iteration }) => {
                stats.iterations += iteration;
                stats.products += iteration + 1;
                SolveEnd::SinglePrecision
            }
            Err(PcgError::Transport(error)) => return Err(error.into()),
        };
        self.residual.add(scale, &self.solver.vectors.x.read(self.executor));
        Ok(end)
    }

    /// As [`RankSolver::correct`], in f64 with block Jacobi. Native executor only.
    fn correct_in_double(
        &mut self,
        transport: &mut dyn Transport,
        params: &PcgParams,
        stats: &mut SolveStats,
    ) -> Result<SolveEnd, SolveError> {
        let Some(double) = &mut self.double else { return Ok(SolveEnd::SinglePrecision) };
        let (pcg, operator, d) = double.parts();
        let Residual { r, traffic, .. } = &mut self.residual;
        let (recorder, tolerance) = (&mut self.recorder, params.relative_tolerance);
        let info = pcg.solve(transport, recorder, traffic, operator, r, d, tolerance, params.max_iterations)?;
        stats.iterations += info.iterations;
        stats.double_iterations += info.iterations;
        stats.products += info.iterations;
        self.residual.add(1.0, d);
        Ok(match info.end {
            DoubleEnd::Converged | DoubleEnd::Limit => SolveEnd::Converged,
            DoubleEnd::Negative(curvature) => SolveEnd::NotPositiveDefinite { curvature },
            DoubleEnd::Singular => SolveEnd::Singular,
            DoubleEnd::NotFinite => SolveEnd::DoublePrecision,
        })
    }

    /// Best time of a product on the slowest rank, and the bytes that its kernels move on all ranks.
    fn time_products(&mut self, transport: &mut dyn Transport) -> Result<(f64, u64), TransportError> {
        let mut best = f64::INFINITY;
        let mut y = DeviceVec::zeros(self.executor, self.rhs.len());
        let mut one = vec![0.0f32; 1];
        for _ in 0..TIMED_PRODUCTS {
            transport.barrier()?;
            let clock = Instant::now();
            let (solver, system, mut rank) = self.parts(transport);
            solver.spmv.apply(&mut rank, &system.matrix, &mut solver.vectors.u, &mut y)?;
            // On a device this read waits until the product is done.
            y.read_range(self.executor, 0, &mut one);
            best = best.min(all_max(transport, clock.elapsed().as_secs_f64())?);
        }
        let own: u64 = (0..self.matrix.sections.len()).map(|section| self.matrix.section_bytes(section)).sum();
        Ok((best, all_sum(transport, [own])?[0]))
    }
}

/// The rows in the layout and precision of the device, and the inverses of the diagonal blocks.
fn device_values(system: &RankSystem, layout: &SellLayout) -> (Vec<f32>, Vec<f32>) {
    let (arrays, own) = (&system.arrays, &system.plan.own);
    let scale = system.matrix_scale.recip();
    let mut values = vec![0.0f32; layout.slots() * BLOCK];
    let mut inverse_diagonal = vec![0.0f32; own.len() * 6];
    for (row, inverse) in inverse_diagonal.as_chunks_mut::<6>().0.iter_mut().enumerate() {
        for k in arrays.offsets[row] as usize..arrays.offsets[row + 1] as usize {
            let block: [f64; BLOCK] = std::array::from_fn(|c| arrays.values.get(k * BLOCK + c) * scale);
            for (c, value) in block.iter().enumerate() {
                values[value_index(layout.block_address[k], c)] = *value as f32;
            }
            if arrays.columns[k] as usize == own.start + row {
                *inverse = inverse_block(&block).map(|v| v as f32);
            }
        }
    }
    (values, inverse_diagonal)
}

fn all_max(transport: &mut dyn Transport, own: f64) -> Result<f64, TransportError> {
    let mut gathered = Vec::new();
    transport.all_gather(&[own], &mut gathered)?;
    Ok(gathered.iter().flatten().copied().fold(own, f64::max))
}

fn all_sum<const N: usize>(transport: &mut dyn Transport, own: [u64; N]) -> Result<[u64; N], TransportError> {
    let mut gathered = Vec::new();
    // Exact, because counts stay far below 2^53.
    transport.all_gather(&own.map(|v| v as f64), &mut gathered)?;
    let mut sums = [0; N];
    for values in &gathered {
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum += *value as u64;
        }
    }
    Ok(sums)
}
