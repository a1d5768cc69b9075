//! When an obstacle plays its clip: maps the time of a run to the time of a clip.

use serde::{Deserialize, Serialize};

/// How a clip is played: from `start_s` on the body goes from its rest pose into the first pose of the clip, for
/// `lead_in_s`, and then the clip runs, `rate` times as fast as it was made.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Playback {
    /// Time of the run at which the lead-in begins, or the clip if there is none, seconds.
    pub start_s: f64,
    /// Seconds of the clip per second of the run; above 0.
    pub rate: f64,
    /// True: the clip starts over at its end. False: its last pose stays.
    pub repeats: bool,
    /// Length of the lead-in, seconds of the run.
    pub lead_in_s: f64,
    /// Length of the clip, seconds of the clip.
    pub length_s: f64,
}

impl Playback {
    /// The time within the clip (seconds) at a time of the run, and the share of the clip's pose in the body's: below 1
    /// during the lead-in only, the rest is the rest pose. The share starts and ends without a jump in speed. Without a
    /// lead-in the body waits in the first pose of the clip.
    pub fn at(&self, time_s: f64) -> (f64, f64) {
        let since = time_s - self.start_s;
        if since < self.lead_in_s && self.lead_in_s > 0.0 {
            let u = (since / self.lead_in_s).max(0.0);
            return (0.0, u * u * (3.0 - 2.0 * u));
        }
        let clip_s = ((since - self.lead_in_s) * self.rate).max(0.0);
        match self.repeats && self.length_s > 0.0 {
            true => (clip_s % self.length_s, 1.0),
            false => (clip_s.min(self.length_s), 1.0),
        }
    }

    /// The time of the run at which a time of the clip is first played.
    pub fn run_time(&self, clip_s: f64) -> f64 {
        self.start_s + self.lead_in_s + clip_s / self.rate
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAIN: Playback = Playback { start_s: 0.0, rate: 1.0, repeats: false, lead_in_s: 0.0, length_s: 2.0 };

    #[test]
    fn a_clip_waits_runs_and_stays_or_starts_over() {
        for (time_s, clip_s) in [(-1.0, 0.0), (0.0, 0.0), (0.5, 0.5), (2.0, 2.0), (9.0, 2.0)] {
            assert_eq!(PLAIN.at(time_s), (clip_s, 1.0), "at {time_s} s");
        }
        let twice = Playback { start_s: 1.0, rate: 2.0, repeats: true, ..PLAIN };
        for (time_s, clip_s) in [(0.5, 0.0), (1.25, 0.5), (2.0, 0.0), (2.5, 1.0), (3.75, 1.5)] {
            assert_eq!(twice.at(time_s), (clip_s, 1.0), "at {time_s} s");
        }
        assert_eq!(twice.run_time(1.5), 1.75);
        assert_eq!(Playback { length_s: 0.0, repeats: true, ..PLAIN }.at(3.0), (0.0, 1.0));
    }

    #[test]
    fn the_lead_in_eases_from_rest_into_the_first_pose() {
        let eased = Playback { start_s: 1.0, lead_in_s: 0.5, ..PLAIN };
        for (time_s, at) in
            [(0.0, (0.0, 0.0)), (1.0, (0.0, 0.0)), (1.25, (0.0, 0.5)), (1.5, (0.0, 1.0)), (2.0, (0.5, 1.0))]
        {
            assert_eq!(eased.at(time_s), at, "at {time_s} s");
        }
        let speed = |time_s: f64| (eased.at(time_s + 1e-6).1 - eased.at(time_s).1) / 1e-6;
        assert!(speed(1.0).abs() < 1e-4 && speed(1.5 - 1e-6).abs() < 1e-4, "no jump in speed at its ends");
        assert_eq!(eased.run_time(0.0), 1.5);
    }
}
