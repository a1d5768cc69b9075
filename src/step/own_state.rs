//! Host copy of the own rows' state. It is read from the executor once after each change, because on a device every read
//! is a wait; later readers share it.

use std::cell::RefCell;
use std::rc::Rc;

use super::Simulation;
use crate::gpu::ReadBatch;
use crate::math::DIM;
use crate::model::RankState;
use crate::telemetry::{Activity, EventName};

/// What the host knows of the state that the executor holds.
#[derive(Default)]
pub(super) struct StateCopy(RefCell<Option<Rc<RankState>>>);

impl StateCopy {
    /// The executor's state is about to change.
    pub fn forget(&self) {
        self.0.take();
    }

    /// The executor's state is `state`, bit for bit.
    pub fn is(&self, state: Rc<RankState>) {
        self.0.replace(Some(state));
    }
}

impl Simulation {
    /// The state of the own rows; one wait for the executor if it has changed since the last time.
    pub(super) fn own_state(&self) -> Rc<RankState> {
        if let Some(known) = &*self.copy.0.borrow() {
            return Rc::clone(known);
        }
        let mut state = RankState::zeros(self.own_rows);
        let mut batch = ReadBatch::new();
        batch.add(&self.positions, self.own_start, &mut state.positions);
        batch.add(&self.velocities, self.own_start, &mut state.velocities);
        batch.finish(&self.executor);
        let state = Rc::new(state);
        self.copy.is(Rc::clone(&state));
        state
    }

    /// Goes on from `state`, the own rows of a state that every rank is given before the next step. Nothing that earlier
    /// steps have left is used again: pins take hold anew, and collisions ask again where the cloth is.
    pub fn set_state(&mut self, state: RankState) {
        let values = self.own_rows * DIM;
        assert_eq!((state.positions.len(), state.velocities.len()), (values, values), "the state of the own rows");
        self.set_own_state(Rc::new(state));
        self.pins.release_all();
        self.pinned.fill_zero(&self.executor);
        if let Some(collisions) = &mut self.collisions {
            collisions.forget_state();
        }
        self.state_is_new = true;
    }

    /// The executor's state of the own rows becomes `state`.
    pub(super) fn set_own_state(&mut self, state: Rc<RankState>) {
        self.positions.write_range(&self.executor, self.own_start, &state.positions);
        self.velocities.write_range(&self.executor, self.own_start, &state.velocities);
        self.copy.is(state);
    }

    /// As [`Simulation::own_state`], within a step: what is read is recorded.
    pub(super) fn recorded_state(&mut self) -> Rc<RankState> {
        let known = self.copy.0.borrow().clone();
        known.unwrap_or_else(|| {
            let start = self.recorder.now();
            let state = self.own_state();
            self.recorder.end(EventName::ReadState, Activity::Transfer, start, state.bytes(), 0);
            state
        })
    }
}
