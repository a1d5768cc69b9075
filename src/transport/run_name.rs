//! What a run leaves on the machine, and how it goes away: a folder under the temp directory, shared-memory files with
//! the run's prefix, and one small file per process of the run. Whoever leaves last removes everything; what killed
//! runs left behind is found by [`list_runs`]. It does not touch what belongs to runs with a living process.

use std::fs;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use thiserror::Error;

use super::process::start_ticks;

/// Where POSIX shared memory lives on Linux.
pub const SHARED_MEMORY_FOLDER: &str = "/dev/shm";

const ID_LEN: usize = 10;
const FOLDER_PREFIX: &str = "loomtree-";
const SHARED_MEMORY_PREFIX: &str = "lt";
const PROCESSES: &str = "processes";
/// Longest path of the temp directory that leaves room for `/loomtree-<id>/` and a socket's name within the 108 bytes
/// of a Unix socket address (roots of 60 bytes were seen to work, 80 not).
const TEMP_PATH_MAX: usize = 35;

/// Why the resources of a run could not be created, listed or removed.
#[derive(Debug, Error)]
pub enum RunError {
    /// Not an identifier made by [`RunName::create`].
    #[error("'{text}' is no run identifier: expected {ID_LEN} digits or lower-case letters")]
    BadName { text: String },
    /// A file operation failed.
    #[error("cannot {action} {}: {source}", path.display())]
    Io { action: &'static str, path: PathBuf, source: std::io::Error },
}

fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> RunError + use<> {
    let path = path.to_path_buf();
    move |source| RunError::Io { action, path, source }
}

/// Unique short name of a run on this machine; everything the run creates outside its output folder carries it.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct RunName {
    id: String,
}

impl std::fmt::Display for RunName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.id)
    }
}

impl std::str::FromStr for RunName {
    type Err = RunError;

    fn from_str(text: &str) -> Result<RunName, RunError> {
        let good = text.len() == ID_LEN && text.bytes().all(|b| b.is_ascii_digit() || b.is_ascii_lowercase());
        if good { Ok(RunName { id: text.to_string() }) } else { Err(RunError::BadName { text: text.to_string() }) }
    }
}

impl RunName {
    /// Makes a new run: its folder, with the calling process registered in it as `role`. The folder appears with that
    /// entry already inside, so that nobody ever sees a living run without a process.
    pub fn create(role: &str) -> Result<(RunName, RunMember), RunError> {
        loop {
            let run = RunName { id: new_id() };
            let prepared = temp_folder().join(format!(".{FOLDER_PREFIX}{}", run.id));
            // Others than the user of the run have no business in its folder.
            fs::DirBuilder::new().mode(0o700).create(&prepared).map_err(io("create", &prepared))?;
            // Renaming onto a folder that is not empty fails: then the name is taken and another one is tried.
            let renamed = register_in(&prepared, &run, role)
                .and_then(|entry| fs::rename(&prepared, run.root()).map_err(io("rename", &prepared)).map(|()| entry));
            match renamed {
                Ok(entry) => {
                    let file = run.root().join(PROCESSES).join(entry);
                    return Ok((run.clone(), RunMember { run, file }));
                }
                Err(error) => {
                    let taken = run.root().exists();
                    let _ = fs::remove_dir_all(&prepared);
                    if !taken {
                        return Err(error);
                    }
                }
            }
        }
    }

    /// Registers the calling process as a member of this run; it counts as alive until the returned value is dropped
    /// or the process ends.
    pub fn join(&self, role: &str) -> Result<RunMember, RunError> {
        let entry = register_in(&self.root(), self, role)?;
        Ok(RunMember { run: self.clone(), file: self.root().join(PROCESSES).join(entry) })
    }

    /// Folder of the run's small files and sockets; short enough for a socket's path.
    pub fn root(&self) -> PathBuf {
        temp_folder().join(format!("{FOLDER_PREFIX}{}", self.id))
    }

    /// Prefix of the names of all shared-memory files of the run.
    pub fn shared_memory_prefix(&self) -> String {
        format!("{SHARED_MEMORY_PREFIX}{}_", self.id)
    }

    /// Processes registered in this run, dead ones too; those that ended in an orderly way are gone.
    pub fn members(&self) -> Vec<Member> {
        let Ok(entries) = fs::read_dir(self.root().join(PROCESSES)) else { return Vec::new() };
        let mut members: Vec<Member> =
            entries.filter_map(|entry| parse_member(&fs::read_to_string(entry.ok()?.path()).ok()?)).collect();
        members.sort_by_key(|member| member.pid);
        members
    }

