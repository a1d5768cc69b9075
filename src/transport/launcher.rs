//! Where the workers of a run come from and how they go: started by this process, or awaited because others start them.
//! It knows nothing of what they do.
//!
//! What every implementation keeps to (`tests/processes/control_conformance.rs`):
//! - [`Launcher::life`] of a worker only ever goes forward: not started, running, ended.
//! - After [`Launcher::kill`] a worker that still listens ends, and the others are not disturbed.
//! - After [`Launcher::clean_up`] nothing of the run is left on the machine.

use std::io;

use super::RunName;

/// What a launcher knows of a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Life {
    /// Not started by this launcher (yet). One that others start shows up on the control channel.
    NotStarted,
    /// Started and not ended.
    Running,
    /// Started and ended, for whatever reason.
    Ended,
}

/// Starts the workers of one run and ends them.
pub trait Launcher {
    /// Name of the run on this machine, which workers that others start must be told; none if workers are no processes.
    fn run_name(&self) -> Option<&RunName> {
        None
    }
    /// Starts worker `rank`, or leaves that to others.
    fn start(&mut self, rank: usize) -> io::Result<()>;
    /// Whether worker `rank` runs. Never waits.
    fn life(&mut self, rank: usize) -> Life;
    /// How worker `rank` has ended, as the end of a sentence; none if that is not known.
    fn end_of(&mut self, _rank: usize) -> Option<String> {
        None
    }
    /// A number that grows while worker `rank` computes; none if that is not known.
    fn work_of(&self, _rank: usize) -> Option<u64> {
        None
    }
    /// The worker as a user finds it on the machine, for messages: `process 4711`.
    fn describe(&self, rank: usize) -> String;
    /// Ends worker `rank` if it still runs, whether it listens or not. Does not wait for its end. A thread cannot be ended
    /// from outside: it ends at its next call of its control channel or its transport.
    fn kill(&mut self, rank: usize);
    /// Waits for the end of worker `rank` and gives back what it held. Call it for workers that were told to leave or were
    /// killed.
    fn wait(&mut self, rank: usize);
    /// Removes what the run has put on the machine. Called once, after all workers are gone.
    fn clean_up(&mut self);
}
