//! Files of a run on the machine and their removal: a folder under the temp directory, shared-memory files with the
//! run's prefix, and one small file per process of the run. The last process to leave removes everything; [`list_runs`]
//! finds the files of killed runs. Locks decide whether a run is alive (`run_lock`). Files for which they cannot decide
//! are left alone, as are files of other users.

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use thiserror::Error;

use super::process::start_ticks;
use super::run_lock::{self, Lock, Membership};

/// Where POSIX shared memory lives on Linux.
pub const SHARED_MEMORY_FOLDER: &str = "/dev/shm";

const ID_LEN: usize = 10;
const FOLDER_PREFIX: &str = "loomtree-";
const SHARED_MEMORY_PREFIX: &str = "lt";
const PROCESSES: &str = "processes";
/// Time that the last member waits for copies of its locks to be closed.
const COPIES_LIMIT: Duration = Duration::from_secs(1);
/// Name of both locks of a run; next to the shared memory it follows the prefix.
const LOCK: &str = "lock";
/// Longest path of the temp directory that leaves room for `/loomtree-<id>/` and a socket's name within the 108 bytes
/// of a Unix socket address (roots of 60 bytes were seen to work, 80 not).
const TEMP_PATH_MAX: usize = 35;

/// Error of creating, listing or removing the resources of a run.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
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
    /// Creates a new run: its locks, its folder, and the calling process registered in it as `role`. The first file is
    /// a held lock, so that other processes never take a run at its start for a dead one.
    pub fn create(role: &str) -> Result<(RunName, RunMember), RunError> {
        loop {
            let run = RunName { id: new_id() };
            let [in_shared_memory, in_folder] = run.locks();
            let held = match run_lock::create(&in_shared_memory) {
                Ok(held) => held,
                // The name is taken.
                Err(error) if matches!(error.kind(), ErrorKind::AlreadyExists | ErrorKind::NotFound) => continue,
                Err(error) => return Err(io("create", &in_shared_memory)(error)),
            };
            let root = run.root();
            // Users other than the user of the run must not access its folder.
            let made = fs::DirBuilder::new().mode(0o700).create(&root);
            if made.as_ref().is_err_and(|error| error.kind() == ErrorKind::AlreadyExists) {
                let _ = fs::remove_file(&in_shared_memory);
                continue;
            }
            let registered = made.map_err(io("create", &root)).and_then(|()| {
                let locks = [held, run_lock::create(&in_folder).map_err(io("create", &in_folder))?];
                Ok((Membership::of(locks), register_in(&root, &run, role)?))
            });
            match registered {
                Ok((locks, entry)) => {
                    let file = root.join(PROCESSES).join(entry);
                    return Ok((run.clone(), RunMember { run, file, locks: Some(locks) }));
                }
                Err(error) => {
                    let _ = run.purge();
                    return Err(error);
                }
            }
        }
    }

    /// Registers the calling process as a member of this run; it counts as alive until the returned value is dropped
    /// or the process ends.
    pub fn join(&self, role: &str) -> Result<RunMember, RunError> {
        let root = self.root();
        let locks = Membership::join(&self.locks()).map_err(|(path, source)| match source.kind() {
            ErrorKind::NotFound => self.missing(),
            _ => RunError::Io { action: "join", path, source },
        })?;
        let entry = register_in(&root, self, role)?;
        Ok(RunMember { run: self.clone(), file: root.join(PROCESSES).join(entry), locks: Some(locks) })
    }

    fn missing(&self) -> RunError {
        let source = std::io::Error::new(ErrorKind::NotFound, format!("run {self} does not exist (any more)"));
        RunError::Io { action: "join", path: self.root(), source }
    }

    /// The lock next to the shared memory and the one in the folder.
    fn locks(&self) -> [PathBuf; 2] {
        let in_shared_memory = Path::new(SHARED_MEMORY_FOLDER).join(format!("{}{LOCK}", self.shared_memory_prefix()));
        [in_shared_memory, self.root().join(LOCK)]
    }

    /// Whether the run is alive.
    pub fn state(&self) -> RunState {
        self.look().0
    }

    /// The state, and for a dead run the locks that keep it dead.
    fn look(&self) -> (RunState, Vec<fs::File>) {
        let (mut free, mut unreadable) = (Vec::new(), false);
        for path in self.locks() {
            match run_lock::look(&path) {
                Lock::Held => return (RunState::Alive, Vec::new()),
                Lock::Free(file) => free.push(file),
                Lock::Unreadable => unreadable = true,
                Lock::Missing => {}
            }
        }
        match () {
            _ if unreadable => (RunState::Unknown, Vec::new()),
            _ if !free.is_empty() => (RunState::Dead, free),
            _ if self.root().exists() || !self.shared_memory_files().is_empty() => (RunState::Unknown, free),
            _ => (RunState::Gone, free),
        }
    }

    /// Folder of the run's small files and sockets; short enough for a socket's path.
    pub fn root(&self) -> PathBuf {
        temp_folder().join(format!("{FOLDER_PREFIX}{}", self.id))
    }

    /// Prefix of the names of all shared-memory files of the run.
    pub fn shared_memory_prefix(&self) -> String {
        format!("{SHARED_MEMORY_PREFIX}{}_", self.id)
    }

    /// Processes registered in this run, including killed ones; processes that left in order have removed their entry.
    pub fn members(&self) -> Vec<Member> {
        let Ok(entries) = fs::read_dir(self.root().join(PROCESSES)) else { return Vec::new() };
        let mut members: Vec<Member> =
            entries.filter_map(|entry| parse_member(&fs::read_to_string(entry.ok()?.path()).ok()?)).collect();
        members.sort_by_key(|member| member.pid);
        members
    }

    /// Shared-memory files of this run that belong to the calling user, without its lock: path and size in bytes. Files
    /// of other users with such a name belong to them.
    pub fn shared_memory_files(&self) -> Vec<(PathBuf, u64)> {
        let prefix = self.shared_memory_prefix();
        let [lock, _] = self.locks();
        let Ok(entries) = fs::read_dir(SHARED_MEMORY_FOLDER) else { return Vec::new() };
        entries
            .flatten()
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix) && is_own(entry))
            .filter(|entry| entry.path() != lock)
            .filter_map(|entry| Some((entry.path(), entry.metadata().ok()?.len())))
            .collect()
    }

    /// Removes all files of this run, its locks last. Only for runs without a living process: mapped memory stays
    /// usable, but further connections are impossible.
    ///
    /// # Errors
    /// A file of the run exists and cannot be removed.
    pub fn purge(&self) -> Result<(), RunError> {
        for (path, _) in self.shared_memory_files() {
            ignore_missing(fs::remove_file(&path)).map_err(io("remove", &path))?;
        }
        let (root, [in_shared_memory, in_folder]) = (self.root(), self.locks());
        for entry in fs::read_dir(&root).into_iter().flatten().flatten().filter(|entry| entry.path() != in_folder) {
            let path = entry.path();
            let removed = match entry.file_type() {
                Ok(kind) if kind.is_dir() => fs::remove_dir_all(&path),
                _ => fs::remove_file(&path),
            };
            ignore_missing(removed).map_err(io("remove", &path))?;
        }
        // Other members may remove the same folder at the same time.
        for attempt in 0.. {
            match ignore_missing(fs::remove_dir_all(&root)) {
                Err(_) if attempt < 3 && root.exists() => std::thread::yield_now(),
                done => {
                    done.map_err(io("remove", &root))?;
                    break;
                }
            }
        }
        ignore_missing(fs::remove_file(&in_shared_memory)).map_err(io("remove", &in_shared_memory))
    }

    /// Calls [`RunName::purge`] if the run is known to have no living process; returns whether all its files are gone.
    pub fn purge_if_last(&self) -> Result<bool, RunError> {
        match self.look() {
            (RunState::Dead, _locks) => self.purge().map(|()| true),
            (RunState::Gone, _) => Ok(true),
            (RunState::Alive | RunState::Unknown, _) => Ok(false),
        }
    }
}