    /// Shared-memory files of this run: path and size in bytes.
    pub fn shared_memory_files(&self) -> Vec<(PathBuf, u64)> {
        let prefix = self.shared_memory_prefix();
        let Ok(entries) = fs::read_dir(SHARED_MEMORY_FOLDER) else { return Vec::new() };
        entries
            .flatten()
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
            .filter_map(|entry| Some((entry.path(), entry.metadata().ok()?.len())))
            .collect()
    }

    /// Removes everything of this run. Only for runs without a living process: memory that is still mapped stays
    /// usable, but no further connection can be made.
    ///
    /// # Errors
    /// Something of it is there and cannot be removed (it belongs to another user, for example).
    pub fn purge(&self) -> Result<(), RunError> {
        for (path, _) in self.shared_memory_files() {
            ignore_missing(fs::remove_file(&path)).map_err(io("remove", &path))?;
        }
        let root = self.root();
        // Members may be removing the same folder at the same time.
        for attempt in 0.. {
            match ignore_missing(fs::remove_dir_all(&root)) {
                Err(_) if attempt < 3 && root.exists() => std::thread::yield_now(),
                done => return done.map_err(io("remove", &root)),
            }
        }
        Ok(())
    }

    /// [`RunName::purge`] if no process of the run is alive; says whether it did.
    pub fn purge_if_last(&self) -> Result<bool, RunError> {
        if self.members().iter().any(Member::is_alive) {
            return Ok(false);
        }
        self.purge().map(|()| true)
    }
}

/// Membership of the calling process in a run. Dropping it leaves the run, and removes everything of the run if nobody
/// else is left: keep it until all transports of the process are gone. `std::process::exit` skips that.
#[derive(Debug)]
pub struct RunMember {
    run: RunName,
    file: PathBuf,
}

impl RunMember {
    /// The run.
    pub fn run(&self) -> &RunName {
        &self.run
    }
}

impl Drop for RunMember {
    fn drop(&mut self) {
        // Leave first, then look: of two members that leave at the same time the later one sees nobody.
        let _ = fs::remove_file(&self.file);
        if let Err(error) = self.run.purge_if_last() {
            tracing::warn!("{error}");
        }
    }
}

/// A process that registered itself in a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Member {
    /// Process number.
    pub pid: u32,
    /// Start of the process, clock ticks since boot.
    pub start_ticks: u64,
    /// What it said it was, for example "coordinator" or "worker 3".
    pub role: String,
}

impl Member {
    /// True while that very process runs (not another one with the same number, not a zombie).
    pub fn is_alive(&self) -> bool {
        start_ticks(self.pid) == Some(self.start_ticks)
    }
}

/// A run found on this machine.
#[derive(Clone, Debug)]
pub struct FoundRun {
    /// Its name.
    pub run: RunName,
    /// Its registered processes.
    pub members: Vec<Member>,
    /// True if one of them is alive.
    pub alive: bool,
    /// Number of shared-memory files.
    pub shared_memory_files: usize,
    /// Their sizes added up, bytes (reserved, not necessarily touched).
    pub shared_memory_bytes: u64,
}

/// All runs of the calling user that have left something on this machine, alive or stale, by name.
pub fn list_runs() -> Vec<FoundRun> {
    let named = |folder: &Path, prefix: &str, rest_is_id: bool| -> Vec<RunName> {
        let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
        let id_of = |name: String| {
            let rest = name.strip_prefix(prefix)?;
            let id = if rest_is_id { rest } else { rest.get(..ID_LEN).filter(|_| rest[ID_LEN..].starts_with('_'))? };
            id.parse::<RunName>().ok()
        };
        entries
            .flatten()
            .filter(is_own)
            .filter_map(|entry| id_of(entry.file_name().to_string_lossy().into_owned()))
            .collect()
    };
    let mut runs = named(&temp_folder(), FOLDER_PREFIX, true);
    runs.extend(named(Path::new(SHARED_MEMORY_FOLDER), SHARED_MEMORY_PREFIX, false));
    runs.sort_by(|a, b| a.id.cmp(&b.id));
    runs.dedup();
    runs.into_iter()
        .map(|run| {
            let members = run.members();
            let files = run.shared_memory_files();
            FoundRun {
                alive: members.iter().any(Member::is_alive),
                shared_memory_files: files.len(),
                shared_memory_bytes: files.iter().map(|(_, bytes)| bytes).sum(),
                members,
                run,
            }
        })
        .collect()
}

/// Belongs to the calling user: what others run here is theirs to look after.
fn is_own(entry: &fs::DirEntry) -> bool {
    entry.metadata().is_ok_and(|metadata| metadata.uid() == rustix::process::geteuid().as_raw())
}

