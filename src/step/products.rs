//! The matrix of a state on its own, for benchmarks: assembled with its contacts and multiplied, without solving or moving
//! anything. Where the matrix is not stored, the same calls make products from the element records.

use std::ops::Range;
use std::time::Instant;

use super::collisions::Span;
use super::stats::StepStats;
use super::{Failure, SetupError, Simulation, element_matrix};
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor};
use crate::solver::comparison::{GatherFirst, MatrixFree, MatrixFreeProduct};
use crate::solver::{ExchangeMode, LinearSolver, Operator, StoredMatrix};
use crate::telemetry::Event;
use crate::transport::{Transport, TransportError};

impl Simulation {
    /// Gives the stored matrix up: from now on every product is computed from the element records, with block Jacobi as the
    /// preconditioner. Own rows have the same bits on any number of ranks, but not those of the stored product.
    ///
    /// # Errors
    /// On a device, and with whole sub-vectors: only the cpu executor and halo rows have such a product.
    pub fn drop_matrix(&mut self) -> Result<(), SetupError> {
        if !matches!(self.executor, Executor::Cpu(_)) || self.mode != ExchangeMode::Halo {
            return Err(SetupError::MatrixFree);
        }
        self.fill_tables.keep_lists(&self.executor);
        self.matrix.clear(&self.executor);
        self.contacts.matrix_free = true;
        self.solver.keep_jacobi();
        self.matrix_free = Some(MatrixFree::default());
        Ok(())
    }

    /// Stages 1 to 4 of step `step` (from 1) [Li et al. 2020, Fig. 2]: contacts, element records, matrix, right-hand side.
    /// Positions and velocities stay. Returns the number of contacts over all ranks.
    pub fn assemble(&mut self, transport: &mut dyn Transport, step: u32) -> Result<u64, Failure> {
        let step_s = self.settings.step_s;
        let span = Span { start_s: (step - 1) as f64 * step_s, end_s: step as f64 * step_s, length_s: step_s };
        let mut stats = StepStats { step, ..StepStats::default() };
        self.move_pins(span);
        self.find_contacts(transport, span, &mut stats)?;
        self.exchange_state(transport)?;
        self.element_records(span);
        self.fill_matrix(span);
        match self.executor.take_fault() {
            Some(fault) => Err(Failure::in_step(step, fault)),
            None => Ok(stats.contacts),
        }
    }

    /// Own rows in the global order.
    pub fn rows(&self) -> Range<usize> {
        self.rows_start..self.rows_start + self.own_rows
    }

    /// A x of the assembled matrix; `x`: xyz per own row, as the result.
    pub fn product(&mut self, transport: &mut dyn Transport, x: &[f32]) -> Result<Vec<f32>, TransportError> {
        let mut y = DeviceVec::zeros(&self.executor, self.own_rows * 3);
        let own = self.solver.spmv.own_start();
        self.solver.vectors.u.write_range(&self.executor, own, x);
        self.multiply(transport, &mut y)?;
        Ok(y.read(&self.executor))
    }

    /// Makes one product and returns its events.
    pub fn record_product(&mut self, transport: &mut dyn Transport) -> Result<Vec<Event>, TransportError> {
        let mut y = DeviceVec::zeros(&self.executor, self.own_rows * 3);
        self.recorder.begin_step(1, true);
        let done = self.multiply(transport, &mut y);
        let events = self.recorder.take();
        self.recorder.begin_step(1, false);
        done.map(|()| events)
    }

    /// Start and end of each of `repeat` products on this rank, after one that warms up. All ranks wait for each other before
    /// each, so that the earliest start and the latest end over the ranks belong together.
    pub fn time_products(
        &mut self,
        transport: &mut dyn Transport,
        repeat: u32,
    ) -> Result<Vec<(Instant, Instant)>, TransportError> {
        let mut y = DeviceVec::zeros(&self.executor, self.own_rows * 3);
        self.with_operator(transport, |rank, operator, u| time_operator(rank, operator, u, &mut y, repeat))
    }

    /// As [`Simulation::time_products`] with products that wait for all sub-vectors before they multiply
    /// [Cevahir et al. 2009]; with whole sub-vectors only.
    pub fn time_gather_first(
        &mut self,
        transport: &mut dyn Transport,
        repeat: u32,
    ) -> Result<Vec<(Instant, Instant)>, TransportError> {
        let mut y = DeviceVec::zeros(&self.executor, self.own_rows * 3);
        let mut rank = RankContext { executor: &self.executor, transport, recorder: &mut self.recorder };
        let LinearSolver { spmv, vectors, .. } = &mut self.solver;
        let mut operator = GatherFirst::new(spmv, self.contacts.system(&self.matrix));
        time_operator(&mut rank, &mut operator, &mut vectors.u, &mut y, repeat)
    }

    /// Bytes that a product moves on this rank: the matrix or the records, and the result.
    pub fn product_bytes(&self) -> u64 {
        if self.matrix_free.is_some() {
            return element_matrix!(self).product_bytes();
        }
        let system = self.contacts.system(&self.matrix);
        let sections = 0..self.matrix.sections.len();
        sections.map(|section| system.section_bytes(section)).sum::<u64>() + self.own_rows as u64 * 12
    }

    fn multiply(&mut self, transport: &mut dyn Transport, y: &mut DeviceVec<f32>) -> Result<(), TransportError> {
        self.with_operator(transport, |rank, operator, u| operator.apply(rank, u, y))
    }

    /// Calls `work` with the operator of the last assembly and the vector that it multiplies.
    fn with_operator<T>(
        &mut self,
        transport: &mut dyn Transport,
        work: impl FnOnce(&mut RankContext<'_>, &mut dyn Operator, &mut DeviceVec<f32>) -> T,
    ) -> T {
        let mut rank = RankContext { executor: &self.executor, transport, recorder: &mut self.recorder };
        let LinearSolver { spmv, vectors, .. } = &mut self.solver;
        match &mut self.matrix_free {
            None => {
                let matrix = self.contacts.system(&self.matrix);
                work(&mut rank, &mut StoredMatrix { spmv, matrix }, &mut vectors.u)
            }
            Some(kernel) => {
                let elements = element_matrix!(self);
                work(&mut rank, &mut MatrixFreeProduct { spmv, elements, kernel }, &mut vectors.u)
            }
        }
    }
}

/// Start and end of each of `repeat` products y = A u, after one that warms up.
fn time_operator(
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
