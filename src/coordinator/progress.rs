//! Progress on stderr: on a terminal a bar with the remaining time, otherwise one line per frame.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::os::console::{is_quiet, note};
use crate::step::StepStats;

/// Progress of a run.
pub(super) struct Progress {
    bar: Option<ProgressBar>,
    frames: u32,
    /// Frames that were there at the start.
    done: u32,
    started: Instant,
}

impl Progress {
    /// Progress of `frames` frames, of which `done` exist already.
    pub(super) fn new(frames: u32, done: u32) -> Progress {
        let bar = (std::io::stderr().is_terminal() && !is_quiet()).then(|| {
            let bar = ProgressBar::new(frames as u64).with_position(done as u64);
            if let Ok(style) = ProgressStyle::with_template("{bar:40} frame {pos}/{len}  {msg}  left {eta}") {
                bar.set_style(style);
            }
            bar.reset_eta();
            bar
        });
        Progress { bar, frames, done, started: Instant::now() }
    }

    /// Counts a written frame.
    pub(super) fn frame(&self, frame: u32, step: u32, stats: &StepStats, hash: &str, seconds_per_step: f64) {
        let mut work = format!("{} iterations, ", stats.iterations);
        if stats.contacts > 0 || stats.zones.zones > 0 {
            work += &format!("{} contacts, {} zones, ", stats.contacts, stats.zones.zones);
        }
        if stats.let_go.pairs > 0 {
            let vertices = if stats.let_go.pairs == 1 { "vertex" } else { "vertices" };
            work += &format!("{} {vertices} let go between obstacles, ", stats.let_go.pairs);
        }
        work += &format!("{:.1} ms/step", seconds_per_step * 1e3);
        match &self.bar {
            Some(bar) => {
                bar.set_message(work);
                bar.set_position(frame as u64);
            }
            None => {
                let times =
                    times(self.started.elapsed(), frame.saturating_sub(self.done), self.frames.saturating_sub(frame));
                note(format_args!("frame {frame}/{} (step {step}): {work}, {times}, state {hash}", self.frames));
            }
        }
    }

    /// Ends the progress display.
    pub(super) fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.finish();
        }
    }
}

/// Elapsed time, and the time left if what is missing takes as long as what was made.
pub(super) fn times(elapsed: Duration, made: u32, missing: u32) -> String {
    let mut text = format!("{} so far", clock(elapsed));
    if made > 0 && missing > 0 {
        text += &format!(", {} left", clock(elapsed.mul_f64(f64::from(missing) / f64::from(made))));
    }
    text
}

/// `5 s`, `2:05 min` or `1:02:05 h`.
fn clock(time: Duration) -> String {
    let seconds = (time.as_secs_f64() + 0.5) as u64;
    let (hours, minutes) = (seconds / 3600, seconds / 60 % 60);
    match (hours, minutes) {
        (0, 0) => format!("{seconds} s"),
        (0, _) => format!("{minutes}:{:02} min", seconds % 60),
        _ => format!("{hours}:{minutes:02}:{:02} h", seconds % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_said_as_people_write_them() {
        let seconds = Duration::from_secs;
        assert_eq!([clock(seconds(5)), clock(seconds(125)), clock(seconds(3725))], ["5 s", "2:05 min", "1:02:05 h"]);
        assert_eq!(times(seconds(10), 2, 6), "10 s so far, 30 s left");
        assert_eq!(times(seconds(10), 2, 0), "10 s so far");
        assert_eq!(times(seconds(10), 0, 6), "10 s so far");
    }
}
