//! The iceoryx2 node of a process. All its files stay within the run's folder and prefix.

use std::fmt::Debug;
use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::time::Duration;

use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::event::PortFactory;
use rustix::fs::{Access, StatVfsMountFlags, access, statvfs};

use crate::transport::RunName;
use crate::transport::run_name::SHARED_MEMORY_FOLDER;
use crate::transport::wait::{Patience, Stopped};

/// The iceoryx2 service variant: shared memory between processes, ports bound to one thread.
pub(super) type Ipc = ipc::Service;

/// Pause between two attempts to open a resource that another process is about to create.
const OPEN_PAUSE: Duration = Duration::from_millis(1);

/// A folder with less room than this counts as full after an error.
const FEW_FILES: u64 = 16;
const FEW_BYTES: u64 = 64 << 10;

/// A node of `run`. It avoids `Config::global_config()`, because that reads files from the working directory, the home
/// directory and /etc.
pub(super) fn create_node(run: &RunName, name: &str) -> Result<Node<Ipc>, String> {
    // Errors are returned; log lines of the library would only disturb a terminal.
    set_log_level(LogLevel::Fatal);
    let root = run.root();
    let root = root.to_str().ok_or_else(|| format!("the path {} is not valid UTF-8", root.display()))?;
    let mut config = Config::default();
    config.global.prefix = FileName::new(run.shared_memory_prefix().as_bytes()).map_err(text("prefix"))?;
    config.global.set_root_path(&Path::new(root.as_bytes()).map_err(text("root path"))?);
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    let node = NodeBuilder::new()
        .name(&NodeName::new(name).map_err(text("node name"))?)
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Ipc>()
        .map_err(text("node"))?;
    keep_private(run)?;
    Ok(node)
}

/// Removes the rights of other users on the run's shared memory. iceoryx2 lets every user write to its counter of
/// nodes, and a user who shortens that file hangs the run. A process that has opened the file already keeps its right,
/// so a private copy replaces the file; iceoryx2 opens the counter again for every node.
fn keep_private(run: &RunName) -> Result<(), String> {
    for (path, _) in run.shared_memory_files().iter().filter(|(path, _)| is_open_to_others(path)) {
        let copy = path.with_extension("private");
        let copied = std::fs::read(path).and_then(|bytes| {
            if bytes.is_empty() {
                return Err(std::io::Error::other("another user has emptied it"));
            }
            let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&copy)?;
            file.write_all(&bytes)?;
            std::fs::rename(&copy, path)
        });
        match copied {
            // Another process of the run does the same.
            Err(error) if matches!(error.kind(), ErrorKind::AlreadyExists | ErrorKind::NotFound) => {}
            done => done.map_err(|error| format!("node: {}: {error}", path.display()))?,
        }
    }
    Ok(())
}

fn is_open_to_others(path: &std::path::Path) -> bool {
    std::fs::metadata(path).is_ok_and(|metadata| metadata.permissions().mode() & 0o077 != 0)
}

/// Converts an error of iceoryx2 to an error message of ours.
pub(super) fn text<E: Debug>(what: &'static str) -> impl Fn(E) -> String {
    move |error| {
        let name = format!("{error:?}");
        match lack_of_machine().or_else(|| meaning(&name).map(str::to_owned)) {
            Some(meaning) => format!("{what}: {meaning} ({name})"),
            None => format!("{what}: {name}"),
        }
    }
}

/// What the machine lacks right now, if it can be seen. One lack appears under many names of iceoryx2.
fn lack_of_machine() -> Option<String> {
    if let Some(shortage) = descriptor_shortage() {
        return Some(format!("{shortage}: raise the limit (ulimit -n) or use fewer workers"));
    }
    lack_of_folder(std::path::Path::new(SHARED_MEMORY_FOLDER)).or_else(|| lack_of_folder(&std::env::temp_dir()))
}

/// Why no file can be made in a folder.
fn lack_of_folder(folder: &std::path::Path) -> Option<String> {
    let name = folder.display();
    let space = match statvfs(folder) {
        Ok(space) => space,
        Err(error) => return Some(format!("{name}: {}", std::io::Error::from(error))),
    };
    if space.f_flag.contains(StatVfsMountFlags::RDONLY) {
        return Some(format!("{name} is read-only"));
    }
    // What failed has often given back what it took, so a few files or bytes that are free now do not count.
    if space.f_files > 0 && space.f_favail < FEW_FILES {
        return Some(format!("{name} has room for {} more files only (df -i {name})", space.f_favail));
    }
    if space.f_bavail * space.f_frsize < FEW_BYTES {
        return Some(format!("{name} is full (df {name})"));
    }
    let may_write = access(folder, Access::WRITE_OK | Access::EXEC_OK).is_ok();
    (!may_write).then(|| format!("no right to write to {name}"))
}

