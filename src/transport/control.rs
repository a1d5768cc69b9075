//! Control channel between the coordinator of a run and its workers, independent of the mechanism: messages of any
//! length both ways, signs of life, and detection of each other's end. The meaning of the messages lies in `protocol`.
//!
//! Guarantees of every implementation (`tests/processes/control_conformance.rs`):
//! - Messages of one sender arrive whole, once, and in the order in which they were sent.
//! - The coordinator never blocks on a worker, neither on a hung one nor on one that has ended.
//! - A worker that waits in a call of its end gives signs of life by itself.
//! - The end of a process or thread is detected; messages that it sent before are still received.
//!
//! Not promised: that the last message of a worker that leaves without [`ControlWorker::flush`] arrives.

use std::time::Duration;

use thiserror::Error;

use crate::os::clock::AwakeClock;

/// Error of a control call.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error)]
pub enum ControlError {
    /// The other end did not answer in time.
    #[error("waited {waited_s:.1} s for {what}")]
    TimedOut { what: &'static str, waited_s: f64 },
    /// The coordinator has ended, so the worker should end, too. `who` is its place on the machine.
    #[error("the coordinator ({who}) has ended")]
    CoordinatorGone { who: String },
    /// No such rank.
    #[error("rank {rank} of {ranks} ranks does not exist")]
    NoSuchRank { rank: usize, ranks: usize },
    /// The mechanism below failed.
    #[error("control channel: {message}")]
    Mechanism { message: String },
}

impl From<String> for ControlError {
    fn from(message: String) -> ControlError {
        ControlError::Mechanism { message }
    }
}

/// Sign of life of a worker.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Heartbeat {
    /// Increases with every sign of life; 0 until the worker has connected.
    pub counter: u64,
    /// Current step of the worker; 0 during setup.
    pub step: u64,
}

/// The coordinator's end. A run has one, created before the workers start.
pub trait ControlCoordinator {
    /// Number of workers of the channel.
    fn ranks(&self) -> usize;
    /// Accepts `message` for a worker and returns at once. Later calls, mainly [`ControlCoordinator::wait`], send the
    /// part that exceeds the worker's buffers. Sending to a worker that has ended is not an error.
    fn send(&mut self, rank: usize, message: Vec<u8>) -> Result<(), ControlError>;
    /// True if everything sent to this worker is in its buffers or received.
    fn all_sent(&self, rank: usize) -> bool;
    /// The next complete message of a worker, if there is one. Never waits.
    fn try_receive(&mut self, rank: usize) -> Result<Option<Vec<u8>>, ControlError>;
    /// Sleeps until a worker has sent or received a message, at most `timeout`. May return early without a cause.
    fn wait(&mut self, timeout: Duration) -> Result<(), ControlError>;
    /// The latest sign of life of a worker.
    fn heartbeat(&self, rank: usize) -> Heartbeat;
    /// True once a connected worker has ended, for any reason. A hung worker has not ended, see [`Silence`].
    fn has_ended(&mut self, rank: usize) -> bool;
}

/// A worker's end. Bound to the thread that created it.
pub trait ControlWorker {
    /// Gives a sign of life.
    fn beat(&self);
    /// Gives a sign of life with the current step.
    fn progress(&self, step: u64);
    /// True once the coordinator has ended or has given up this worker ([`super::Launcher::kill`]).
    fn coordinator_has_ended(&self) -> bool;
    /// Sends `message`; returns when the channel has accepted all of it.
    ///
    /// # Errors
    /// The coordinator has ended, or accepts nothing within the channel's deadline.
    fn send(&mut self, message: Vec<u8>) -> Result<(), ControlError>;
    /// Waits until the coordinator has received everything sent.
    ///
    /// # Errors
    /// As [`ControlWorker::send`].
    fn flush(&mut self) -> Result<(), ControlError>;
    /// The next complete message of the coordinator, if there is one. Never waits.
    fn try_receive(&mut self) -> Result<Option<Vec<u8>>, ControlError>;
    /// The next message of the coordinator; none if no message arrives within `timeout`.
    ///
    /// # Errors
    /// The coordinator has ended and no message is left to receive.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Vec<u8>>, ControlError>;
}

/// Time for which a worker's heartbeat counter has not changed, measured by the calls of [`Silence::of`]. While the
/// coordinator itself is suspended it does not listen, so that time does not count.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silence {
    /// Latest counter, and the time of its first observation.
    newest: Option<(u64, AwakeClock)>,
}

impl Silence {
    /// Time since the first observation of the worker's latest counter; none before it has connected.
    pub fn of(&mut self, heartbeat: Heartbeat) -> Option<Duration> {
        if heartbeat.counter == 0 {
            return None;
        }
        let (_, since) = match &mut self.newest {
            Some(newest) if newest.0 == heartbeat.counter => newest,
            newest => newest.insert((heartbeat.counter, AwakeClock::start())),
        };
        Some(since.elapsed())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silence_begins_with_the_newest_counter() {
        let (mut silence, beat) = (Silence::default(), |counter: u64| Heartbeat { counter, step: 0 });
        assert_eq!(silence.of(beat(0)), None);
        silence.of(beat(1)).unwrap();
        std::thread::sleep(Duration::from_millis(20));
        assert!(silence.of(beat(1)).unwrap() >= Duration::from_millis(20));
        let longer = silence.of(beat(1)).unwrap();
        assert!(silence.of(beat(2)).unwrap() < longer);
    }
}
