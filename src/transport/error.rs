//! Errors of transport calls, and the limit of an all-gather.

use thiserror::Error;

/// Error of a transport call. All of them end the run of this rank.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error, PartialEq)]
pub enum TransportError {
    /// No message within the deadline.
    #[error("rank {rank} waited {waited_s:.1} s for rank {source_rank} ({what})")]
    TimedOut { rank: usize, source_rank: usize, what: &'static str, waited_s: f64 },
    /// The run was told to stop during the wait (a peer ended or the user requested it).
    #[error("rank {rank} was told to stop while waiting for rank {source_rank} ({what})")]
    Aborted { rank: usize, source_rank: usize, what: &'static str },
    /// An unexpected message arrived.
    #[error("rank {rank} expected message {expected} of rank {source_rank} and got {got}")]
    OutOfOrder { rank: usize, source_rank: usize, expected: u64, got: u64 },
    /// The mechanism below failed.
    #[error("transport of rank {rank}: {message}")]
    Mechanism { rank: usize, message: String },
}

/// Maximum number of values that one rank may contribute to an all-gather.
pub const ALL_GATHER_MAX: usize = 2048;
