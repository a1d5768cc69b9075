//! The run directory: paths of all files of a run, and the lock that allows one writer.
//!
//! ```text
//! RUN_DIR/report.json  report.html  run.toml  run_scene.<toml|json>  trace.json  trace_steps.json  rest.obj  cloth.pc2
//!         run_changes.toml  live.sock  (of a run that is steered while it goes on)
//!         rest_2.obj  cloth_2.pc2  (the second mesh of a run that sews)
//!         frames/frame_%06d.<ext>  frames/obstacle_%06d.<ext>  checkpoint/step_%08d.ltc
//!         states/step_%08d.ltc  pictures/*.png
//!         preview/  segments/%03d/  segments/%03d/seam/  segments/%03d/sweep_%03d/
//! ```
//! The last line is that of a shot split in time: the coarse run, and until the shot is done the segments, the
//! hand-overs between them and their sweeps, each a run directory.
//!
//! On a network file system without locks, two machines can still write to the same directory.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::atomic::{self, PART_SUFFIX};

/// How an existing run in the directory is treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Existing {
    /// Refuse, so that results are never lost by accident.
    Refuse,
    /// Delete the files of the old run and no others.
    Overwrite,
    /// Resume the run, which must exist.
    Resume,
}

/// Why a run directory cannot be used. Nothing has been written to it.
#[derive(Debug, Error)]
pub enum DirectoryError {
    /// The path is a file.
    #[error("{} is a file, but a run needs a folder; choose another with --out", .0.display())]
    NotAFolder(PathBuf),
    /// The folder cannot be created or written to.
    #[error("cannot write to {}: {source}; choose another folder with --out", path.display())]
    Unwritable {
        /// The run directory.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The directory holds a run, and neither `--resume` nor `--overwrite` was given.
    #[error("{} already holds a run; continue it with --resume, replace it with --overwrite, or choose another folder with --out", .0.display())]
    HoldsARun(PathBuf),
    /// `--resume` was given, but the directory holds no run.
    #[error("{} holds no run to continue; leave out --resume to start one", .0.display())]
    NothingToResume(PathBuf),
    /// Another process is writing a run there.
    #[error("{} is in use by another run that has not ended; choose another folder with --out", .0.display())]
    InUse(PathBuf),
    /// The folder is not a run directory. Only commands that read one return this.
    #[error("{} is not a run directory: no report.json, run.toml or frames in it", .0.display())]
    NotARun(PathBuf),
}

/// A run directory that this process may write to, or only read if it came from [`RunDirectory::open`].
#[derive(Debug)]
pub struct RunDirectory {
    path: PathBuf,
    /// Lock on the folder, held until it is dropped.
    _lock: Option<File>,
}

/// Files at the top level of a run directory.
const FILES: [&str; 13] = [
    "report.json",
    "run.toml",
    "run_scene.toml",
    "run_scene.json",
    "trace.json",
    "trace_steps.json",
    "cloth.pc2",
    "rest.obj",
    "cloth_2.pc2",
    "rest_2.obj",
    "report.html",
    "start.ltc",
    "run_changes.toml",
];
/// Sub-folders, with the prefixes of the names of a run's files in them.
const FOLDERS: [(&str, &[&str]); 4] = [
    ("frames", &["frame_", "obstacle_"]),
    ("checkpoint", &["step_"]),
    ("states", &["step_"]),
    ("pictures", &["frame_", "contact_sheet", "side_by_side"]),
];

impl RunDirectory {
    /// Prepares `path` for a run: creates the folders, locks them against a second run and removes leftovers.
    pub fn create(path: &Path, existing: Existing) -> Result<RunDirectory, DirectoryError> {
        let own = || path.to_path_buf();
        let unwritable = |e| DirectoryError::Unwritable { path: own(), source: atomic::without_temporary_name(e) };
        if path.exists() && !path.is_dir() {
            return Err(DirectoryError::NotAFolder(own()));
        }
        match (holds_run(path), existing) {
            (true, Existing::Refuse) => return Err(DirectoryError::HoldsARun(own())),
            (false, Existing::Resume) => return Err(DirectoryError::NothingToResume(own())),
            _ => {}
        }
        fs::create_dir_all(path).map_err(unwritable)?;
        // Permission bits do not show every obstacle (root, read-only mounts, quotas), so a file is created to try.
        tempfile::Builder::new().prefix(".").suffix(PART_SUFFIX).tempfile_in(path).map_err(unwritable)?;
        let lock = lock(path)?;
        if existing == Existing::Overwrite {
            remove_run(path).map_err(unwritable)?;
        }
        for folder in ["frames", "checkpoint"] {
            fs::create_dir_all(path.join(folder)).map_err(unwritable)?;
            atomic::remove_parts(&path.join(folder));
        }
        // A run that was killed leaves its socket.
        let _ = fs::remove_file(path.join("live.sock"));
        atomic::remove_parts(&path.join("states"));
        atomic::remove_parts(path);
        Ok(RunDirectory { path: own(), _lock: lock })
    }

