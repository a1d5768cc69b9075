//! Preconditioned conjugate gradients with one reduction per iteration [Chronopoulos and Gear 1989].
//!
//! The residual is the recursive one. In f32 it follows the true residual down to about 1e-5 of the start; for lower
//! tolerances callers correct with a residual in f64 (`linear_system::solve`).

use thiserror::Error;

use super::operator::Operator;
use super::preconditioner::{IterationSums, Preconditioner};
use super::vector::{PcgVectors, Scalars};
use crate::context::RankContext;
use crate::gpu::DeviceVec;
use crate::partition::RowPartition;
use crate::telemetry::{Activity, EventName};
use crate::transport::TransportError;

/// Size of rounding errors in p'Ap relative to its terms, with f32 vectors and recurrences over hundreds of iterations.
const ROUNDING: f64 = 1e-4;
/// Down to this fraction of its start the recursive residual follows the true one; below it is rounding error.
const FOLLOWED: f64 = 1e-5;
/// The tolerance of the energy norm is this at least: smaller changes of the energy are rounding errors of single
/// precision, and a solve that waited for them would not end.
const ENERGY_TOLERANCE_LEAST: f64 = 1e-3;
/// Minimum number of iterations whose gain estimates the energy of the error.
const WINDOW: usize = 8;
/// A descent that breaks off is restarted with the same preconditioner only if it reduced the residual to this fraction
/// of its start.
const PROGRESS: f64 = 0.1;

/// Start and stopping rule of a solve; the same on all ranks.
#[derive(Clone, Copy, Debug)]
pub struct PcgParams {
    /// Stop when |r| <= relative_tolerance * |b - A x0| (2-norms over free rows).
    pub relative_tolerance: f64,
    /// True: besides, stop only when the energy norm of the error has fallen to `relative_tolerance` of its start, 1e-3
    /// at least. The 2-norm of a residual of stiff systems is that of forces within the cloth, which hide the forces
    /// that move it.
    pub energy: bool,
    /// Stop after this many iterations, converged or not.
    pub max_iterations: u32,
    /// True if x0 may differ from zero on some rank.
    pub nonzero_start: bool,
}

/// Result of a solve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PcgInfo {
    /// Number of updates of x.
    pub iterations: u32,
    /// |r| / |b - A x0|.
    pub relative_residual: f64,
    /// True if the tolerance was met.
    pub converged: bool,
    /// |b - A x0|, in the units of the right-hand side.
    pub start_residual: f64,
    /// Matrix-vector products of the solve, each with one exchange.
    pub products: u32,
}

/// Error that ends a solve.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
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

enum Descent {
    /// The tolerance or the iteration limit was reached.
    Done(PcgInfo),
    /// p' A p <= 0.
    Broken {
        info: PcgInfo,
        curvature: f64,
        /// Last residual divided by the first one.
        progress: f64,
        /// True if rounding in f32 with a positive definite matrix explains the sign.
        rounding: bool,
    },
}

/// The solver of one rank.
pub struct Pcg {
    sums: IterationSums,
    /// Progress of the current solve over all its descents.
    reached: Option<PcgInfo>,
    /// Squared energy norms by which the iterations of the current solve have reduced the error: running sums.
    gained: Vec<f64>,
}

impl Pcg {
    /// A solver for the ranks of `partition`.
    pub fn new(partition: &RowPartition) -> Pcg {
        Pcg { sums: IterationSums::new(partition), reached: None, gained: Vec::new() }
    }

    /// Solves A x = b for x = `vectors.x`. Pinned rows keep their start value.
    ///
    /// A descent that breaks off is followed by another one, which begins with the true residual. If the last descent
    /// made little progress, the next one uses the next of `preconditioners`. The reason is the coarse level: it sums
    /// forces that cancel, and its solution can be many times as large as the displacement of a single row. On stiff
    /// systems rounding therefore breaks its descent off long before that of Jacobi. The solve ends when the last
    /// preconditioner breaks off without progress.
    ///
    /// # Errors
    /// A transfer failed, a value is not finite, or the matrix is indefinite beyond rounding.
    pub fn solve<A: Operator>(
        &mut self,
        rank: &mut RankContext<'_>,
        operator: &mut A,
        preconditioners: &mut [&mut dyn Preconditioner<A>],
        b: &DeviceVec<f32>,
        vectors: &mut PcgVectors,
        params: &PcgParams,
    ) -> Result<PcgInfo, PcgError> {
        let mut chosen = 0;
        self.reached = None;
        self.gained.clear();
        loop {
            let preconditioner = &mut *preconditioners[chosen];
            match self.descend(rank, operator, preconditioner, b, vectors, params)? {
                Descent::Done(info) => return Ok(info),
                Descent::Broken { info, curvature, progress, rounding } => {
                    if progress > PROGRESS {
                        chosen += 1;
                    }
                    if chosen == preconditioners.len() {
                        let iteration = info.iterations;
                        return if rounding {
                            Ok(info)
                        } else {
                            Err(PcgError::NotPositiveDefinite { iteration, curvature })
                        };
                    }
                    self.reached = Some(info);
                }
            }
        }
    }

