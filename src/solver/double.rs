//! Preconditioned conjugate gradients in double precision [Hestenes and Stiefel 1952], on the host. It takes over where
//! single precision cannot solve a system.
//!
//! Halo values travel as pairs of f32 (48 bits). A rank rounds its own values alike before it multiplies, so the bits
//! do not depend on the number of ranks.

use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::math::DIM;
use crate::partition::{HaloPlan, RowPartition};
use crate::telemetry::Recorder;
use crate::transport::{Transport, TransportError};

use super::exchange::{HaloExchange, TrafficCounter};
use super::reduction::ReductionTree;

/// A direction p with p'Ap below this fraction of p'Dp (D: diagonal of A) has no stiffness within the rounding of f64.
const SINGULAR: f64 = 1e-14;

/// A symmetric matrix that a rank multiplies on the host.
pub trait DoubleOperator {
    /// y = A x on the own rows. `x`: local vector with valid halo rows; both three values per row. Zero on pinned rows.
    fn multiply(&self, x: &[f64], y: &mut [f64]);
    /// Inverse of the diagonal block of an own row as xx, xy, xz, yy, yz, zz; zeros on a pinned row.
    fn inverse(&self, row: usize) -> [f64; 6];
    /// Diagonal value of an own scalar row.
    fn diagonal(&self, value: usize) -> f64;
}

/// Why a descent ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DoubleEnd {
    /// The recursive residual met the tolerance.
    Converged,
    /// The iteration limit was reached.
    Limit,
    /// p'Ap is negative beyond rounding.
    Negative(f64),
    /// p'Ap is zero within rounding: the matrix is singular, or no correction is left that f64 can tell.
    Singular,
    /// A value is not finite.
    NotFinite,
}

/// Result of a descent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DoubleInfo {
    /// Number of updates of x; one product each.
    pub iterations: u32,
    /// Why it ended.
    pub end: DoubleEnd,
}

/// Vectors and exchange of one rank.
pub struct DoublePcg {
    host: Executor,
    halo: HaloExchange,
    high: DeviceVec<f32>,
    low: DeviceVec<f32>,
    tree: ReductionTree,
    chunk_values: usize,
    /// Local copy of p with its halo rows.
    local: Vec<f64>,
    p: Vec<f64>,
    u: Vec<f64>,
    w: Vec<f64>,
    /// The iterate with the smallest recursive residual.
    best: Vec<f64>,
}

impl DoublePcg {
    /// For the rows of rank `plan.rank`, whose work queue is `queue`.
    pub fn new(partition: &RowPartition, plan: HaloPlan, queue: Vec<QueueNode>) -> DoublePcg {
        let host = Executor::cpu(1);
        let (local, own) = (plan.local_rows * DIM, plan.own.len() * DIM);
        DoublePcg {
            high: DeviceVec::zeros(&host, local),
            low: DeviceVec::zeros(&host, local),
            tree: ReductionTree::new(partition),
            chunk_values: partition.chunk_rows() * DIM,
            local: vec![0.0; local],
            p: vec![0.0; own],
            u: vec![0.0; own],
            w: vec![0.0; own],
            best: vec![0.0; own],
            halo: HaloExchange::new(plan, queue),
            host,
        }
    }

