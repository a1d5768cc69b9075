//! A run directory that is looked at again and again while somebody else writes it, deletes it or starts it anew.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::known::Known;
use super::lanes::Lanes;
use super::layer;
use crate::output::{Report, RunDirectory};

/// A long report is read at most in this share of the time, because its run needs the processor.
const SHARE: u32 = 50;

/// A run directory and what was read of it last.
pub struct Watched {
    path: PathBuf,
    inner: Mutex<Inner>,
    known: Mutex<Option<(Stamp, Result<Known, String>)>>,
}

/// What tells two versions of a file apart: inode, length, time of the last change.
type Stamp = [i128; 3];

#[derive(Default)]
struct Inner {
    report: Option<(Stamp, Arc<Report>)>,
    /// Not before this time the report is read again.
    next_look: Option<Instant>,
    lanes: Option<(Stamp, Arc<Result<Lanes, String>>)>,
    generation: u64,
    started_unix_s: u64,
    frames: Vec<u32>,
}

/// A look at a run.
pub(super) struct Look {
    /// Goes up when the run was started anew, so that nothing of the old one may be shown any more.
    pub generation: u64,
    /// Frames of the run, and of the coarse run of a split shot.
    pub frames: Vec<u32>,
    pub coarse: Vec<u32>,
    /// The report with what tells its versions apart.
    pub report: Option<(String, Arc<Report>)>,
    /// Seconds since the report was written.
    pub silent_s: Option<f64>,
}

impl Watched {
    /// The run in `path`, which need not be there yet.
    pub fn new(path: &Path) -> Watched {
        Watched { path: path.to_path_buf(), inner: Mutex::new(Inner::default()), known: Mutex::new(None) }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// The folder of the coarse run of a split shot.
    pub(super) fn preview(&self) -> PathBuf {
        self.path.join("preview")
    }

    /// What is there now.
    pub(super) fn look(&self) -> Look {
        let (frames, coarse) = (layer::frames(&self.path), layer::frames(&self.preview()));
        let mut inner = lock(&self.inner);
        let silent_s = inner.read_report(&self.path.join("report.json"));
        let started_unix_s = inner.report.as_ref().map_or(0, |(_, report)| report.header.started_unix_s);
        let lost = inner.frames.iter().any(|frame| frames.binary_search(frame).is_err());
        // A run that is gone is still shown; it is another one when it comes back.
        let started_anew = ![0, inner.started_unix_s].contains(&started_unix_s) && inner.started_unix_s != 0;
        if (lost && !frames.is_empty()) || started_anew {
            inner.generation += 1;
        }
        if !frames.is_empty() || !lost {
            inner.frames.clone_from(&frames);
        }
        if started_unix_s != 0 {
            inner.started_unix_s = started_unix_s;
        }
        let report = inner.report.as_ref().map(|(stamp, report)| (format!("{stamp:x?}"), report.clone()));
        Look { generation: inner.generation, frames, coarse, report, silent_s }
    }

    /// The trace.
    pub(super) fn lanes(&self) -> Arc<Result<Lanes, String>> {
        let path = self.path.join("trace.json");
        let Some(stamp) = stamp(&path) else {
            return Arc::new(Err("no trace.json: loomtree run --trace-steps N keeps one".into()));
        };
        if let Some((known, lanes)) = &lock(&self.inner).lanes
            && *known == stamp
        {
            return lanes.clone();
        }
        let lanes = Arc::new(Lanes::load(&path));
        lock(&self.inner).lanes = Some((stamp, lanes.clone()));
        lanes
    }

    /// What the recorded scene says, for `use_it`. Read once per version of run.toml.
    pub(super) fn known<T>(&self, use_it: impl FnOnce(&mut Known) -> Result<T, String>) -> Result<T, String> {
        let directory = RunDirectory::open(&self.path).map_err(|error| error.to_string())?;
        let stamp = stamp(&directory.manifest()).ok_or("no run.toml, so nothing is known of the scene")?;
        let mut known = lock(&self.known);
        if known.as_ref().is_none_or(|(of, _)| *of != stamp) {
            *known = Some((stamp, Known::load(&directory)));
        }
        match known.as_mut() {
            Some((_, Ok(known))) => use_it(known),
            Some((_, Err(why))) => Err(why.clone()),
            None => Err("nothing is known of the scene".into()),
        }
    }
}

impl Inner {
    /// Reads the report if it has changed; returns the seconds since it was written.
    fn read_report(&mut self, path: &Path) -> Option<f64> {
        let Some(found) = stamp(path) else {
            self.report = None;
            return None;
        };
        let silent = fs::metadata(path).and_then(|meta| meta.modified()).ok()?.elapsed().unwrap_or_default();
        let now = Instant::now();
        let is_old = self.report.as_ref().is_none_or(|(known, _)| *known != found);
        if is_old && self.next_look.is_none_or(|next| now >= next) {
            // One that cannot be read is one that is about to be replaced.
            if let Ok(report) = Report::load(path) {
                self.report = Some((found, Arc::new(report)));
            }
            self.next_look = Some(now + (now.elapsed() * SHARE).min(Duration::from_secs(10)));
        }
        Some(silent.as_secs_f64())
    }
}

fn stamp(path: &Path) -> Option<Stamp> {
    let meta = fs::metadata(path).ok()?;
    let changed_ns = i128::from(meta.mtime()) * 1_000_000_000 + i128::from(meta.mtime_nsec());
    Some([i128::from(meta.ino()), i128::from(meta.len()), changed_ns])
}

/// Whoever panicked with the lock left nothing half done that a look could not make good.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::{ReportHeader, ply};

    #[test]
    fn a_run_may_go_and_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let watched = Watched::new(&run);
        let look = watched.look();
        assert!(look.frames.is_empty() && look.report.is_none() && look.generation == 0);

        let write = |started_unix_s: u64, frames: u32| {
            fs::create_dir_all(run.join("frames")).unwrap();
            let header = ReportHeader { started_unix_s, ..ReportHeader::default() };
            Report { header, ..Report::default() }.save(&run.join("report.json")).unwrap();
            for frame in 0..frames {
                let mut bytes = Vec::new();
                ply::write(&mut bytes, &mut Vec::new(), &[], &[]).unwrap();
                fs::write(run.join(format!("frames/frame_{frame:06}.ply")), bytes).unwrap();
            }
        };
        let look_again = || {
            lock(&watched.inner).next_look = None;
            watched.look()
        };
        write(100, 2);
        let look = look_again();
        assert_eq!((look.frames.len(), look.generation, look.report.is_some()), (2, 0, true));
        write(100, 4);
        assert_eq!((look_again().frames.len(), look_again().generation), (4, 0));
        // Deleted, and started anew with fewer frames in the same second.
        fs::remove_dir_all(&run).unwrap();
        let look = look_again();
        assert_eq!((look.frames.len(), look.generation, look.report.is_some()), (0, 0, false));
        write(100, 1);
        assert_eq!(look_again().generation, 1);
        // Overwritten later, with more frames.
        write(105, 3);
        assert_eq!(look_again().generation, 2);
        assert_eq!(look_again().generation, 2);
    }
}