    /// One descent from x.
    ///
    /// Bytes per row and iteration that the kernels of one rank move, counted by a trace of a flag of 20,300 vertices
    /// without contacts.
    /// ```text
    ///              Jacobi      chain sweep                    sweep by color
    /// w = A u      529         72 between chunks              529
    /// w.u, P' w    24          24                             60
    /// p, s, x, r   156         with u                         156
    /// u = M^-1 r   with r      439, with w inside chunks      620
    /// ```
    /// Between ranks: the halo rows, 12 bytes each, and one all-gather of at most 54 numbers per rank, plus three
    /// numbers per own chunk with a coarse level.
    fn descend<A: Operator>(
        &mut self,
        rank: &mut RankContext<'_>,
        operator: &mut A,
        preconditioner: &mut dyn Preconditioner<A>,
        b: &DeviceVec<f32>,
        v: &mut PcgVectors,
        params: &PcgParams,
    ) -> Result<Descent, PcgError> {
        let (sums, before, gained) = (&mut self.sums, self.reached, &mut self.gained);
        let (mut iteration, mut products) = before.map_or((0, 0), |info| (info.iterations, info.products));
        if params.nonzero_start || before.is_some() {
            // w = A x0, through u because only u has halo rows
            v.u.copy_range(rank.executor, v.own_start, &v.x, 0, v.x.len());
            operator.apply(rank, &mut v.u, &mut v.w)?;
            products += 1;
        } else {
            // w = A x0 = 0
            v.w.fill_zero(rank.executor);
        }
        // p = 0; s = A p = 0; r = b - w; u = M^-1 r
        v.p.fill_zero(rank.executor);
        v.s.fill_zero(rank.executor);
        preconditioner.start(rank, sums, b, v)?;

        let mut last: Option<(f64, f64)> = None;
        let mut first_residual = None;
        loop {
            rank.transport.alive()?;
            // w = A u
            preconditioner.product(rank, operator, sums, v)?;
            products += 1;
            // gamma = r.u; rho = r.r; delta = w.u: one all-reduce
            let start = rank.recorder.now();
            let [gamma, rho, delta] = sums.all_reduce(rank.transport)?;
            rank.recorder.end(EventName::AllReduce, Activity::Wait, start, sums.message_bytes(), 0);
            if !(gamma.is_finite() && rho.is_finite() && delta.is_finite()) {
                return Err(PcgError::NotFinite { iteration });
            }
            let residual = rho.sqrt();
            let first = *first_residual.get_or_insert(residual);
            let start_residual = before.map_or(first, |info| info.start_residual);
            let relative_residual = if start_residual > 0.0 { residual / start_residual } else { 0.0 };
            let converged = relative_residual <= params.relative_tolerance
                && (!params.energy || energy_converged(gained, params.relative_tolerance.max(ENERGY_TOLERANCE_LEAST)));
            let info = PcgInfo { iterations: iteration, relative_residual, converged, start_residual, products };
            if converged || iteration >= params.max_iterations {
                return Ok(Descent::Done(info));
            }
            // beta = gamma / gamma_old; p'Ap = delta - beta gamma / alpha_old
            let (beta, curvature) = last.map_or((0.0, delta), |(gamma_old, alpha_old)| {
                let beta = gamma / gamma_old;
                (beta, delta - beta * gamma / alpha_old)
            });
            if curvature <= 0.0 {
                // The recurrence for p'Ap cancels. A negative value of the size of its rounding error shows that f32
                // has reached its accuracy for this matrix, not that the matrix is indefinite.
                let rounding = relative_residual <= FOLLOWED || curvature.abs() <= ROUNDING * delta;
                return Ok(Descent::Broken { info, curvature, progress: residual / first, rounding });
            }
            // alpha = gamma / p'Ap
            let alpha = gamma / curvature;
            // p = u + beta p; s = w + beta s; x += alpha p; r -= alpha s; u = M^-1 r
            preconditioner.advance(rank, Scalars { alpha, beta }, sums, v);
            last = Some((gamma, alpha));
            iteration += 1;
            // |e|_A^2 falls by alpha gamma [Hestenes and Stiefel 1952].
            gained.push(gained.last().unwrap_or(&0.0) + alpha * gamma);
        }
    }
}

/// True if the last quarter of the iterations, at least [`WINDOW`], has reduced the squared energy norm of the error by
/// at most `tolerance`^2 of what all have: an estimate of the error at the start of the window [Strakos and Tichy
/// 2002].
fn energy_converged(gained: &[f64], tolerance: f64) -> bool {
    let window = (gained.len() / 4).max(WINDOW);
    let Some(before) = gained.len().checked_sub(window + 1) else { return gained.last().is_none_or(|&all| all == 0.0) };
    let all = gained[gained.len() - 1];
    all - gained[before] <= tolerance * tolerance * all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_energy_of_the_error_is_told_by_the_last_iterations() {
        let sums = |ratio: f64, iterations: i32| -> Vec<f64> {
            (1..=iterations).map(|i| (1.0 - ratio.powi(i)) / (1.0 - ratio)).collect()
        };
        assert!(energy_converged(&[], 0.01) && energy_converged(&[0.0], 0.01));
        assert!(!energy_converged(&sums(0.1, WINDOW as i32), 0.01), "too early to tell");
        // 1 % in the norm is 1e-4 in its square: 0.5^14.
        let at = (1..100).find(|&i| energy_converged(&sums(0.5, i), 0.01)).expect("ends");
        assert_eq!(at, 14 + WINDOW as i32);
        assert!(!energy_converged(&sums(0.99, 100), 0.01));
    }
}
