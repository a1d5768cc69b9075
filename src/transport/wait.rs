//! Waits of a rank for another one: a short spin if there are enough cores, a few yields, then sleep. During the wait
//! the run's hook is called. Every wait has a deadline. The module does not depend on the awaited event.

use std::time::{Duration, Instant};

use crate::os::clock::AwakeClock;

use super::{TransportError, cores};

/// Called at least every [`HOOK_INTERVAL`] during a wait. It gives a sign of life, and returns true to give up waiting
/// (a peer ended, the user requested a stop).
pub type WaitHook = Box<dyn FnMut() -> bool>;

/// Longest time between two calls of the hook during a wait.
pub const HOOK_INTERVAL: Duration = Duration::from_millis(50);

/// The hook is due when this much time has passed since its last call. A sleep of the same length then still ends
/// within [`HOOK_INTERVAL`].
const HOOK_DUE: Duration = Duration::from_millis(20);
/// Time of spinning before the first yield if every process has a core. It is about twice the cost of a wake-up (50
/// microseconds on a virtual machine), so that two ranks that are this close to each other do not sleep.
const SPIN: Duration = Duration::from_micros(100);
/// Yields before sleeping. A yield to a process on the same core takes about a microsecond; a sleep and a wake-up cost
/// both sides more than all of these yields.
const YIELDS: u32 = 50;

/// Reason of a wait that failed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Stopped {
    /// The deadline passed after this many seconds.
    TimedOut { waited_s: f64 },
    /// The hook requested it.
    Aborted,
}

impl Stopped {
    /// The error of a rank that waited for `source_rank`.
    pub(super) fn error(self, rank: usize, source_rank: usize, what: &'static str) -> TransportError {
        match self {
            Stopped::TimedOut { waited_s } => TransportError::TimedOut { rank, source_rank, what, waited_s },
            Stopped::Aborted => TransportError::Aborted { rank, source_rank, what },
        }
    }
}

/// Deadline, spin time and hook of the waits of one rank.
pub(super) struct Patience {
    deadline: Duration,
    spin: Duration,
    hook: WaitHook,
    hook_called: Instant,
}

impl Patience {
    /// Waits at most `deadline` at a time; `processes` ranks share this machine's cores.
    pub(super) fn new(deadline: Duration, processes: usize, hook: WaitHook) -> Patience {
        let spin = if cores() >= processes { SPIN } else { Duration::ZERO };
        Patience { deadline, spin, hook, hook_called: Instant::now() }
    }

    /// Calls the hook if it is due, without waiting.
    pub(super) fn call_hook_if_due(&mut self) -> Result<(), Stopped> {
        let now = Instant::now();
        if now - self.hook_called >= HOOK_DUE {
            self.hook_called = now;
            if (self.hook)() {
                return Err(Stopped::Aborted);
            }
        }
        Ok(())
    }

    pub(super) fn begin(&self) -> Wait {
        Wait { clock: AwakeClock::start(), yields: 0 }
    }

    /// Backs off after an unsuccessful look in `wait`: spins or yields and returns `None`, or returns the time that the
    /// caller may sleep before the next look.
    pub(super) fn back_off(&mut self, wait: &mut Wait) -> Result<Option<Duration>, Stopped> {
        let now = Instant::now();
        let waited = wait.clock.elapsed();
        if waited < self.spin {
            std::hint::spin_loop();
            return Ok(None);
        }
        if now - self.hook_called >= HOOK_DUE {
            self.hook_called = now;
            if (self.hook)() {
                return Err(Stopped::Aborted);
            }
        }
        if waited >= self.deadline {
            return Err(Stopped::TimedOut { waited_s: waited.as_secs_f64() });
        }
        if wait.yields < YIELDS {
            wait.yields += 1;
            std::thread::yield_now();
            return Ok(None);
        }
        Ok(Some(HOOK_DUE.min(self.deadline - waited)))
    }
}

pub(super) struct Wait {
    clock: AwakeClock,
    yields: u32,
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;
    use std::rc::Rc;

    #[test]
    fn a_wait_ends_at_the_deadline_and_calls_the_hook_before() {
        let calls = Rc::new(Cell::new(0));
        let counted = calls.clone();
        let hook = Box::new(move || {
            counted.set(counted.get() + 1);
            false
        });
        let mut patience = Patience::new(Duration::from_millis(200), usize::MAX, hook);
        let mut wait = patience.begin();
        let mut yields = 0;
        let stopped = loop {
            match patience.back_off(&mut wait) {
                Ok(None) => yields += 1,
                Ok(Some(limit)) => {
                    assert!(limit <= HOOK_DUE);
                    std::thread::sleep(limit);
                }
                Err(stopped) => break stopped,
            }
        };
        assert!(matches!(stopped, Stopped::TimedOut { waited_s } if waited_s >= 0.2));
        // A busy machine may delay this thread between two yields until the hook is due.
        assert!((1..=YIELDS).contains(&yields));
        assert!(calls.get() >= 2);
    }

    #[test]
    fn the_hook_can_abort() {
        let mut patience = Patience::new(Duration::from_secs(60), 1, Box::new(|| true));
        let mut wait = patience.begin();
        let stopped = loop {
            match patience.back_off(&mut wait) {
                Ok(limit) => std::thread::sleep(limit.unwrap_or_default()),
                Err(stopped) => break stopped,
            }
        };
        assert_eq!(stopped, Stopped::Aborted);
    }
}
