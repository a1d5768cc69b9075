//! Why a worker ends before its coordinator says stop.

use thiserror::Error;

use crate::transport::{ControlError, MessageError, RunError};

/// Why a worker ends without having been told to.
#[derive(Debug, Error)]
pub enum WorkerError {
    /// The coordinator is gone, or the channel to it is broken.
    #[error(transparent)]
    Control(#[from] ControlError),
    /// A message that this worker does not understand.
    #[error("message from the coordinator: {0}")]
    Message(#[from] MessageError),
    /// The run's resources.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A failure that has been reported to the coordinator.
    #[error("{0}")]
    Reported(String),
}
