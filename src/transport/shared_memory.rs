//! Shared memory of a run: checked before the start, reserved at the start. Otherwise a full `/dev/shm` appears as
//! SIGBUS at the first touch of a page, long after the start.

use std::fs::{File, OpenOptions, TryLockError};
use std::time::Duration;

use rustix::fs::{FallocateFlags, StatVfsMountFlags, fallocate, statvfs};
use thiserror::Error;

use super::RunName;
use super::frames::FRAME_MAX;
use super::pattern::BUFFERS;
use super::run_name::SHARED_MEMORY_FOLDER;
use crate::os::clock::AwakeClock;
use crate::os::console::note;

/// Error of a lack of shared memory.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error)]
pub enum SharedMemoryError {
    /// Found before the start.
    #[error(
        "{} has {} free and this run needs {}: enlarge it (docker: --shm-size) or use fewer workers",
        SHARED_MEMORY_FOLDER, mib(*available), mib(*required)
    )]
    TooSmall { required: u64, available: u64 },
    /// Found at the start (other processes took it in the meantime).
    #[error("cannot reserve {} in {}: {source}", mib(*bytes), SHARED_MEMORY_FOLDER)]
    Reserve { bytes: u64, source: std::io::Error },
    /// The machine has no shared memory, or it cannot be inspected.
    #[error("cannot look at {}: {source}", SHARED_MEMORY_FOLDER)]
    Unreadable { source: std::io::Error },
}

fn mib(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / (1u64 << 20) as f64)
}

/// Page size of shared-memory files, bytes.
const PAGE: u64 = 4096;
/// Headers before the values of a message, rounded up.
const MESSAGE_HEAD: u64 = 128;

/// Shared memory of a run with `ranks` workers whose longest message has `max_len` values: an upper bound, close for
/// long messages.
///
/// Per rank it counts the buffers of its messages and of both control streams. Small files add to them: one for every
/// pair of ranks and about two dozen for every rank, whose sizes grow with the number of ranks.
pub fn required_shared_memory_bytes(ranks: usize, max_len: usize) -> u64 {
    let control = 2 * segment_bytes(FRAME_MAX as u64);
    let per_rank = rank_bytes(ranks, max_len).saturating_add(control);
    per_rank.saturating_mul(ranks as u64).saturating_add(16 * PAGE)
}

/// A publisher's buffers for messages of up to `message` bytes. The sum saturates, so that an absurd size is refused
/// like any other size that does not fit.
fn segment_bytes(message: u64) -> u64 {
    (message.saturating_add(MESSAGE_HEAD) / PAGE + 2).saturating_mul(BUFFERS as u64 * PAGE)
}

/// Bytes of one rank's end of the data transport.
fn rank_bytes(ranks: usize, max_len: usize) -> u64 {
    let values = segment_bytes((max_len as u64).saturating_mul(size_of::<f32>() as u64));
    values.saturating_add(PAGE * (2 * ranks as u64 + 24))
}

/// Checks that the free shared memory suffices for one rank's end of the data transport.
pub(super) fn check_free_for_rank(ranks: usize, max_len: usize) -> Result<(), SharedMemoryError> {
    check(rank_bytes(ranks, max_len), shared_memory_space()?.1)
}

/// Checks that the free shared memory suffices for the control channel of a run.
pub(super) fn check_free_for_control(ranks: usize) -> Result<(), SharedMemoryError> {
    check(ranks as u64 * 2 * segment_bytes(FRAME_MAX as u64) + 16 * PAGE, shared_memory_space()?.1)
}

fn check(required: u64, available: u64) -> Result<(), SharedMemoryError> {
    if required > available { Err(SharedMemoryError::TooSmall { required, available }) } else { Ok(()) }
}

/// Checks that `available` bytes of shared memory suffice for such a run; see [`shared_memory_space`].
pub fn check_shared_memory(ranks: usize, max_len: usize, available: u64) -> Result<(), SharedMemoryError> {
    check(required_shared_memory_bytes(ranks, max_len), available)
}

