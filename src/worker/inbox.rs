//! The worker's end of the control channel as its work uses it: messages in order, also those that came while a
//! transport waited, and what failures say.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::rc::Rc;
use std::time::Duration;

use super::error::WorkerError;
use crate::protocol::{CONNECTING, SOLVING, ToCoordinator, ToWorker};
use crate::step::Failure;
use crate::transport::{ControlWorker, decode, encode};

/// The control channel, shared between the main loop and the hook that runs while the transport waits.
#[derive(Clone)]
pub(super) struct Inbox {
    control: Rc<RefCell<Box<dyn ControlWorker>>>,
    waiting: Rc<RefCell<VecDeque<Vec<u8>>>>,
    told_to_stop: Rc<Cell<bool>>,
}

impl Inbox {
    pub(super) fn new(control: Box<dyn ControlWorker>) -> Inbox {
        Inbox { control: Rc::new(RefCell::new(control)), waiting: Rc::default(), told_to_stop: Rc::default() }
    }

    /// Called while waiting for another rank: a sign of life; true if the run is over.
    pub(super) fn should_stop(&self) -> bool {
        let Ok(mut control) = self.control.try_borrow_mut() else { return false };
        control.beat();
        if control.coordinator_has_ended() {
            return true;
        }
        while let Ok(Some(message)) = control.try_receive() {
            let stop = matches!(decode::<ToWorker>(&message), Ok((ToWorker::Stop, _)));
            self.waiting.borrow_mut().push_back(message);
            if stop {
                self.told_to_stop.set(true);
                return true;
            }
        }
        false
    }

    pub(super) fn next(&self) -> Result<Vec<u8>, WorkerError> {
        if let Some(message) = self.waiting.borrow_mut().pop_front() {
            return Ok(message);
        }
        loop {
            if let Some(message) = self.control.borrow_mut().receive(Duration::from_secs(3600))? {
                return Ok(message);
            }
        }
    }

    pub(super) fn send(&self, message: &ToCoordinator, arrays: &[&[u8]]) -> Result<(), WorkerError> {
        let bytes = encode(message, arrays)?;
        Ok(self.control.borrow_mut().send(bytes)?)
    }

    /// A sign of life that says which step this rank is in.
    pub(super) fn progress(&self, step: u32) {
        self.control.borrow().progress(u64::from(step));
    }

    /// A sign of life that says that this rank connects to the others.
    pub(super) fn connecting(&self) {
        self.control.borrow().progress(CONNECTING);
    }

    /// A sign of life that says that this rank solves a linear system.
    pub(super) fn solving(&self) {
        self.control.borrow().progress(SOLVING);
    }

    /// Waits until the coordinator has taken everything sent.
    pub(super) fn flush(&self) -> Result<(), WorkerError> {
        Ok(self.control.borrow_mut().flush()?)
    }

    /// What is left to do after a failed transfer: to leave if it failed because the run is over, else to report it.
    pub(super) fn interrupted(&self, failure: Failure) -> Result<ControlFlow<()>, WorkerError> {
        if self.told_to_stop.get() { Ok(ControlFlow::Break(())) } else { Err(self.fail(failure)) }
    }

    pub(super) fn fail(&self, failure: Failure) -> WorkerError {
        let text = failure.to_string();
        if let Err(error) = self.send(&ToCoordinator::Failed(failure), &[]) {
            return error;
        }
        match self.flush() {
            Ok(()) => WorkerError::Reported(text),
            Err(error) => error,
        }
    }
}
