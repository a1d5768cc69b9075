//! Preconditioned conjugate gradients with one reduction per iteration [Chronopoulos and Gear 1989], 3x3-block Jacobi.
//!
//! Per iteration and row: one SpMV (`spmv`), one fused vector pass (156 bytes), one dot product (24 bytes); one halo
//! exchange and one all-gather of at most 54 numbers per rank. The residual is the recursive one: in f32 it follows the
//! true residual down to about 1e-5 of the start; below that callers correct with a residual in f64 (`cli::solve`).

use thiserror::Error;

use super::pipelined::PipelinedSpmv;
use super::reduction::ReductionTree;
use super::schwarz::Schwarz;
use super::vector::{ChunkSums, VectorOps};
use crate::assembly::SystemMatrix;
use crate::gpu::{DeviceVec, Executor};
use crate::partition::RowPartition;
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Transport, TransportError};

/// Size of rounding errors in p'Ap relative to its terms: f32 vectors, recurrences over hundreds of iterations.
const ROUNDING: f64 = 1e-4;
/// Down to this part of the start the recursive residual follows the true one; below, it is all rounding.
const FOLLOWED: f64 = 1e-5;
/// Part of its start to which a descent that broke off must have brought the residual for another one of its kind to be worth
/// while.
const PROGRESS: f64 = 0.1;

/// When to stop.
#[derive(Clone, Copy, Debug)]
pub struct PcgParams {
    /// Stop when |r| <= this * |b - A x0| (2-norms over free rows).
    pub relative_tolerance: f64,
    /// Stop after this many iterations, converged or not.
    pub max_iterations: u32,
}

/// How it ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PcgInfo {
    /// Updates of x.
    pub iterations: u32,
    /// |r| / |b - A x0|.
    pub relative_residual: f64,
    /// True if the tolerance was met.
    pub converged: bool,
    /// |b - A x0|, in the units of the right-hand side.
    pub start_residual: f64,
    /// Matrix-vector products done, each with one exchange.
    pub products: u32,
}

/// Why there is no solution.
#[derive(Debug, Error)]
pub enum PcgError {
    /// A transfer failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A NaN or infinity appeared.
    #[error("the solve met a value that is not finite in iteration {iteration}")]
    NotFinite { iteration: u32 },
    /// p' A p <= 0.
    #[error("the matrix is not positive definite: p'Ap = {curvature:.3e} in iteration {iteration}")]
    NotPositiveDefinite { iteration: u32, curvature: f64 },
}

/// Vectors of a solve on the own rows (xyz per row); `u` also holds halo rows.
pub struct PcgVectors {
    /// Preconditioned residual, local rows.
    pub u: DeviceVec<f32>,
    /// Start value in, solution out.
    pub x: DeviceVec<f32>,
    r: DeviceVec<f32>,
    w: DeviceVec<f32>,
    p: DeviceVec<f32>,
    s: DeviceVec<f32>,
}

impl PcgVectors {
    /// Zero vectors for `rows` own rows and `local_len` values of a local vector.
    pub fn new(executor: &Executor, rows: usize, local_len: usize) -> PcgVectors {
        let own = || DeviceVec::zeros(executor, rows * 3);
        PcgVectors { u: DeviceVec::zeros(executor, local_len), x: own(), r: own(), w: own(), p: own(), s: own() }
    }

    /// Makes room for local vectors of `local_len` values. Never shrinks; halo rows of `u` are received anew in every
    /// product, so nothing of it needs to be kept.
    pub fn grow(&mut self, executor: &Executor, local_len: usize) {
        if local_len > self.u.len() {
            self.u.resize(executor, local_len);
        }
    }

    /// Device bytes.
    pub fn bytes(&self) -> u64 {
        self.u.held_bytes() + 5 * self.x.bytes()
    }
}

/// Why a descent went no further.
struct Broken {
    /// p' A p.
    curvature: f64,
    /// Its last residual over its first.
    progress: f64,
    /// True if that is what f32 makes of a positive definite matrix.
    rounding: bool,
}

/// The solver of one rank.
pub struct Pcg {
    ops: VectorOps,
    tree: ReductionTree,
    chunk_sums: Vec<ChunkSums>,
    /// Sums of w over the own chunks, and over all of them.
    own_restricted: Vec<f64>,
    restricted: Vec<f64>,
}