/// Time that a run waits for other runs that are setting up.
const TURN_LIMIT: Duration = Duration::from_secs(60);

/// Exclusive permission to set up a run. Between the check of the free shared memory and its reservation by all workers
/// no other run of this program may take any. Otherwise two runs would count the same free memory, and the later one
/// would end by SIGBUS.
#[derive(Debug)]
pub struct SetupTurn {
    /// Holds the lock on the folder of the shared memory; none if it could not be acquired.
    _lock: Option<File>,
}

impl SetupTurn {
    /// Waits until no other run of this machine is setting up, at most one minute (a run that hangs there must not
    /// block all others), and not after `stop` returns true.
    pub fn wait(stop: impl Fn() -> bool) -> SetupTurn {
        let Ok(folder) = File::open(SHARED_MEMORY_FOLDER) else { return SetupTurn { _lock: None } };
        let mut clock = AwakeClock::start();
        let mut told = false;
        loop {
            match folder.try_lock() {
                Ok(()) => return SetupTurn { _lock: Some(folder) },
                Err(TryLockError::WouldBlock) if clock.elapsed() < TURN_LIMIT && !stop() => {
                    if clock.elapsed() > Duration::from_secs(1) && !std::mem::replace(&mut told, true) {
                        note("waiting for another run to set up");
                    }
                    std::thread::sleep(Duration::from_millis(10));
                }
                // Without the lock the run starts anyway; a lack of memory is then found later.
                Err(_) => return SetupTurn { _lock: None },
            }
        }
    }
}

/// Size and free bytes of the machine's shared memory.
pub fn shared_memory_space() -> Result<(u64, u64), SharedMemoryError> {
    let space = statvfs(SHARED_MEMORY_FOLDER);
    let space = space.map_err(|error| SharedMemoryError::Unreadable { source: error.into() })?;
    Ok((space.f_blocks * space.f_frsize, space.f_bavail * space.f_frsize))
}

/// Whether the folder of the shared memory is mounted read-only, so that no run can start.
pub fn shared_memory_is_read_only() -> bool {
    statvfs(SHARED_MEMORY_FOLDER).is_ok_and(|space| space.f_flag.contains(StatVfsMountFlags::RDONLY))
}

/// Allocates memory for all shared-memory files of the run, so that a lack of it is an error here and not a SIGBUS
/// later.
pub(super) fn reserve(run: &RunName) -> Result<(), SharedMemoryError> {
    for (path, bytes) in run.shared_memory_files() {
        // Files may appear and disappear while others start; removed files need no memory.
        let Ok(file) = OpenOptions::new().read(true).write(true).open(&path) else { continue };
        if bytes > 0 {
            let reserved = fallocate(&file, FallocateFlags::KEEP_SIZE, 0, bytes);
            reserved.map_err(|error| SharedMemoryError::Reserve { bytes, source: error.into() })?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_run_sets_up_at_a_time() {
        let turn = SetupTurn::wait(|| false);
        assert!(turn._lock.is_some());
        assert!(SetupTurn::wait(|| true)._lock.is_none(), "taken, and told not to wait");
        let next = std::thread::spawn(|| SetupTurn::wait(|| false)._lock.is_some());
        std::thread::sleep(Duration::from_millis(30));
        assert!(!next.is_finished());
        drop(turn);
        assert!(next.join().unwrap());
    }

    #[test]
    fn the_check_names_need_and_have() {
        let required = required_shared_memory_bytes(4, 300_000);
        assert!(check_shared_memory(4, 300_000, required).is_ok());
        let error = check_shared_memory(4, 300_000, 10 << 20).unwrap_err().to_string();
        assert!(error.contains("/dev/shm has 10.0 MiB free") && error.contains("this run needs 2"), "{error}");
        // 4 ranks x 3 buffers x 1.2 MB and small files.
        assert!((14_400_000..25_000_000).contains(&required), "{required}");
        let (total, free) = shared_memory_space().unwrap();
        assert!(free <= total && total > 0);
    }
}
