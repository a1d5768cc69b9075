//! Files that appear whole or not at all: written beside their final place, then renamed. A link keeps its place and the
//! file that it names is replaced; a device or a FIFO is written to as it is.
//!
//! Does not promise durability: after a power cut the newest file may be empty (nothing is fsynced).

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// A file could not be written; an earlier file of the same name is untouched.
#[derive(Debug, Error)]
#[error("cannot write {}: {source}", path.display())]
pub struct WriteError {
    /// The file that should have come to be.
    pub path: PathBuf,
    /// What the system said.
    pub source: io::Error,
}

impl WriteError {
    /// Names `path` in an error of the system.
    pub fn at(path: &Path) -> impl FnOnce(io::Error) -> WriteError + use<> {
        let path = path.to_path_buf();
        move |source| WriteError { path, source }
    }
}

/// Ending of files that are still being written.
pub(super) const PART_SUFFIX: &str = ".part";

/// Creates or replaces `path` with what `write` puts out. If `write` fails or the process dies, `path` stays as it was,
/// unless it is a device, FIFO or socket: those take what comes.
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
        // tempfile's default is private to the user; results are as readable as any other file (the umask still applies).
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

/// Finds out whether [`write_atomically`] could write to `path`, without changing anything there.
///
/// # Errors
/// What the system says against it.
pub fn check_writable(path: &Path) -> io::Result<()> {
    if is_special(path) {
        // Opening a FIFO would wait for its reader, and its reader would see an end at once.
        return Ok(rustix::fs::access(path, rustix::fs::Access::WRITE_OK)?);
    }
    let target = end_of_links(path)?;
    if target.is_dir() {
        return Err(io::ErrorKind::IsADirectory.into());
    }
    tempfile::tempfile_in(folder_of(&target)).map(drop).map_err(without_temporary_name)
}

/// True for a device, FIFO or socket, also at the end of links.
fn is_special(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|metadata| !metadata.is_file() && !metadata.is_dir())
}

/// Links that lead to a file: as many as Linux follows.
const LINKS_MOST: usize = 40;

/// The place that `path` names once its links have been followed, whether or not there is a file.
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

/// The system's own error: tempfile adds the random name of its file, which says nothing to a user.
pub(super) fn without_temporary_name(error: io::Error) -> io::Error {
    let text = error.to_string();
    match text.split_once(" at path \"") {
        Some((plain, _)) => io::Error::new(error.kind(), plain),
        None => error,
    }
}

/// Removes what a killed process left half-written in `folder`. Problems are ignored: the files harm nobody.
pub(super) fn remove_parts(folder: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with('.') && name.ends_with(PART_SUFFIX) {
            let _ = fs::remove_file(entry.path());
        }
    }
}