impl Pcg {
    /// A solver for rank `rank`'s rows.
    pub fn new(executor: &Executor, partition: &RowPartition, rank: usize) -> Pcg {
        let rows = partition.rows_of(rank).len();
        Pcg {
            ops: VectorOps::new(executor, rows, partition.chunk_rows()),
            tree: ReductionTree::new(partition),
            chunk_sums: Vec::new(),
            own_restricted: Vec::new(),
            restricted: Vec::new(),
        }
    }

    /// Solves A x = b for x = `vectors.x`. Rows with a zero `inverse_diagonal` keep their start value (pins). `nonzero_start`
    /// says that x may differ from zero on some rank; all ranks must agree on it. `schwarz`: the preconditioner, set up with this
    /// matrix; without it, block Jacobi.
    ///
    /// The coarse level sums forces that cancel, and its solution can be many times as large as what a row could do by itself: on
    /// stiff systems rounding breaks the descent off long before it would with Jacobi. Then another one begins with the true
    /// residual, and when that does not help, one with Jacobi.
    pub fn solve(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        spmv: &mut PipelinedSpmv,
        matrix: &SystemMatrix<'_>,
        inverse_diagonal: &DeviceVec<f32>,
        mut schwarz: Option<&mut Schwarz>,
        b: &DeviceVec<f32>,
        vectors: &mut PcgVectors,
        nonzero_start: bool,
        params: &PcgParams,
        recorder: &mut Recorder,
    ) -> Result<PcgInfo, PcgError> {
        let mut before: Option<PcgInfo> = None;
        loop {
            let (info, broken) = self.descend(
                executor,
                transport,
                spmv,
                matrix,
                inverse_diagonal,
                schwarz.as_deref_mut(),
                b,
                vectors,
                nonzero_start,
                before,
                params,
                recorder,
            )?;
            let Some(Broken { curvature, progress, rounding }) = broken else { return Ok(info) };
            if progress > PROGRESS && schwarz.take().is_none() {
                if rounding {
                    return Ok(info);
                }
                return Err(PcgError::NotPositiveDefinite { iteration: info.iterations, curvature });
            }
            before = Some(info);
        }
    }

