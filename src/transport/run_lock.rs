//! Locks that tell whether a run is alive, in any pid namespace and with any temp directory of the caller. A run has
//! two: a file next to its shared memory and one in its folder, because either may be visible without the other. Every
//! process of the run holds both as shared locks. A process that can lock one exclusively knows that the run is dead.
//!
//! The locks are `flock`s. The system releases them with the process, however it ends. They do not work across
//! machines.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Time that a joining process waits for another process's check of the lock; a check takes microseconds.
const LOOK_LIMIT: Duration = Duration::from_secs(2);

/// State of a lock.
#[derive(Debug)]
pub(super) enum Lock {
    /// A process of the run holds it.
    Held,
    /// No process holds it, and none can while this value exists.
    Free(File),
    /// The file does not exist.
    Missing,
    /// It cannot be opened or locked, for example because it belongs to another user.
    Unreadable,
}

/// Creates the file and holds a shared lock on it.
///
/// # Errors
/// `AlreadyExists`, or the error of the system.
pub(super) fn create(path: &Path) -> io::Result<File> {
    let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    hold(path, file)
}

/// Holds a shared lock on the existing file.
///
/// # Errors
/// `NotFound` if it does not exist or is being removed.
pub(super) fn join(path: &Path) -> io::Result<File> {
    hold(path, OpenOptions::new().write(true).open(path)?)
}

fn hold(path: &Path, file: File) -> io::Result<File> {
    let start = Instant::now();
    loop {
        match file.try_lock_shared() {
            Ok(()) => break,
            Err(TryLockError::WouldBlock) if start.elapsed() < LOOK_LIMIT => {
                std::thread::sleep(Duration::from_millis(1));
            }
            Err(TryLockError::WouldBlock) => return Err(io::ErrorKind::NotFound.into()),
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
    // A process that removes a dead run may have locked this file before it was locked here.
    match is_at(&file, path) {
        true => Ok(file),
        false => Err(io::ErrorKind::NotFound.into()),
    }
}

/// Checks a lock without waiting.
pub(super) fn look(path: &Path) -> Lock {
    let file = match OpenOptions::new().write(true).open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Lock::Missing,
        Err(_) => return Lock::Unreadable,
    };
    match file.try_lock() {
        Ok(()) if is_at(&file, path) => Lock::Free(file),
        Ok(()) => Lock::Missing,
        Err(TryLockError::WouldBlock) => Lock::Held,
        Err(TryLockError::Error(_)) => Lock::Unreadable,
    }
}

/// True if `file` is the one that `path` names.
fn is_at(file: &File, path: &Path) -> bool {
    let (Ok(own), Ok(named)) = (file.metadata(), fs::symlink_metadata(path)) else { return false };
    (own.dev(), own.ino()) == (named.dev(), named.ino())
}

/// The locks of a process that belongs to a run.
#[derive(Debug)]
pub(super) struct Membership {
    _locks: [File; 2],
}

impl Membership {
    /// Joins a run by its two locks.
    ///
    /// # Errors
    /// The path that failed, and the error of the system.
    pub(super) fn join(paths: &[PathBuf; 2]) -> Result<Membership, (PathBuf, io::Error)> {
        let open = |path: &PathBuf| join(path).map_err(|error| (path.clone(), error));
        Ok(Membership { _locks: [open(&paths[0])?, open(&paths[1])?] })
    }

    /// Takes locks that are held already.
    pub(super) fn of(locks: [File; 2]) -> Membership {
        Membership { _locks: locks }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_is_free_once_its_last_holder_is_gone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        assert!(matches!(look(&path), Lock::Missing));
        assert_eq!(join(&path).unwrap_err().kind(), io::ErrorKind::NotFound);
        let first = create(&path).unwrap();
        assert_eq!(create(&path).unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
        let second = join(&path).unwrap();
        assert!(matches!(look(&path), Lock::Held));
        drop(first);
        assert!(matches!(look(&path), Lock::Held));
        drop(second);
        let Lock::Free(cleaner) = look(&path) else { panic!("nobody holds it") };
        assert!(matches!(look(&path), Lock::Held), "while somebody removes the run, nobody else does");
        // A process that joins during the removal finds no run.
        let late = std::thread::spawn({
            let path = path.clone();
            move || join(&path).map(drop).unwrap_err().kind()
        });
        std::thread::sleep(Duration::from_millis(20));
        fs::remove_file(&path).unwrap();
        drop(cleaner);
        assert_eq!(late.join().unwrap(), io::ErrorKind::NotFound);
    }
}