    /// Opens an existing run directory for reading.
    pub fn open(path: &Path) -> Result<RunDirectory, DirectoryError> {
        if holds_run(path) {
            Ok(RunDirectory { path: path.to_path_buf(), _lock: None })
        } else {
            Err(DirectoryError::NotARun(path.to_path_buf()))
        }
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        &self.path
    }
    /// `report.json`.
    pub fn report(&self) -> PathBuf {
        self.path.join("report.json")
    }
    /// `run.toml`.
    pub fn manifest(&self) -> PathBuf {
        self.path.join("run.toml")
    }
    /// `trace.json`.
    pub fn trace(&self) -> PathBuf {
        RunDirectory::trace_in(&self.path)
    }
    /// `trace.json` of the run directory `path`.
    pub fn trace_in(path: &Path) -> PathBuf {
        path.join("trace.json")
    }
    /// `trace_steps.json`: events of the first steps of a shot that is split in time, whose `trace.json` has its jobs.
    pub fn trace_of_steps(&self) -> PathBuf {
        self.path.join("trace_steps.json")
    }
    /// `cloth.pc2`: the whole animation in one file.
    pub fn point_cache(&self) -> PathBuf {
        self.path.join("cloth.pc2")
    }
    /// `cloth_2.pc2`: the frames of the second stage of a run that sews.
    pub fn second_point_cache(&self) -> PathBuf {
        self.path.join("cloth_2.pc2")
    }
    /// `rest_2.obj`: the mesh that `cloth_2.pc2` moves.
    pub fn second_rest_mesh(&self) -> PathBuf {
        self.path.join("rest_2.obj")
    }
    /// `rest.obj`: the mesh that `cloth.pc2` moves.
    pub fn rest_mesh(&self) -> PathBuf {
        self.path.join("rest.obj")
    }
    /// `start.ltc`: where the cloth of a run started that has taken its start from another one.
    pub fn start(&self) -> PathBuf {
        self.path.join("start.ltc")
    }
    /// `run_changes.toml`: what was changed while the run went on.
    pub fn changes(&self) -> PathBuf {
        self.path.join("run_changes.toml")
    }
    /// `frames/`.
    pub fn frames(&self) -> PathBuf {
        self.path.join("frames")
    }
    /// `checkpoint/`.
    pub fn checkpoints(&self) -> PathBuf {
        self.path.join("checkpoint")
    }
    /// `states/`: states that are kept permanently.
    pub fn states(&self) -> PathBuf {
        self.path.join("states")
    }

    /// The run directory of the coarse run of a shot that is split in time.
    pub fn preview(&self) -> PathBuf {
        self.path.join("preview")
    }

    /// `pictures/`.
    pub fn pictures(&self) -> PathBuf {
        self.path.join("pictures")
    }
}

fn lock(path: &Path) -> Result<Option<File>, DirectoryError> {
    let Ok(folder) = File::open(path) else { return Ok(None) };
    match folder.try_lock() {
        Ok(()) => Ok(Some(folder)),
        Err(TryLockError::WouldBlock) => Err(DirectoryError::InUse(path.to_path_buf())),
        // A run is not refused on a file system without locks.
        Err(TryLockError::Error(_)) => Ok(None),
    }
}

fn is_run_file(name: &str, prefixes: &[&str]) -> bool {
    prefixes.iter().any(|prefix| name.starts_with(prefix))
}

fn numbered_files(path: &Path) -> impl Iterator<Item = PathBuf> {
    FOLDERS.into_iter().flat_map(move |(folder, prefixes)| {
        let entries = fs::read_dir(path.join(folder)).into_iter().flatten().flatten();
        entries.filter(move |e| is_run_file(&e.file_name().to_string_lossy(), prefixes)).map(|e| e.path())
    })
}

fn holds_run(path: &Path) -> bool {
    FILES.iter().any(|name| path.join(name).exists()) || numbered_files(path).next().is_some()
}

fn remove_run(path: &Path) -> io::Result<()> {
    let own = FILES.iter().map(|name| path.join(name)).filter(|file| file.is_file());
    own.chain(numbered_files(path)).try_for_each(fs::remove_file)?;
    let segments: Vec<PathBuf> =
        fs::read_dir(path.join("segments")).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    // Those inside first.
    let parts_of = |segment: &PathBuf| {
        let entries = fs::read_dir(segment).into_iter().flatten().flatten().map(|entry| entry.path());
        let is_part = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name == "seam" || name.starts_with("sweep_")
        };
        entries.filter(is_part).collect::<Vec<_>>()
    };
    let inner = segments.iter().flat_map(parts_of).chain(segments.iter().cloned());
    for part in inner.chain([path.join("preview")]).filter(|part| part.is_dir()) {
        remove_run(&part)?;
        // Folders that hold something else stay.
        for folder in FOLDERS.iter().map(|(name, _)| part.join(name)).chain([part.clone()]) {
            let _ = fs::remove_dir(folder);
        }
    }
    let _ = fs::remove_dir(path.join("segments"));
    Ok(())
}
