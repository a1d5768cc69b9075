//! Start and end of the workers of a run: this process starts them, or it waits for workers that other programs start.
//! The work of the workers lies in other modules.
//!
//! Guarantees of every implementation (`tests/processes/control_conformance.rs`):
//! - [`Launcher::life`] of a worker only changes forward: not started, running, ended.
//! - After [`Launcher::kill`] a worker that still listens ends, and the others are not disturbed.
//! - After [`Launcher::clean_up`] no file of the run remains on the machine.

use std::io;

use super::RunName;

/// Life of a worker as its launcher observes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Life {
    /// Not started by this launcher (yet). A worker that another program starts appears on the control channel.
    NotStarted,
    /// Started and not ended.
    Running,
    /// Started and ended, for any reason.
    Ended,
}

/// Starts the workers of one run and ends them.
pub trait Launcher {
    /// Name of the run on this machine, which other programs need to start workers; none if workers are not processes.
    fn run_name(&self) -> Option<&RunName> {
        None
    }
    /// Starts worker `rank`, or leaves that to other programs.
    fn start(&mut self, rank: usize) -> io::Result<()>;
    /// Whether worker `rank` runs. Never waits.
    fn life(&mut self, rank: usize) -> Life;
    /// End of worker `rank`, as the end of a sentence; none if it is not known.
    fn end_of(&mut self, _rank: usize) -> Option<String> {
        None
    }
    /// A number that increases while worker `rank` computes or waits for a core; none if it is not known.
    fn work_of(&self, _rank: usize) -> Option<u64> {
        None
    }
    /// The worker's place on the machine, for messages: `process 4711`.
    fn describe(&self, rank: usize) -> String;
    /// Ends worker `rank` if it still runs, whether it listens or not. Does not wait for its end. A thread cannot be
    /// ended from outside: it ends at its next call of its control channel or its transport.
    fn kill(&mut self, rank: usize);
    /// Waits for the end of worker `rank` and frees its resources. Call it for workers that were ordered to leave or
    /// were killed.
    fn wait(&mut self, rank: usize);
    /// Removes the run's files from the machine. Called once, after all workers have ended.
    fn clean_up(&mut self);
}