    /// One descent; how it broke off, if it did. `before`: what others have reached in x, of this solve.
    fn descend(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        spmv: &mut PipelinedSpmv,
        matrix: &SystemMatrix<'_>,
        inverse_diagonal: &DeviceVec<f32>,
        mut schwarz: Option<&mut Schwarz>,
        b: &DeviceVec<f32>,
        vectors: &mut PcgVectors,
        nonzero_start: bool,
        before: Option<PcgInfo>,
        params: &PcgParams,
        recorder: &mut Recorder,
    ) -> Result<(PcgInfo, Option<Broken>), PcgError> {
        let own = spmv.own_start();
        let v = vectors;
        let (done, mut products) = before.map_or((0, 0), |info| (info.iterations, info.products));
        self.own_restricted.clear();
        if nonzero_start || before.is_some() {
            // w = A x0, through u because only u has halo rows.
            v.u.copy_range(executor, own, &v.x, 0, v.x.len());
            spmv.apply(executor, transport, matrix, &mut v.u, &mut v.w, recorder)?;
            products += 1;
        } else {
            v.w.fill_zero(executor);
        }
        v.p.fill_zero(executor);
        v.s.fill_zero(executor);
        // r = b - A x0; u = M^-1 r; gamma = r.u
        self.ops.start(executor, b, &v.w, inverse_diagonal, &mut v.r, &mut v.u, own);

        if let Some(schwarz) = schwarz.as_deref_mut() {
            self.start_schwarz(executor, transport, schwarz, inverse_diagonal, v, own)?;
        }

        let (mut gamma_old, mut alpha_old) = (1.0, 1.0);
        let (mut start_residual, mut own_start) = (0.0, 0.0);
        for iteration in done.. {
            transport.alive()?;
            // w = A u; delta = w.u, together with gamma = r.u and r.r of the last pass: one all-reduce
            match schwarz.as_deref_mut() {
                None => {
                    spmv.apply(executor, transport, matrix, &mut v.u, &mut v.w, recorder)?;
                    let start = recorder.before_kernels();
                    self.ops.dot(executor, &v.w, &v.u, own);
                    self.ops.sums(executor, &mut self.chunk_sums);
                    let bytes = v.w.bytes() * 2;
                    recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, v.w.len() as u64 * 2);
                }
                Some(schwarz) => {
                    if let Some(elastic) = schwarz.outer() {
                        // The sweep has left the product with the blocks inside chunks in w.
                        spmv.accumulate = true;
                        let outer = SystemMatrix { elastic, contact: matrix.contact, elements: None };
                        let applied = spmv.apply(executor, transport, &outer, &mut v.u, &mut v.w, recorder);
                        spmv.accumulate = false;
                        applied?;
                    } else {
                        spmv.apply(executor, transport, matrix, &mut v.u, &mut v.w, recorder)?;
                    }
                    let start = recorder.before_kernels();
                    let (scalars, restricted) = (&mut self.chunk_sums, &mut self.own_restricted);
                    schwarz.sums(executor, inverse_diagonal, &mut v.w, &v.u, own, scalars, restricted);
                    let bytes = schwarz.sums_bytes(v.w.bytes());
                    recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, v.w.len() as u64 * 3);
                }
            }
            products += 1;
            let start = recorder.now();
            let (tree, own_restricted) = (&mut self.tree, &self.own_restricted);
            let [gamma, rr, delta] =
                tree.all_reduce_and_gather(transport, &self.chunk_sums, own_restricted, &mut self.restricted)?;
            recorder.end(EventName::AllReduce, Activity::Wait, start, 24, 0);
            if !(gamma.is_finite() && rr.is_finite() && delta.is_finite()) {
                return Err(PcgError::NotFinite { iteration });
            }
            let residual = rr.sqrt();
            if iteration == done {
                own_start = residual;
                start_residual = before.map_or(residual, |info| info.start_residual);
            }
            let relative = if start_residual > 0.0 { residual / start_residual } else { 0.0 };
            let converged = relative <= params.relative_tolerance;
            let info =
                PcgInfo { iterations: iteration, relative_residual: relative, converged, start_residual, products };
            if converged || iteration >= params.max_iterations {
                return Ok((info, None));
            }
            // beta = gamma / gamma_old; p'Ap = delta - beta gamma / alpha_old; alpha = gamma / p'Ap
            let beta = if iteration == done { 0.0 } else { gamma / gamma_old };
            let curvature = if iteration == done { delta } else { delta - beta * gamma / alpha_old };
            if curvature <= 0.0 {
                // The recurrence for p'Ap cancels; a negative value of the size of its rounding says that f32 has given what it
                // can for this matrix, not that the matrix is indefinite.
                let rounding = relative <= FOLLOWED || curvature.abs() <= ROUNDING * delta;
                return Ok((info, Some(Broken { curvature, progress: residual / own_start, rounding })));
            }
            let alpha = gamma / curvature;
            let (alpha_f32, beta_f32) = (alpha as f32, beta as f32);
            if schwarz.as_deref().is_none_or(|schwarz| !schwarz.updates()) {
                let start = recorder.before_kernels();
                let PcgVectors { u, x, r, w, p, s } = &mut *v;
                self.ops.update(executor, alpha_f32, beta_f32, w, inverse_diagonal, u, own, p, s, x, r);
                let (bytes, flops) = (w.bytes() * 13, w.len() as u64 * 18);
                recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, flops);
            }
            if let Some(schwarz) = schwarz.as_deref_mut() {
                let start = recorder.before_kernels();
                schwarz.coarse.update(&self.restricted, alpha, beta);
                let PcgVectors { u, x, r, w, p, s } = &mut *v;
                schwarz.sweep(executor, Some((alpha_f32, beta_f32)), inverse_diagonal, w, u, own, p, s, x, r);
                let (bytes, flops) = (schwarz.sweep_bytes(), schwarz.sweep_flops());
                recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, flops);
            }
            (gamma_old, alpha_old) = (gamma, alpha);
        }
        unreachable!("the loop ends at max_iterations")
    }

    /// First coarse correction, u and the inner part of w, from r.
    fn start_schwarz(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        schwarz: &mut Schwarz,
        inverse_diagonal: &DeviceVec<f32>,
        v: &mut PcgVectors,
        own: usize,
    ) -> Result<(), TransportError> {
        // The sums of r; r is zero on pinned rows.
        let PcgVectors { u, x, r, w, p, s } = v;
        schwarz.sums(executor, inverse_diagonal, r, u, own, &mut self.chunk_sums, &mut self.own_restricted);
        let (sums, restricted) = (&self.chunk_sums, &mut self.restricted);
        self.tree.all_reduce_and_gather(transport, sums, &self.own_restricted, restricted)?;
        schwarz.coarse.start(restricted);
        schwarz.sweep(executor, None, inverse_diagonal, w, u, own, p, s, x, r);
        Ok(())
    }
}