/// The system's temp directory, or `/tmp` where that is too long for the sockets of a run.
fn temp_folder() -> PathBuf {
    let folder = std::env::temp_dir();
    if folder.as_os_str().len() <= TEMP_PATH_MAX { folder } else { PathBuf::from("/tmp") }
}

fn new_id() -> String {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let nanos = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
    let seed = format!("{} {nanos} {}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
    let mut number = xxhash_rust::xxh3::xxh3_64(seed.as_bytes());
    (0..ID_LEN)
        .map(|_| {
            let digit = char::from_digit((number % 36) as u32, 36).unwrap_or('0');
            number /= 36;
            digit
        })
        .collect()
}

/// Writes the calling process into the run's folder `root`; returns the name of its file in `processes`.
fn register_in(root: &Path, run: &RunName, role: &str) -> Result<String, RunError> {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let folder = root.join(PROCESSES);
    if !root.is_dir() {
        let source = std::io::Error::new(std::io::ErrorKind::NotFound, format!("run {run} does not exist (any more)"));
        return Err(RunError::Io { action: "join", path: root.to_path_buf(), source });
    }
    fs::create_dir_all(&folder).map_err(io("create", &folder))?;
    let pid = std::process::id();
    let line = format!("{pid} {} {}\n", start_ticks(pid).unwrap_or(0), role.replace('\n', " "));
    // A process may be a member more than once (tests are).
    let entry = format!("{pid}-{}", COUNT.fetch_add(1, Ordering::Relaxed));
    let file = folder.join(&entry);
    // Written aside and renamed: a reader never sees half a line.
    let aside = root.join(format!("{entry}.new"));
    fs::write(&aside, line).map_err(io("write", &aside))?;
    fs::rename(&aside, &file).map_err(io("write", &file))?;
    Ok(entry)
}

fn parse_member(text: &str) -> Option<Member> {
    let mut parts = text.trim_end().splitn(3, ' ');
    Some(Member {
        pid: parts.next()?.parse().ok()?,
        start_ticks: parts.next()?.parse().ok()?,
        role: parts.next().unwrap_or("").to_string(),
    })
}

fn ignore_missing(result: std::io::Result<()>) -> std::io::Result<()> {
    match result {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_checked() {
        assert_eq!("0123456xyz".parse::<RunName>().unwrap().to_string(), "0123456xyz");
        for bad in ["", "short", "01234567890", "UPPERCASE0", "../../../x", "0123 56xyz"] {
            let error = bad.parse::<RunName>().unwrap_err().to_string();
            assert!(error.contains(&format!("'{bad}'")), "{error}");
        }
        let names: std::collections::HashSet<String> = (0..1000).map(|_| new_id()).collect();
        assert_eq!(names.len(), 1000);
        assert!(names.iter().all(|name| name.parse::<RunName>().is_ok()));
    }

    #[test]
    fn the_last_member_removes_the_run() {
        let (run, first) = RunName::create("coordinator").unwrap();
        assert!(run.root().as_os_str().len() <= TEMP_PATH_MAX + 1 + FOLDER_PREFIX.len() + ID_LEN);
        let second = run.join("worker 0").unwrap();
        let mut roles: Vec<String> = run.members().into_iter().map(|member| member.role).collect();
        roles.sort();
        assert_eq!(roles, ["coordinator", "worker 0"]);
        assert!(run.members().iter().all(|member| member.is_alive() && member.pid == std::process::id()));
        let shared = Path::new(SHARED_MEMORY_FOLDER).join(format!("{}leftover", run.shared_memory_prefix()));
        fs::write(&shared, "four").unwrap();
        assert_eq!(run.shared_memory_files(), [(shared.clone(), 4)]);
        let found = list_runs().into_iter().find(|found| found.run == run).unwrap();
        assert!(found.alive && found.shared_memory_files == 1 && found.shared_memory_bytes == 4);
        drop(first);
        assert!(run.root().exists() && shared.exists() && !run.purge_if_last().unwrap());
        drop(second);
        assert!(!run.root().exists() && !shared.exists());
        // Shared memory without a folder is found, too; leaving a purged run and purging it again are fine.
        fs::write(&shared, "").unwrap();
        assert!(list_runs().iter().any(|found| found.run == run && !found.alive));
        assert!(run.purge_if_last().unwrap() && run.purge_if_last().unwrap());
        assert!(!shared.exists());
        let error = run.join("late").unwrap_err().to_string();
        assert!(error.contains("does not exist"), "{error}");
    }
}
