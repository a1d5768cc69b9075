//! Runs that write a run directory, and what is in one.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;

use loomtree::coordinator::plan::scene_text;
use loomtree::coordinator::{Scope, TimePlan, run_split};
use loomtree::os::{console, signals};
use loomtree::output::{Checkpoint, Existing, FrameSource, RunDirectory, RunManifest, pc2};
use loomtree::scene::read_str;
use loomtree::{Launch, RunError, RunOptions, RunPlaces, RunPlan, RunSummary};
use numpy::PyArray2;
use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;

use crate::options::options_of;
use crate::simulation::{rows_of_indices, rows_of_three};
use crate::wait::{News, nap};
use crate::{bad_input, failed};

/// A stop is asked for by a flag of the process, so that there is one run at a time.
static IS_RUNNING: AtomicBool = AtomicBool::new(false);

/// Frees the place of the run of this process.
struct Running;

impl Running {
    fn begin() -> PyResult<Running> {
        if IS_RUNNING.swap(true, Ordering::Relaxed) {
            return Err(failed("another run of this process is not done yet"));
        }
        signals::forget_stop();
        Ok(Running)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        signals::forget_stop();
        IS_RUNNING.store(false, Ordering::Relaxed);
    }
}

/// Makes the run of a scene file. Returns the number of the last frame, and whether the run was stopped by `progress`.
#[pyfunction]
pub(crate) fn run(
    py: Python<'_>,
    scene: PathBuf,
    out: PathBuf,
    options: &str,
    overwrite: bool,
    progress: Option<Py<PyAny>>,
) -> PyResult<(u32, bool)> {
    let existing = if overwrite { Existing::Overwrite } else { Existing::Refuse };
    let (options, places) = (options_of(options)?, RunPlaces { scene, out, existing });
    make(py, None, options, places, progress)
}

