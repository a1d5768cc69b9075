//! File descriptors that a run needs, said before the start. Without that a lack of them shows up deep inside the
//! connecting of ranks, as one of many errors, or as another rank that never comes.

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

/// Of a worker: what it opens for itself, and for every rank of the run. Measured with 2, 4 and 8 workers, and checked by
/// a test (tests/processes/descriptors.rs).
const OF_WORKER: (u64, u64) = (51, 24);
/// Of a coordinator, likewise.
const OF_COORDINATOR: (u64, u64) = (23, 21);
/// Opened for a moment while connecting, and by device drivers.
const MOMENTARY: u64 = 24;

/// Most files that one process of a run with `ranks` workers has open at a time.
pub fn required_descriptors(ranks: usize) -> u64 {
    let of = |(own, each): (u64, u64)| own + each * ranks as u64;
    of(OF_WORKER).max(of(OF_COORDINATOR)) + MOMENTARY
}

/// Says whether the processes of a run with `ranks` workers may open as many files as they need; workers have the limit of
/// the process that starts them.
///
/// # Errors
/// They may not: the sentence has both numbers.
pub fn check_descriptors(ranks: usize) -> Result<(), TooFewDescriptors> {
    let (needed, limit) = (required_descriptors(ranks), descriptor_limit());
    if needed > limit { Err(TooFewDescriptors { ranks, needed, limit }) } else { Ok(()) }
}