    /// Solves A x = r from x = 0 until |r| <= `tolerance` * |r at the start| or `max_iterations`. `r` becomes the
    /// recursive residual of the last iterate; x is the best one, since the last steps along the null space of a
    /// singular matrix are long. All ranks call it together and get the same result.
    ///
    /// # Errors
    /// A transfer failed.
    #[expect(clippy::too_many_arguments, reason = "a rank's context, the system, and the stopping rule")]
    pub fn solve(
        &mut self,
        transport: &mut dyn Transport,
        recorder: &mut Recorder,
        traffic: &mut TrafficCounter,
        operator: &dyn DoubleOperator,
        r: &mut [f64],
        x: &mut [f64],
        tolerance: f64,
        max_iterations: u32,
    ) -> Result<DoubleInfo, TransportError> {
        x.fill(0.0);
        self.p.fill(0.0);
        let mut iterations = 0;
        let mut best_rho = f64::INFINITY;
        let mut first = None;
        let mut gamma_old = f64::INFINITY;
        let end = loop {
            transport.alive()?;
            self.precondition(operator, r);
            let [gamma, rho] = self.sums(transport, |s, i| [r[i] * s.u[i], r[i] * r[i]])?;
            let start = *first.get_or_insert(rho.sqrt());
            if rho < best_rho {
                best_rho = rho;
                self.best.copy_from_slice(x);
            }
            let end = if !(gamma.is_finite() && rho.is_finite()) {
                Some(DoubleEnd::NotFinite)
            } else if rho.sqrt() <= tolerance * start {
                Some(DoubleEnd::Converged)
            } else {
                (iterations >= max_iterations).then_some(DoubleEnd::Limit)
            };
            if let Some(end) = end {
                break end;
            }
            let beta = gamma / gamma_old;
            for (p, u) in self.p.iter_mut().zip(&self.u) {
                *p = u + beta * *p;
            }
            self.product(transport, recorder, traffic, operator)?;
            let [curvature, of_diagonal] =
                self.sums(transport, |s, i| [s.p[i] * s.w[i], s.p[i] * operator.diagonal(i) * s.p[i]])?;
            if !curvature.is_finite() {
                break DoubleEnd::NotFinite;
            }
            if curvature <= SINGULAR * of_diagonal {
                let negative = curvature < -SINGULAR.sqrt() * of_diagonal;
                break if negative { DoubleEnd::Negative(curvature) } else { DoubleEnd::Singular };
            }
            let alpha = gamma / curvature;
            for i in 0..r.len() {
                x[i] += alpha * self.p[i];
                r[i] -= alpha * self.w[i];
            }
            gamma_old = gamma;
            iterations += 1;
        };
        if end != DoubleEnd::Converged {
            x.copy_from_slice(&self.best);
        }
        Ok(DoubleInfo { iterations, end })
    }

    /// u = M^-1 r with the inverse diagonal blocks; r is zeroed on pinned rows.
    fn precondition(&mut self, operator: &dyn DoubleOperator, r: &mut [f64]) {
        for (row, (r, u)) in r.as_chunks_mut::<DIM>().0.iter_mut().zip(self.u.as_chunks_mut::<DIM>().0).enumerate() {
            let [xx, xy, xz, yy, yz, zz] = operator.inverse(row);
            if xx == 0.0 {
                *r = [0.0; DIM];
            }
            let [x, y, z] = *r;
            *u = [xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z];
        }
    }

    /// w = A p. Rounds p to a pair of f32.
    fn product(
        &mut self,
        transport: &mut dyn Transport,
        recorder: &mut Recorder,
        traffic: &mut TrafficCounter,
        operator: &dyn DoubleOperator,
    ) -> Result<(), TransportError> {
        let own = self.halo.plan().own.start * DIM..self.halo.plan().own.end * DIM;
        let (high, low) = (&mut self.high.as_mut_slice()[own.clone()], &mut self.low.as_mut_slice()[own]);
        for ((p, high), low) in self.p.iter_mut().zip(high).zip(low) {
            *high = *p as f32;
            *low = (*p - f64::from(*high)) as f32;
            *p = f64::from(*high) + f64::from(*low);
        }
        self.halo.start(&self.host, transport, &[&self.high, &self.low], recorder)?;
        self.halo.finish(&self.host, transport, &mut [&mut self.high, &mut self.low], recorder, traffic)?;
        for (x, (high, low)) in self.local.iter_mut().zip(self.high.as_slice().iter().zip(self.low.as_slice())) {
            *x = f64::from(*high) + f64::from(*low);
        }
        operator.multiply(&self.local, &mut self.w);
        Ok(())
    }

    /// Two sums over the values of all ranks, chunk by chunk.
    fn sums(
        &mut self,
        transport: &mut dyn Transport,
        of: impl Fn(&DoublePcg, usize) -> [f64; 2],
    ) -> Result<[f64; 2], TransportError> {
        let values = self.p.len();
        let chunks = (0..values).step_by(self.chunk_values).map(|first| {
            (first..(first + self.chunk_values).min(values)).fold([0.0; 2], |sum, i| {
                let [a, b] = of(self, i);
                [sum[0] + a, sum[1] + b]
            })
        });
        let chunks: Vec<[f64; 2]> = chunks.collect();
        self.tree.all_reduce(transport, &chunks)
    }
}
