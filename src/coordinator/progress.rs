//! Progress on stderr: on a terminal a bar with the remaining time, otherwise one line per frame.

use std::io::IsTerminal;

use indicatif::{ProgressBar, ProgressStyle};

use crate::os::console::{is_quiet, note};
use crate::step::StepStats;

/// Progress of a run.
pub(super) struct Progress {
    bar: Option<ProgressBar>,
    frames: u32,
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
        Progress { bar, frames }
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
            None => note(format_args!("frame {frame}/{} (step {step}): {work}, state {hash}", self.frames)),
        }
    }

    /// Ends the progress display.
    pub(super) fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.finish();
        }
    }
}
