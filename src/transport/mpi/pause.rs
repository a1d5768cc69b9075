//! Pauses of a thread that looks for messages: MPI wakes nobody, so the pauses grow with the wait.

use std::time::Duration;

/// Yields before the first sleep.
const YIELDS: u32 = 50;
/// The first sleep, and the longest one.
const SLEEPS: [Duration; 2] = [Duration::from_micros(20), Duration::from_millis(1)];

/// The pauses of one wait.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Pause {
    rests: u32,
}

impl Pause {
    /// Yields, or sleeps for a time that grows to a millisecond.
    pub(super) fn rest(&mut self) {
        self.rests = self.rests.saturating_add(1);
        if self.rests <= YIELDS {
            return std::thread::yield_now();
        }
        let [first, longest] = SLEEPS;
        std::thread::sleep((first * (self.rests - YIELDS)).min(longest));
    }
}