/// State of a run by its locks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunState {
    /// One of its processes lives, here or in another pid namespace.
    Alive,
    /// None of its processes lives; its files can be removed.
    Dead,
    /// It does not have a lock that can be checked: its folder may belong to another machine's shared memory, or an
    /// older version of this program may have made it.
    Unknown,
    /// None of its files exist.
    Gone,
}

/// Membership of the calling process in a run. Dropping it leaves the run, and removes the run's files if no other
/// member is left. Keep it until all transports of the process are dropped. `std::process::exit` skips that.
#[derive(Debug)]
pub struct RunMember {
    run: RunName,
    file: PathBuf,
    /// Present until dropped.
    locks: Option<Membership>,
}

impl RunMember {
    /// The run.
    pub fn run(&self) -> &RunName {
        &self.run
    }
}

impl Drop for RunMember {
    fn drop(&mut self) {
        // Leave first, then check: of two members that leave at the same time the later one sees no other.
        let _ = fs::remove_file(&self.file);
        self.locks = None;
        // A child process that another thread is starting holds copies of the locks until it executes the other
        // program.
        let start = Instant::now();
        loop {
            match self.run.purge_if_last() {
                Ok(false) if start.elapsed() < COPIES_LIMIT && !self.run.members().iter().any(Member::is_alive) => {
                    std::thread::sleep(Duration::from_millis(2));
                }
                Ok(_) => return,
                Err(error) => return tracing::warn!("{error}"),
            }
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
    /// Its role, for example "coordinator" or "worker 3".
    pub role: String,
}

impl Member {
    /// True while this process runs (not another one with the same number, not a zombie).
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
    /// Whether it is alive.
    pub state: RunState,
    /// Number of shared-memory files.
    pub shared_memory_files: usize,
    /// Sum of their sizes, bytes (reserved, not necessarily touched).
    pub shared_memory_bytes: u64,
}

/// Minimum age of a run that [`remove_dead_runs`] removes. Before that its own processes may still be removing it, or a
/// user may be inspecting it.
const SETTLED: Duration = Duration::from_secs(60);

/// Removes the files of dead runs of the calling user as far as possible. A coordinator that is killed before its first
/// worker has started leaves no process to do it.
pub fn remove_dead_runs() {
    let is_settled = |lock: &PathBuf| {
        let made = fs::metadata(lock).and_then(|metadata| metadata.modified());
        made.is_ok_and(|made| made.elapsed().is_ok_and(|age| age > SETTLED))
    };
    for found in list_runs().into_iter().filter(|found| found.run.locks().iter().any(is_settled)) {
        if let Err(error) = found.run.purge_if_last() {
            tracing::warn!("{error}");
        }
    }
}

/// All runs of the calling user with files on this machine, alive or stale, by name.
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
                state: run.state(),
                shared_memory_files: files.len(),
                shared_memory_bytes: files.iter().map(|(_, bytes)| bytes).sum(),
                members,
                run,
            }
        })
        .collect()
}

