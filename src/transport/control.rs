//! Control channel between the coordinator of a run and its workers, whatever carries it: messages of any length both ways,
//! signs of life, and notice of each other's end. It says nothing about what the messages mean.
//!
//! What every implementation keeps to (`tests/processes/control_conformance.rs`):
//! - Messages of one sender arrive whole, once, and in the order in which they were sent.
//! - The coordinator never blocks on a worker, neither on a hung one nor on one that has ended.
//! - A worker that waits in its end gives signs of life by itself.
//! - Who has ended is seen to have ended; what it had handed over before is still received.
//!
//! Not promised: that the last message of a worker that leaves without [`ControlWorker::flush`] arrives.

use std::time::Duration;

use thiserror::Error;

use crate::os::clock::AwakeClock;

/// Why a control call failed.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error)]
pub enum ControlError {
    /// The other end did not answer in time.
    #[error("waited {waited_s:.1} s for {what}")]
    TimedOut { what: &'static str, waited_s: f64 },
    /// The coordinator has ended; the worker should too. `who` is its place on the machine.
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

/// A worker's sign of life.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Heartbeat {
    /// Grows with every sign of life; 0 until the worker has connected.
    pub counter: u64,
    /// Step that the worker is in; 0 while it is set up.
    pub step: u64,
}

/// The coordinator's end: one per run, made before the workers start.
pub trait ControlCoordinator {
    /// Number of workers that the channel was made for.
    fn ranks(&self) -> usize;
    /// Takes `message` for a worker and returns at once. What does not fit into the worker's buffers follows during later
    /// calls, [`ControlCoordinator::wait`] above all. Sending to a worker that has ended is no error.
    fn send(&mut self, rank: usize, message: Vec<u8>) -> Result<(), ControlError>;
    /// True if everything sent to this worker is in its buffers or taken.
    fn all_sent(&self, rank: usize) -> bool;
    /// The next complete message of a worker, if there is one. Never waits.
    fn try_receive(&mut self, rank: usize) -> Result<Option<Vec<u8>>, ControlError>;
    /// Sleeps until a worker has sent or taken something, at most `timeout`. May return early for no reason.
    fn wait(&mut self, timeout: Duration) -> Result<(), ControlError>;
    /// The newest sign of life of a worker.
    fn heartbeat(&self, rank: usize) -> Heartbeat;
    /// True once a worker that had connected has ended, for whatever reason. A hung one has not, see [`Silence`].
    fn has_ended(&mut self, rank: usize) -> bool;
}

/// A worker's end. Bound to the thread that made it.
pub trait ControlWorker {
    /// A sign of life.
    fn beat(&self);
    /// A sign of life that says which step the worker is in.
    fn progress(&self, step: u64);
    /// True once the coordinator has ended or has given this worker up ([`super::Launcher::kill`]).
    fn coordinator_has_ended(&self) -> bool;
    /// Sends `message`; returns when the channel has taken all of it.
    ///
    /// # Errors
    /// The coordinator has ended or takes nothing within the channel's deadline.
    fn send(&mut self, message: Vec<u8>) -> Result<(), ControlError>;
    /// Waits until the coordinator has taken everything sent.
    ///
    /// # Errors
    /// As [`ControlWorker::send`].
    fn flush(&mut self) -> Result<(), ControlError>;
    /// The next complete message of the coordinator, if there is one. Never waits.
    fn try_receive(&mut self) -> Result<Option<Vec<u8>>, ControlError>;
    /// The next message of the coordinator; none if there is none within `timeout`.
    ///
    /// # Errors
    /// The coordinator has ended and left nothing to receive.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Vec<u8>>, ControlError>;
}

/// For how long a worker's heart has stood still, as far as the calls of [`Silence::of`] saw. A coordinator that was stopped
/// itself has not listened, so that time does not count.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silence {
    /// Newest counter, and when it was first seen.
    newest: Option<(u64, AwakeClock)>,
}

impl Silence {
    /// Time since the counter of the worker's newest heartbeat was first seen; none before it has connected.
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