/// Usual cause on the machine of an error of iceoryx2, for errors that users meet.
fn meaning(name: &str) -> Option<&'static str> {
    let has = |words: &[&str]| words.iter().any(|word| name.contains(word));
    match () {
        _ if has(&["HandleLimit", "FileDescriptor"]) => Some("too many open files (ulimit -n)"),
        _ if has(&["UnableToCreateDataSegment", "UnableToCreateManagementSegment", "Memory"]) => {
            Some("/dev/shm does not take a file of that size (df /dev/shm, ulimit -f)")
        }
        _ if has(&["Permission", "ReadOnly"]) => Some("no right to write to /dev/shm or to the temp folder"),
        _ if has(&["NoSpaceLeft", "ResourceCreationFailed"]) => {
            Some("a file in /dev/shm or in the temp folder cannot be made (full, read-only, or too long a path)")
        }
        _ if has(&["InternalFailure", "InternalError"]) => {
            Some("the system refuses something, and iceoryx2 does not say what; strace names the call")
        }
        _ if has(&["CorruptedState", "ServiceInCorruptedState", "DoesNotExist", "Corrupted"]) => {
            Some("files of the run in /dev/shm or in the temp folder were removed or changed while it ran")
        }
        _ if has(&["Exceeds"]) => Some("more processes of the run than it was made for"),
        _ => None,
    }
}

pub(super) fn service_name(name: &str) -> Result<ServiceName, String> {
    ServiceName::new(name).map_err(text("service name"))
}

/// A wake-up service with one listener and up to `notifiers` notifiers, each in a process of its own.
pub(super) fn create_wake(node: &Node<Ipc>, name: &ServiceName, notifiers: usize) -> Result<PortFactory<Ipc>, String> {
    node.service_builder(name)
        .event()
        .max_listeners(1)
        .max_notifiers(notifiers.max(1))
        .max_nodes(notifiers + 1)
        .event_id_max_value(0)
        .create()
        .map_err(text("wake-up service"))
}

/// Error text if this process may not open one more file.
fn descriptor_shortage() -> Option<String> {
    let error = std::fs::File::open("/dev/null").err()?;
    [rustix::io::Errno::MFILE, rustix::io::Errno::NFILE]
        .iter()
        .any(|errno| error.raw_os_error() == Some(errno.raw_os_error()))
        .then(|| error.to_string())
}

/// Error of opening a resource that another process creates.
pub(super) enum OpenError {
    /// It did not appear in time, or the run was stopped.
    Stopped(Stopped),
    /// It exists and does not match.
    Failed(String),
}

/// Opens a resource that another process creates; retries until it exists.
pub(super) fn open_when_created<T, E: Debug>(
    patience: &mut Patience,
    what: &'static str,
    mut open: impl FnMut() -> Result<T, E>,
) -> Result<T, OpenError> {
    let mut wait = patience.begin();
    loop {
        let error = match open() {
            Ok(opened) => return Ok(opened),
            Err(error) => format!("{error:?}"),
        };
        // A shortage of descriptors appears here under different names, and waiting does not help.
        if let Some(shortage) = descriptor_shortage() {
            return Err(OpenError::Failed(format!("{what}: {shortage}")));
        }
        // Half-created services appear under many names; errors that name a mismatch are permanent.
        if ["Incompatible", "DoesNotSupport", "Exceeds", "VersionMismatch"].iter().any(|word| error.contains(word)) {
            return Err(OpenError::Failed(format!("{what}: {error}")));
        }
        if let Some(limit) = patience.back_off(&mut wait).map_err(OpenError::Stopped)? {
            std::thread::sleep(limit.min(OPEN_PAUSE));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_errors_become_sentences() {
        let refused = |name: &'static str| meaning(name).is_some();
        // As they were seen with a full, read-only or inaccessible /dev/shm, without descriptors, with removed files.
        for name in [
            "UnableToCreateDataSegment",
            "InsufficientPermissions",
            "InternalFailure",
            "ServiceInCorruptedState",
            "UnableToOpenFileDescriptor",
            "ExceedsMaxSupportedNodes",
            "FailedToMap(Memory)",
        ] {
            assert!(refused(name), "{name}");
        }
        assert_eq!(meaning("SomethingElse"), None);
    }

    #[test]
    fn the_lack_of_a_folder_is_named() {
        let none = std::path::Path::new("/nowhere/at/all");
        assert_eq!(lack_of_folder(none).unwrap(), "/nowhere/at/all: No such file or directory (os error 2)");
        assert_eq!(lack_of_folder(&std::env::temp_dir()), None);
        assert_eq!(lack_of_machine(), None);
    }
}
