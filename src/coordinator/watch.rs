//! How somebody follows a session that advances: what it hears of every step, and how it leads them.

use std::ops::ControlFlow;
use std::sync::Arc;

use crate::math::Vec3;
use crate::model::State;
use crate::step::{Guidance, StepStats};
use crate::telemetry::Event;

/// A step that all ranks have done.
#[derive(Clone, Debug)]
pub struct StepDone {
    /// Number of the step, from 1.
    pub step: u32,
    /// By rank.
    pub ranks: Vec<StepStats>,
    /// Events by rank; empty if they were not requested.
    pub events: Vec<Vec<Event>>,
    /// Wall time measured by the coordinator, seconds.
    pub wall_s: f64,
}

/// Action after a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// Do the next step.
    Step,
    /// Send the state first.
    State,
    /// Stop and leave the workers in this state.
    Leave,
}

/// How a step gets to its end.
#[derive(Clone, Debug, Default)]
pub enum Way {
    /// As the forces have it.
    #[default]
    Free,
    /// Drawn toward a motion, which is given by the positions of all vertices at the start and at the end of the step,
    /// meters.
    Guided {
        /// At the start.
        start: Arc<Vec<Vec3>>,
        /// At the end.
        end: Arc<Vec<Vec3>>,
        /// How strongly.
        guidance: Guidance,
    },
    /// Straight to this state, if nothing is in the way.
    Straight(Arc<State>),
}

/// Observer of a session that advances.
pub trait Watch {
    /// How a step gets to its end. `blocked`: the straight way, which was asked for first, is not free; another answer
    /// is needed, and [`Way::Straight`] counts as [`Way::Free`]. A way that is straight and free ends the advance.
    ///
    /// # Errors
    /// Why there is none: a sentence that ends the advance.
    fn way(&mut self, _step: u32, _blocked: bool) -> Result<Way, String> {
        Ok(Way::Free)
    }

    /// Whether the events of a step are requested.
    fn wants_events(&self, step: u32) -> bool;
    /// Called when a step is done.
    fn step(&mut self, done: StepDone) -> Next;
    /// Receives the state that [`Next::State`] requested; all its values are finite.
    fn state(&mut self, step: u32, state: State) -> ControlFlow<()>;
}

/// Observer that requests nothing and lets every step follow the last one.
impl Watch for () {
    fn wants_events(&self, _step: u32) -> bool {
        false
    }

    fn step(&mut self, _done: StepDone) -> Next {
        Next::Step
    }

    fn state(&mut self, _step: u32, _state: State) -> ControlFlow<()> {
        ControlFlow::Continue(())
    }
}
