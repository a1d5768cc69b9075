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

/// Time of a message of no length, and how fast long ones travel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredLink {
    /// Microseconds, one way.
    pub latency_us: f64,
    /// 10^9 bytes/s, one way.
    pub bandwidth_gb_s: f64,
}

/// The hosts of a world and what was measured between them.
#[derive(Clone, Debug, PartialEq)]
pub struct MeasuredWorld {
    /// By process: number of its host.
    pub hosts: Vec<usize>,
    /// By host: its name.
    pub names: Vec<String>,
    /// Between two processes of the first host that has two.
    pub inside: Option<MeasuredLink>,
    /// By host: between its first process and that of host 0; none for host 0.
    pub between: Vec<Option<MeasuredLink>>,
}
