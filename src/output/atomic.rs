//! Atomic files: written under a temporary name beside their final place, then renamed. A symbolic link stays and the
//! file that it names is replaced. Devices and FIFOs are written to directly.
//!
//! Durability is not guaranteed: nothing is fsynced, so the newest file can be empty after a power failure.

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// A file could not be written; an earlier file of the same name is untouched.
#[derive(Debug, Error)]
#[error("cannot write {}: {source}", path.display())]
pub struct WriteError {
    /// The file that could not be written.
    pub path: PathBuf,
    /// The error of the operating system.
    pub source: io::Error,
}

impl WriteError {
    /// Returns a function that adds `path` to an error of the operating system.
    pub fn at(path: &Path) -> impl FnOnce(io::Error) -> WriteError + use<> {
        let path = path.to_path_buf();
        move |source| WriteError { path, source }
    }
}

/// Ending of files that are still being written.
pub(super) const PART_SUFFIX: &str = ".part";

/// Creates or replaces `path` with the output of `write`. If `write` fails or the process dies, `path` keeps its
/// content, unless it is a device, FIFO or socket.
pub fn write_atomically(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), WriteError> {
    let attempt = || -> io::Result<()> {
        if is_special(path) {
            let mut writer = BufWriter::with_capacity(1 << 18, fs::OpenOptions::new().write(true).open(path)?);
            write(&mut writer)?;
            return writer.flush();
        }
        let target = end_of_links(path)?;
        let mut builder = tempfile::Builder::new();
        builder.prefix(".").suffix(PART_SUFFIX);
        // Files of tempfile are private to the user by default. Results get the usual permissions instead, subject to
        // the umask.
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        let file = builder.tempfile_in(folder_of(&target))?;
        let mut writer = BufWriter::with_capacity(1 << 18, file);
        write(&mut writer)?;
        let file = writer.into_inner().map_err(|e| e.into_error())?;
        file.persist(&target).map_err(|e| e.error)?;
        Ok(())
    };
    attempt().map_err(|source| WriteError { path: path.to_path_buf(), source: without_temporary_name(source) })
}

/// Checks that [`write_atomically`] can write to `path`, without changing anything there.
///
/// # Errors
/// The reason of the operating system why it cannot.
pub fn check_writable(path: &Path) -> io::Result<()> {
    if is_special(path) {
        // A FIFO is not opened: opening would wait for its reader, and the reader would then see the end of the stream.
        return Ok(rustix::fs::access(path, rustix::fs::Access::WRITE_OK)?);
    }
    let target = end_of_links(path)?;
    if target.is_dir() {
        return Err(io::ErrorKind::IsADirectory.into());
    }
    tempfile::tempfile_in(folder_of(&target)).map(drop).map_err(without_temporary_name)
}

/// True for a device, FIFO or socket, also through symbolic links.
fn is_special(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|metadata| !metadata.is_file() && !metadata.is_dir())
}

/// Limit of symbolic links that are followed, the same as in Linux.
const LINKS_MOST: usize = 40;

/// Follows symbolic links to the final path, which need not exist.
fn end_of_links(path: &Path) -> io::Result<PathBuf> {
    let mut place = path.to_path_buf();
    for _ in 0..=LINKS_MOST {
        if !fs::symlink_metadata(&place).is_ok_and(|metadata| metadata.is_symlink()) {
            return Ok(place);
        }
        let named = fs::read_link(&place)?;
        place = folder_of(&place).join(named);
    }
    Err(rustix::io::Errno::LOOP.into())
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// The error of the operating system without the random file name that tempfile adds, because users do not know that
/// name.
pub(super) fn without_temporary_name(error: io::Error) -> io::Error {
    let text = error.to_string();
    match text.split_once(" at path \"") {
        Some((plain, _)) => io::Error::new(error.kind(), plain),
        None => error,
    }
}

/// Removes unfinished files that a killed process left in `folder`. Errors are ignored, because the files do no harm.
pub(super) fn remove_parts(folder: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with('.') && name.ends_with(PART_SUFFIX) {
            let _ = fs::remove_file(entry.path());
        }
    }
}
