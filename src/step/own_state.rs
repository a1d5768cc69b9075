//! The own rows' state on the host: read from the executor once where it changes, for all that looks at it until it changes
//! again. On a device every read is a wait.

use std::cell::RefCell;
use std::rc::Rc;

use super::Simulation;
use crate::gpu::ReadBatch;
use crate::telemetry::{Activity, EventName};

/// Positions (metres) and velocities (m/s) of the own rows, xyz in global order.
pub(super) struct OwnState {
    pub positions: Vec<f32>,
    pub velocities: Vec<f32>,
}

/// What the host knows of the state that the executor holds.
#[derive(Default)]
pub(super) struct StateCopy(RefCell<Option<Rc<OwnState>>>);

impl StateCopy {
    /// The executor's state is about to change.
    pub fn forget(&self) {
        self.0.take();
    }

    /// The executor's state is `state`, bit for bit.
    pub fn is(&self, state: Rc<OwnState>) {
        self.0.replace(Some(state));
    }
}

impl Simulation {
    /// The state of the own rows; one wait for the executor if it has changed since the last time.
    pub(super) fn own_state(&self) -> Rc<OwnState> {
        if let Some(known) = &*self.copy.0.borrow() {
            return Rc::clone(known);
        }
        let values = self.own_rows * 3;
        let mut state = OwnState { positions: vec![0.0; values], velocities: vec![0.0; values] };
        let mut batch = ReadBatch::new();
        batch.add(&self.positions, self.own_start, &mut state.positions);
        batch.add(&self.velocities, self.own_start, &mut state.velocities);
        batch.finish(&self.executor);
        let state = Rc::new(state);
        self.copy.is(Rc::clone(&state));
        state
    }

    /// The executor's state of the own rows becomes `state`.
    pub(super) fn set_own_state(&mut self, state: Rc<OwnState>) {
        self.positions.write_range(&self.executor, self.own_start, &state.positions);
        self.velocities.write_range(&self.executor, self.own_start, &state.velocities);
        self.copy.is(state);
    }

    /// As [`Simulation::own_state`], within a step: what is read is recorded.
    pub(super) fn recorded_state(&mut self) -> Rc<OwnState> {
        let known = self.copy.0.borrow().clone();
        known.unwrap_or_else(|| {
            let start = self.recorder.now();
            let state = self.own_state();
            let bytes = (size_of_val(&state.positions[..]) + size_of_val(&state.velocities[..])) as u64;
            self.recorder.end(EventName::ReadState, Activity::Transfer, start, bytes, 0);
            state
        })
    }
}
