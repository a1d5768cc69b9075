//! Check of the file descriptors of a run before its start. Without it a shortage appears while ranks connect, as one
//! of many errors or as a rank that never connects.

use thiserror::Error;

use crate::os::limits::descriptor_limit;

/// The limit on open files is too low for a run.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error(
    "with {ranks} workers a process of this run opens up to {needed} files, and the system allows {limit}: raise the limit (ulimit -Hn {needed}) or use fewer workers"
)]
pub struct TooFewDescriptors {
    ranks: usize,
    needed: u64,
    limit: u64,
}

/// Descriptors of a worker: a fixed number, and a number for every rank of the run. Measured with 2, 4 and 8 workers,
/// and checked by a test (tests/processes/descriptors.rs).
const OF_WORKER: (u64, u64) = (51, 24);
/// Descriptors of a coordinator, likewise.
const OF_COORDINATOR: (u64, u64) = (23, 21);
/// Descriptors opened for a moment while connecting, and by device drivers.
const MOMENTARY: u64 = 24;

/// Maximum number of files that one process of a run with `ranks` workers has open at a time.
pub fn required_descriptors(ranks: usize) -> u64 {
    let of = |(own, each): (u64, u64)| own + each * ranks as u64;
    of(OF_WORKER).max(of(OF_COORDINATOR)) + MOMENTARY
}

/// Checks that the processes of a run with `ranks` workers may open as many files as they need. Workers inherit the
/// limit of the process that starts them.
///
/// # Errors
/// The limit is too low; the sentence has both numbers.
pub fn check_descriptors(ranks: usize) -> Result<(), TooFewDescriptors> {
    let (needed, limit) = (required_descriptors(ranks), descriptor_limit());
    if needed > limit { Err(TooFewDescriptors { ranks, needed, limit }) } else { Ok(()) }
}