/// Goes on with a run, on `workers` workers if given.
#[pyfunction]
pub(crate) fn resume(
    py: Python<'_>,
    out: PathBuf,
    workers: Option<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<(u32, bool)> {
    let directory = RunDirectory::open(&out).map_err(bad_input)?;
    let manifest = RunManifest::load(&directory).map_err(bad_input)?;
    let mut options: RunOptions = manifest.flags().map_err(bad_input)?;
    options.workers = workers.unwrap_or(options.workers);
    let text = manifest.text_to_read();
    let places = RunPlaces { scene: manifest.scene_path, out, existing: Existing::Resume };
    make(py, Some(text), options, places, progress)
}

/// `text`: what the scene file held, if the run goes on with it.
fn make(
    py: Python<'_>,
    text: Option<String>,
    options: RunOptions,
    places: RunPlaces,
    progress: Option<Py<PyAny>>,
) -> PyResult<(u32, bool)> {
    let _running = Running::begin()?;
    console::be_quiet();
    let out = places.out.clone();
    let (tell, told) = channel();
    let told = Mutex::new(told);
    let thread = std::thread::Builder::new().name("loomtree".into());
    let thread = thread.spawn(move || drop(tell.send(made(text, &options, &places)))).map_err(failed)?;
    let (mut error, mut shown, mut wanted) = (None, None, None);
    let summary = loop {
        match nap(py, &told) {
            News::Message(summary) => break summary,
            News::End => return Err(failed("the run has ended without a word")),
            News::Nothing => {}
        }
        let tried = py.check_signals().and_then(|()| match &progress {
            Some(progress) => tell_frame(py, &out, progress, &mut shown, &mut wanted),
            None => Ok(true),
        });
        if !matches!(tried, Ok(true)) {
            signals::request_stop();
        }
        if let (Err(raised), None) = (tried, &error) {
            error = Some(raised);
        }
    };
    drop(thread.join());
    if let Some(error) = error {
        return Err(error);
    }
    let summary = summary.map_err(|error| match error {
        RunError::BadInput(text) => bad_input(text),
        RunError::Stopped(text) => PyKeyboardInterrupt::new_err(text),
        RunError::Failed(text) => failed(text),
    })?;
    if let Some(progress) = &progress {
        tell_frame(py, &out, progress, &mut shown, &mut wanted)?;
    }
    let last = newest_frame(&out).unwrap_or(0);
    Ok((last, summary.stopped))
}

fn made(text: Option<String>, options: &RunOptions, places: &RunPlaces) -> Result<RunSummary, RunError> {
    let bad_input = |error: &dyn std::fmt::Display| RunError::BadInput(error.to_string());
    if options.time.segments > 1 {
        let text = match text {
            Some(text) => text,
            None => scene_text(&places.scene, &options.set).map_err(|error| bad_input(&error))?,
        };
        let plan = TimePlan::new(&text, &places.scene, options).map_err(|error| bad_input(&error))?;
        return run_split(&plan, options, places, Scope::All, &Launch::Threads);
    }
    let plan = match text {
        None => RunPlan::new(&places.scene, options)?,
        Some(text) => {
            let parsed = read_str(&text, &places.scene).map_err(|error| bad_input(&error))?;
            RunPlan::of_parsed(&parsed, options, Some(&places.out.join("start.ltc")))?
        }
    };
    loomtree::run(plan, options, places, &Launch::Threads)
}

/// Calls `progress(frame, frames)` if there is a new frame. False if it returned False.
fn tell_frame(
    py: Python<'_>,
    out: &Path,
    progress: &Py<PyAny>,
    shown: &mut Option<u32>,
    wanted: &mut Option<u32>,
) -> PyResult<bool> {
    let frame = newest_frame(out);
    if frame == *shown {
        return Ok(true);
    }
    let Some(frame) = frame else { return Ok(true) };
    if wanted.is_none() {
        *wanted = frames_wanted(out);
    }
    *shown = Some(frame);
    let answer = progress.call1(py, (frame, *wanted))?;
    Ok(answer.is_none(py) || answer.is_truthy(py)?)
}

/// Number of the newest frame, without reading any.
fn newest_frame(out: &Path) -> Option<u32> {
    let directory = RunDirectory::open(out).ok()?;
    let number = |name: &str| name.strip_prefix("frame_")?.split('.').next()?.parse().ok();
    let files = std::fs::read_dir(directory.frames()).into_iter().flatten().flatten();
    let of_files = files.filter_map(|file| number(file.file_name().to_str()?)).max();
    let of_cache = || {
        let cache = directory.point_cache();
        Some(pc2::start(&cache).ok()? + pc2::samples(&cache).ok()?.checked_sub(1)?)
    };
    of_files.or_else(of_cache)
}

/// Frames that a run is to have after frame 0.
fn frames_wanted(out: &Path) -> Option<u32> {
    let report = std::fs::read(RunDirectory::open(out).ok()?.report()).ok()?;
    let report: serde_json::Value = serde_json::from_slice(&report).ok()?;
    report.get("frames_wanted")?.as_u64().map(|frames| frames as u32)
}

/// Numbers of the frames of a run.
#[pyfunction]
pub(crate) fn frames(run: PathBuf) -> PyResult<Vec<u32>> {
    Ok(source(&run)?.numbers())
}

fn source(run: &Path) -> PyResult<FrameSource> {
    FrameSource::open(&RunDirectory::open(run).map_err(bad_input)?).map_err(bad_input)
}

type Rows<T> = Py<PyArray2<T>>;

/// Positions and triangles of a frame of a run; `obstacles`: of its obstacles, none if there are none.
#[pyfunction]
pub(crate) fn read_frame(
    py: Python<'_>,
    run: PathBuf,
    frame: u32,
    obstacles: bool,
) -> PyResult<Option<(Rows<f32>, Rows<u32>)>> {
    let source = source(&run)?;
    if !source.numbers().contains(&frame) {
        return Err(bad_input(format!("{}: there is no frame {frame}", run.display())));
    }
    let mesh = match obstacles {
        true => source.read_obstacle(frame),
        false => source.read(frame).map(Some),
    };
    let Some(mesh) = mesh.map_err(bad_input)? else { return Ok(None) };
    Ok(Some((rows_of_three(py, mesh.positions)?, rows_of_indices(py, mesh.triangles)?)))
}

/// Files of the states that a run has kept, with their steps and frames, ascending.
#[pyfunction]
pub(crate) fn kept_states(run: PathBuf) -> PyResult<Vec<(u64, PathBuf)>> {
    let directory = RunDirectory::open(&run).map_err(bad_input)?;
    let mut all = Vec::new();
    for folder in [directory.checkpoints(), directory.states()] {
        for file in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = file.file_name().to_string_lossy().into_owned();
            let step = name.strip_prefix("step_").and_then(|rest| rest.strip_suffix(".ltc"));
            if let Some(step) = step.and_then(|step| step.parse().ok()) {
                all.push((step, file.path()));
            }
        }
    }
    all.sort();
    all.dedup_by_key(|(step, _)| *step);
    Ok(all)
}

/// Step, time in seconds, positions, velocities and hash of a kept state.
#[pyfunction]
pub(crate) fn read_state(py: Python<'_>, file: PathBuf) -> PyResult<(u64, f64, Rows<f32>, Rows<f32>, String)> {
    let bytes = std::fs::read(&file).map_err(|error| bad_input(format!("{}: {error}", file.display())))?;
    let Checkpoint { step, time_s, state, .. } =
        Checkpoint::from_bytes(&bytes).map_err(|error| bad_input(format!("{}: {error}", file.display())))?;
    let hash = state.hash();
    Ok((step, time_s, rows_of_three(py, state.positions)?, rows_of_three(py, state.velocities)?, hash))
}
