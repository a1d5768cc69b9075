//! Positions and velocities of a rank: on the executor for all local rows, and a host copy of the own rows' state. The
//! copy is read from the executor once after each change, because every read makes a device wait; later readers share
//! it.

use std::cell::RefCell;
use std::ops::Range;
use std::rc::Rc;

use super::span::Span;
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor, ReadBatch};
use crate::integrator::advance::Advance;
use crate::integrator::pins::PinTargets;
use crate::integrator::scatter::Scatter;
use crate::math::DIM;
use crate::model::{PlasticCounts, RankArrays, RankState};
use crate::solver::{HaloExchange, TrafficCounter};
use crate::telemetry::{Activity, EventName};
use crate::transport::TransportError;

/// The state that the executor holds.
pub(super) struct StateVectors {
    /// Meters, xyz of all local rows, then of the obstacle vertices that contacts touch.
    pub positions: DeviceVec<f32>,
    /// m/s, in the order of `positions`.
    pub velocities: DeviceVec<f32>,
    /// Velocities at the start of the step where `velocities` are those that a first solve has found; as many.
    pub start_velocities: DeviceVec<f32>,
    /// Values of the own rows.
    own: Range<usize>,
    /// Host copy of the own rows; none after a change.
    copy: RefCell<Option<Rc<RankState>>>,
    /// Bytes received since the last [`StateVectors::take_received_bytes`].
    traffic: TrafficCounter,
    advance: Advance,
    scatter: Scatter,
}

impl StateVectors {
    /// The state of `arrays`; `own`: own rows among the local ones.
    pub(super) fn new(executor: &Executor, arrays: &RankArrays, own: Range<usize>) -> StateVectors {
        StateVectors {
            positions: DeviceVec::upload(executor, &arrays.positions),
            velocities: DeviceVec::upload(executor, &arrays.velocities),
            start_velocities: DeviceVec::zeros(executor, 0),
            own: own.start * 3..own.end * 3,
            copy: RefCell::new(None),
            traffic: TrafficCounter::default(),
            advance: Advance::new(executor),
            scatter: Scatter::new(executor),
        }
    }

    /// Positions and velocities of the own rows. It waits for the executor once if the state has changed since the last
    /// call.
    pub(super) fn own(&self, executor: &Executor) -> Rc<RankState> {
        if let Some(known) = &*self.copy.borrow() {
            return Rc::clone(known);
        }
        let mut state = RankState::zeros(self.own.len() / DIM, PlasticCounts::default());
        let mut batch = ReadBatch::new();
        batch.add(&self.positions, self.own.start, &mut state.positions);
        batch.add(&self.velocities, self.own.start, &mut state.velocities);
        batch.finish(executor);
        let state = Rc::new(state);
        self.copy.replace(Some(Rc::clone(&state)));
        state
    }

    /// As [`StateVectors::own`], within a step: the recorder counts the read.
    pub(super) fn recorded(&self, rank: &mut RankContext<'_>) -> Rc<RankState> {
        let known = self.copy.borrow().clone();
        known.unwrap_or_else(|| {
            let start = rank.recorder.now();
            let state = self.own(rank.executor);
            rank.recorder.end(EventName::ReadState, Activity::Transfer, start, state.bytes(), 0);
            state
        })
    }

    /// Sets positions and velocities of the own rows to those of `state`.
    pub(super) fn set(&mut self, executor: &Executor, state: Rc<RankState>) {
        self.positions.write_range(executor, self.own.start, &state.positions);
        self.velocities.write_range(executor, self.own.start, &state.velocities);
        self.copy.replace(Some(state));
    }

    /// Obstacle vertices (xyz) follow the `rows` local rows.
    pub(super) fn put_obstacles(&mut self, executor: &Executor, rows: usize, positions: &[f32], velocities: &[f32]) {
        for (local, obstacles) in [
            (&mut self.positions, positions),
            (&mut self.velocities, velocities),
            (&mut self.start_velocities, velocities),
        ] {
            let local_len = rows * 3 + obstacles.len();
            if local.len() < local_len {
                local.resize(executor, local_len);
            }
            local.write_range(executor, rows * 3, obstacles);
        }
    }

