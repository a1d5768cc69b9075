//! Shared memory that a run needs: said before the start, reserved at the start. Without that a full `/dev/shm` shows up
//! as SIGBUS at the first touch of a page, long after the start.

use std::fs::OpenOptions;

use rustix::fs::{FallocateFlags, fallocate, statvfs};
use thiserror::Error;

use super::RunName;
use super::run_name::SHARED_MEMORY_FOLDER;

/// Start of every message, bytes: a cache line, and what vector loads like.
pub(super) const MESSAGE_ALIGNMENT: usize = 64;

/// Why there is not enough shared memory.
#[derive(Debug, Error)]
pub enum SharedMemoryError {
    /// Known before the start.
    #[error(
        "{} has {} free and this run needs {}: enlarge it (docker: --shm-size) or use fewer workers",
        SHARED_MEMORY_FOLDER, mib(*available), mib(*required)
    )]
    TooSmall { required: u64, available: u64 },
    /// Found at the start (others took it in the meantime).
    #[error("cannot reserve {} in {}: {source}", mib(*bytes), SHARED_MEMORY_FOLDER)]
    Reserve { bytes: u64, source: std::io::Error },
    /// There is no shared memory, or it cannot be looked at.
    #[error("cannot look at {}: {source}", SHARED_MEMORY_FOLDER)]
    Unreadable { source: std::io::Error },
}

fn mib(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / (1u64 << 20) as f64)
}

/// Backs all shared-memory files of the run with memory, so that a lack of it is an error here and no SIGBUS later.
pub(super) fn reserve(run: &RunName) -> Result<(), SharedMemoryError> {
    for (path, bytes) in run.shared_memory_files() {
        // Files come and go while others start; those that went need nothing.
        let Ok(file) = OpenOptions::new().read(true).write(true).open(&path) else { continue };
        if bytes > 0 {
            let reserved = fallocate(&file, FallocateFlags::KEEP_SIZE, 0, bytes);
            reserved.map_err(|error| SharedMemoryError::Reserve { bytes, source: error.into() })?;
        }
    }
    Ok(())
}

/// Size and free bytes of the machine's shared memory.
pub fn shared_memory_space() -> Result<(u64, u64), SharedMemoryError> {
    let space = statvfs(SHARED_MEMORY_FOLDER);
    let space = space.map_err(|error| SharedMemoryError::Unreadable { source: error.into() })?;
    Ok((space.f_blocks * space.f_frsize, space.f_bavail * space.f_frsize))
}
