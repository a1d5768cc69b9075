//! Resources of the machine of a run's workers: cores, and room for their transfers. `gpu::adapters` lists GPUs.

use thiserror::Error;

use super::{SharedMemoryError, check_descriptors, check_shared_memory, remove_dead_runs, shared_memory_space};
use crate::interconnect::MAX_GPUS;

/// Maximum number of ranks of a run: one per GPU of the largest topology.
pub const RANKS_MAX: usize = MAX_GPUS;

/// Number of threads that this process may run at once.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, |cores| cores.get())
}

/// Error if a run does not fit.
#[derive(Debug, Error)]
pub enum MachineError {
    /// Fewer workers or more room would help.
    #[error("{0}")]
    TooSmall(String),
    /// The system does not tell.
    #[error("{0}")]
    Unreadable(String),
}

/// The machine of the workers of a run.
pub trait Machine {
    /// Number of threads that all workers together may run at once.
    fn cores(&self) -> usize {
        cores()
    }
    /// Threads of each of `workers` workers that run side by side, counted over all runs of this program.
    fn threads_per_worker(&self, workers: usize) -> usize {
        (self.cores() / workers.max(1)).max(1)
    }
    /// Place of worker `index` of `workers` side by side among those of its machine, and the number of those: which
    /// core and which GPU it takes.
    fn place(&self, index: usize, workers: usize) -> (usize, usize) {
        (index, workers)
    }
    /// Prepares for `workers` workers: checks what each needs besides room for its transfers, and removes what dead runs
    /// left. Cheap, so that a run is refused before its plan is made.
    ///
    /// # Errors
    /// The machine has too little of it.
    fn prepare(&self, workers: usize) -> Result<(), MachineError>;
    /// Checks that there is room for the transfers of `ranks` ranks whose longest message has `max_len` values.
    fn check_transfers(&self, ranks: usize, max_len: usize) -> Result<(), MachineError>;
}

/// A machine whose workers are processes joined by shared memory.
#[derive(Clone, Copy, Debug, Default)]
pub struct SharedMemoryMachine;

impl Machine for SharedMemoryMachine {
    fn prepare(&self, workers: usize) -> Result<(), MachineError> {
        check_descriptors(workers).map_err(|error| MachineError::TooSmall(error.to_string()))?;
        remove_dead_runs();
        Ok(())
    }

    fn check_transfers(&self, ranks: usize, max_len: usize) -> Result<(), MachineError> {
        let (_, free) = shared_memory_space().map_err(|error| MachineError::Unreadable(error.to_string()))?;
        check_shared_memory(ranks, max_len, free)
            .map_err(|error: SharedMemoryError| MachineError::TooSmall(error.to_string()))
    }
}

/// This process: workers are threads, and their messages lie in its own memory.
#[derive(Clone, Copy, Debug, Default)]
pub struct OneProcess;

impl Machine for OneProcess {
    fn prepare(&self, _workers: usize) -> Result<(), MachineError> {
        Ok(())
    }

    fn check_transfers(&self, _ranks: usize, _max_len: usize) -> Result<(), MachineError> {
        Ok(())
    }
}