    /// Receives the halo rows.
    pub(super) fn exchange(
        &mut self,
        rank: &mut RankContext<'_>,
        halo: &mut HaloExchange,
    ) -> Result<(), TransportError> {
        let start = rank.recorder.now();
        halo.start(rank.executor, rank.transport, &[&self.positions, &self.velocities], rank.recorder)?;
        let vectors = &mut [&mut self.positions, &mut self.velocities];
        halo.finish(rank.executor, rank.transport, vectors, rank.recorder, &mut self.traffic)?;
        rank.recorder.end(EventName::ExchangeState, Activity::Compute, start, 0, 0);
        Ok(())
    }

    /// Receives the halo rows of the positions alone.
    pub(super) fn exchange_positions(
        &mut self,
        rank: &mut RankContext<'_>,
        halo: &mut HaloExchange,
    ) -> Result<(), TransportError> {
        halo.start(rank.executor, rank.transport, &[&self.positions], rank.recorder)?;
        halo.finish(rank.executor, rank.transport, &mut [&mut self.positions], rank.recorder, &mut self.traffic)
    }

    /// Receives the halo rows of `values`, three per local row.
    pub(super) fn exchange_values(
        &mut self,
        rank: &mut RankContext<'_>,
        halo: &mut HaloExchange,
        values: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        halo.start(rank.executor, rank.transport, &[&*values], rank.recorder)?;
        halo.finish(rank.executor, rank.transport, &mut [values], rank.recorder, &mut self.traffic)
    }

    /// As [`StateVectors::exchange`] between two solves, with the velocities of `start` beside those found.
    pub(super) fn exchange_again(
        &mut self,
        rank: &mut RankContext<'_>,
        halo: &mut HaloExchange,
        start: &RankState,
    ) -> Result<(), TransportError> {
        self.exchange(rank, halo)?;
        let velocities = &mut self.start_velocities;
        if velocities.len() < self.velocities.len() {
            velocities.resize(rank.executor, self.velocities.len());
        }
        velocities.write_range(rank.executor, self.own.start, &start.velocities);
        halo.start(rank.executor, rank.transport, &[&*velocities], rank.recorder)?;
        halo.finish(rank.executor, rank.transport, &mut [velocities], rank.recorder, &mut self.traffic)
    }

    /// Puts the own rows back where they were at `start`; velocities stay.
    pub(super) fn put_back(&mut self, executor: &Executor, start: &RankState) {
        self.copy.take();
        self.positions.write_range(executor, self.own.start, &start.positions);
    }

    /// `velocity_changes` (own rows) becomes those of `targets`, zero elsewhere.
    pub(super) fn prescribe(&self, executor: &Executor, targets: &PinTargets, velocity_changes: &mut DeviceVec<f32>) {
        velocity_changes.fill_zero(executor);
        self.scatter.apply(executor, &targets.rows, &targets.velocity_changes, 0, velocity_changes);
    }

    /// v += `velocity_changes` (own rows), x += dt v; then sets prescribed rows exactly.
    pub(super) fn advance(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        velocity_changes: &DeviceVec<f32>,
        targets: &PinTargets,
    ) {
        let (executor, first) = (rank.executor, self.own.start);
        let start = rank.recorder.before_kernels();
        self.copy.take();
        let (x, v) = (&mut self.positions, &mut self.velocities);
        self.advance.advance(executor, span.length_s as f32, velocity_changes, first, v, x);
        self.scatter.apply(executor, &targets.rows, &targets.velocities, first, v);
        self.scatter.apply(executor, &targets.rows, &targets.positions, first, x);
        let rows = self.own.len() as u64 / 3;
        rank.recorder.end(EventName::Advance, Activity::Compute, start, rows * 60, rows * 9);
    }

    /// Bytes received by [`StateVectors::exchange`] since the last call.
    pub(super) fn take_received_bytes(&mut self) -> u64 {
        std::mem::take(&mut self.traffic).received_bytes
    }

    /// Device bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.positions.bytes() + self.velocities.bytes() + self.start_velocities.bytes()
    }
}
