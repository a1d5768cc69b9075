//! The matrix of a state by itself, for benchmarks: assembled with its contacts and multiplied, without a solve or
//! motion. If the matrix is not stored (`comparison`), the same calls multiply from the element records.

use std::ops::Range;
use std::time::Instant;

use super::span::Span;
use super::stats::StepStats;
use super::{Failure, RankCloth, Simulation};
use crate::context::RankContext;
use crate::gpu::DeviceVec;
use crate::solver::Operator;
use crate::telemetry::Event;
use crate::transport::{Transport, TransportError};

impl Simulation {
    /// Runs stages 1 to 4 of step `step` (from 1) [Li et al. 2020, Fig. 2]: contacts, element records, matrix,
    /// right-hand side. Positions and velocities do not change. Returns the number of contacts over all ranks.
    pub fn assemble(&mut self, transport: &mut dyn Transport, step: u32) -> Result<u64, Failure> {
        let span = Span::of_step(step, self.cloth.settings.step_s);
        let mut stats = StepStats { step, ..StepStats::default() };
        let mut rank = RankContext { executor: &self.executor, transport, recorder: &mut self.recorder };
        let cloth = &mut self.cloth;
        cloth.move_pins(&mut rank, span)?;
        cloth.find_contacts(&mut rank, span, &mut stats)?;
        cloth.state.exchange(&mut rank, cloth.solver.spmv.halo())?;
        cloth.element_records(&mut rank, span, span.length_s);
        cloth.fill_matrix(&mut rank, span, span.length_s);
        match self.executor.take_fault() {
            Some(fault) => Err(Failure::in_step(step, fault)),
            None => Ok(stats.contacts),
        }
    }

    /// Own rows in the global order.
    pub fn rows(&self) -> Range<usize> {
        self.cloth.rows.clone()
    }

    /// A x of the assembled matrix. `x` and the result: xyz per own row.
    pub fn product(&mut self, transport: &mut dyn Transport, x: &[f32]) -> Result<Vec<f32>, TransportError> {
        let own = self.cloth.solver.spmv.own_start();
        self.cloth.solver.vectors.u.write_range(&self.executor, own, x);
        self.with_operator(transport, |rank, operator, u, y| {
            operator.apply(rank, u, y)?;
            Ok(y.read(rank.executor))
        })
    }

    /// Makes one product and returns its events.
    pub fn record_product(&mut self, transport: &mut dyn Transport) -> Result<Vec<Event>, TransportError> {
        self.recorder.begin_step(1, true);
        let done = self.with_operator(transport, |rank, operator, u, y| operator.apply(rank, u, y));
        let events = self.recorder.take();
        self.recorder.begin_step(1, false);
        done.map(|()| events)
    }

    /// Start and end of each of `repeat` products on this rank, after one product for warm-up. All ranks wait for each
    /// other before each product, so that the earliest start and the latest end over the ranks belong to the same
    /// product.
    pub fn time_products(
        &mut self,
        transport: &mut dyn Transport,
        repeat: u32,
    ) -> Result<Vec<(Instant, Instant)>, TransportError> {
        self.with_operator(transport, |rank, operator, u, y| time_operator(rank, operator, u, y, repeat))
    }

    /// Bytes that a product moves on this rank: the matrix or the records, and the result.
    pub fn product_bytes(&self) -> u64 {
        self.cloth.matrix.product_bytes(&self.cloth.elements, &self.cloth.system)
    }

    /// Calls `work` with the matrix of the last assembly, the vector that it multiplies and a vector for the result.
    fn with_operator<T>(
        &mut self,
        transport: &mut dyn Transport,
        mut work: impl FnMut(&mut RankContext<'_>, &mut dyn Operator, &mut DeviceVec<f32>, &mut DeviceVec<f32>) -> T,
    ) -> T {
        let mut rank = RankContext { executor: &self.executor, transport, recorder: &mut self.recorder };
        let RankCloth { rows, elements, system, matrix, solver, .. } = &mut self.cloth;
        let mut y = DeviceVec::zeros(rank.executor, rows.len() * 3);
        let mut done = None;
        matrix.with_operator(&mut rank, elements, system, solver, &mut |rank, operator, u| {
            done = Some(work(rank, operator, u, &mut y));
        });
        done.expect("the matrix calls what it is given")
    }
}

/// Start and end of each of `repeat` products y = A u, after one product for warm-up.
pub(super) fn time_operator(
    rank: &mut RankContext<'_>,
    operator: &mut dyn Operator,
    u: &mut DeviceVec<f32>,
    y: &mut DeviceVec<f32>,
    repeat: u32,
) -> Result<Vec<(Instant, Instant)>, TransportError> {
    let mut times = Vec::with_capacity(repeat as usize);
    for round in 0..=repeat {
        rank.transport.barrier()?;
        let start = Instant::now();
        operator.apply(rank, u, y)?;
        rank.executor.finish();
        if round > 0 {
            times.push((start, Instant::now()));
        }
    }
    Ok(times)
}