/// True if the file belongs to the calling user, because runs of other users must be left alone.
fn is_own(entry: &fs::DirEntry) -> bool {
    entry.metadata().is_ok_and(|metadata| metadata.uid() == rustix::process::geteuid().as_raw())
}

/// The system's temp directory, or `/tmp` if its name is not valid for the sockets of a run.
fn temp_folder() -> PathBuf {
    let folder = std::env::temp_dir();
    if fits_sockets(&folder) { folder } else { PathBuf::from("/tmp") }
}

/// True if the path is short and plain enough: iceoryx2 accepts ASCII only, and not all of it.
fn fits_sockets(folder: &Path) -> bool {
    let bytes = folder.as_os_str().as_encoded_bytes();
    let plain = |byte: &u8| (byte.is_ascii_graphic() || *byte == b' ') && !b"<>\"|?*\\".contains(byte);
    (1..=TEMP_PATH_MAX).contains(&bytes.len()) && bytes.iter().all(plain)
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
        return Err(run.missing());
    }
    fs::create_dir_all(&folder).map_err(io("create", &folder))?;
    let pid = std::process::id();
    let line = format!("{pid} {} {}\n", start_ticks(pid).unwrap_or(0), role.replace('\n', " "));
    // A process may be a member more than once (tests are).
    let entry = format!("{pid}-{}", COUNT.fetch_add(1, Ordering::Relaxed));
    let file = folder.join(&entry);
    // Written to another file and renamed, so that a reader never sees half a line.
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
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
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
        assert!(found.state == RunState::Alive && found.shared_memory_files == 1 && found.shared_memory_bytes == 4);
        drop(first);
        assert!(run.root().exists() && shared.exists() && !run.purge_if_last().unwrap());
        drop(second);
        assert!(!run.root().exists() && !shared.exists() && run.locks().iter().all(|lock| !lock.exists()));
        // A second purge is allowed; joining the run is not.
        assert!(run.purge_if_last().unwrap() && run.state() == RunState::Gone);
        let error = run.join("late").unwrap_err().to_string();
        assert!(error.contains("does not exist"), "{error}");
    }

    /// Under another TMPDIR the folder is not seen, in a container with memory of its own the files are not.
    #[test]
    fn one_lock_is_enough_to_tell() {
        let (run, member) = RunName::create("coordinator").unwrap();
        let folder = run.root();
        let elsewhere = folder.with_file_name(format!("elsewhere-{run}"));
        fs::rename(&folder, &elsewhere).unwrap();
        assert!(run.state() == RunState::Alive && !run.purge_if_last().unwrap());
        assert!(run.join("late").is_err(), "there is no folder to join");
        fs::rename(&elsewhere, &folder).unwrap();
        let in_shared_memory = &run.locks()[0];
        let away = in_shared_memory.with_file_name(format!("elsewhere-{run}"));
        fs::rename(in_shared_memory, &away).unwrap();
        assert!(run.state() == RunState::Alive && !run.purge_if_last().unwrap());
        fs::rename(&away, in_shared_memory).unwrap();
        drop(member);
        assert_eq!(run.state(), RunState::Gone);
    }

    /// Without a lock the run is not known to be dead.
    #[test]
    fn what_has_no_lock_is_left_alone() {
        let run = RunName { id: new_id() };
        let shared = Path::new(SHARED_MEMORY_FOLDER).join(format!("{}leftover", run.shared_memory_prefix()));
        fs::write(&shared, "").unwrap();
        assert!(list_runs().iter().any(|found| found.run == run && found.state == RunState::Unknown));
        assert!(!run.purge_if_last().unwrap() && shared.exists());
        fs::remove_file(&shared).unwrap();
        assert_eq!(run.state(), RunState::Gone);
    }

    #[test]
    fn folders_that_sockets_cannot_have_are_left() {
        assert!(["/tmp", "/var/tmp/a b", "/x/y-1_2.3"].iter().all(|path| fits_sockets(Path::new(path))));
        let long = "/".repeat(TEMP_PATH_MAX + 1);
        assert!(
            ["", "/tmp/gr\u{fc}n", "/tmp/a\nb", "/tmp/what?", &long].iter().all(|path| !fits_sockets(Path::new(path)))
        );
    }
}
