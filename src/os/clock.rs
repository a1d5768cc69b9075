//! Time without suspensions of this process. A job that is suspended and continued (SIGSTOP, `scontrol suspend`, a
//! paused container, a closed laptop) did not wait for other processes in between.

use std::time::{Duration, Instant};

/// Maximum time that counts between two readings. A waiting process reads every 50 ms; a longer gap is a suspension, or
/// work that has kept this process from listening.
const LONGEST_GAP: Duration = Duration::from_millis(500);

/// Time since the start, accumulated over the readings.
#[derive(Clone, Copy, Debug)]
pub struct AwakeClock {
    counted: Duration,
    looked: Instant,
}

impl AwakeClock {
    /// Starts at zero.
    pub fn start() -> AwakeClock {
        AwakeClock { counted: Duration::ZERO, looked: Instant::now() }
    }

    /// The time that counts.
    pub fn elapsed(&mut self) -> Duration {
        self.at(Instant::now())
    }

    fn at(&mut self, now: Instant) -> Duration {
        self.counted += now.saturating_duration_since(self.looked).min(LONGEST_GAP);
        self.looked = now;
        self.counted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_suspension_counts_as_one_gap() {
        let mut clock = AwakeClock::start();
        let start = clock.looked;
        let at = |ms: u64| start + Duration::from_millis(ms);
        assert_eq!(clock.at(at(20)), Duration::from_millis(20));
        assert_eq!(clock.at(at(70)), Duration::from_millis(70));
        assert_eq!(clock.at(at(3_600_070)), Duration::from_millis(570));
        assert_eq!(clock.at(at(3_600_090)), Duration::from_millis(590));
        assert_eq!(clock.at(start), Duration::from_millis(590), "no time goes backwards");
    }
}
