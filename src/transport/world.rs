//! A world of processes that another program has started: the ranks of an `mpirun`. The first process holds the
//! coordinator and worker 0, every other one a worker.

use std::fmt::Debug;

use super::{ControlCoordinator, ControlError, Launcher, Machine};

/// The processes of a world, as the coordinator uses them.
pub trait World: Debug + Send + Sync {
    /// Number of processes, each a worker.
    fn ranks(&self) -> usize;
    /// The machines of the processes.
    fn machine(&self) -> Box<dyn Machine>;
    /// The channel to `ranks` workers and their launcher; worker 0 of them is process `first` of the world. A process
    /// belongs to one crew at a time.
    ///
    /// # Errors
    /// The world has too few processes.
    fn crew(&self, first: usize, ranks: usize) -> Result<WorldCrew, ControlError>;
}

/// Control channel and launcher of a crew.
pub type WorldCrew = (Box<dyn ControlCoordinator>, Box<dyn Launcher>);
