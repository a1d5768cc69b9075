//! `loomtree render`: shaded pictures of a run's frames and a contact sheet.

use std::io::{self, IsTerminal, Write};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::atomic::{AtomicUsize, Ordering};

use clap::Args;

use super::{CliError, print};
use crate::gpu::{Executor, GpuError};
use crate::math::DVec3;
use crate::os::console::note;
use crate::output::picture::{Coloring, PictureError, PictureOptions, UpAxis, draw_frames};
use crate::output::{FrameSource, FramesError, Report, RunDirectory};
use crate::protocol::ExecutorChoice;
use crate::transport::cores;

/// Draw shaded PNG pictures of a run's frames, and a contact sheet.
#[derive(Args, Clone, Debug)]
pub struct RenderArgs {
    /// Run directory (what `loomtree run` was given as --out).
    pub run_dir: PathBuf,
    /// Draw every K-th frame.
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub every: u32,
    /// Size of a picture in pixels.
    #[arg(long, value_name = "WxH", default_value = "960x720")]
    pub size: PictureSize,
    /// Draw frames A to B (both included); either end may be left out.
    #[arg(long, value_name = "A..B", default_value = "..")]
    pub frames: FrameRange,
    /// What colors mean: shaded, height or normal.
    #[arg(long, value_name = "COLORING", default_value = "shaded")]
    pub color: Coloring,
    /// Axis that points up: y or z (default: against the run's gravity).
    #[arg(long, value_name = "AXIS")]
    pub up: Option<UpAxis>,
    /// Direction of the camera around the up axis, degrees (default: where most of the cloth is seen).
    #[arg(long, value_name = "DEGREES", allow_negative_numbers = true)]
    pub azimuth: Option<f32>,
    /// Height of the camera above the horizon, degrees (default: 15, or 35 for cloth that lies).
    #[arg(long, value_name = "DEGREES", allow_negative_numbers = true)]
    pub elevation: Option<f32>,
    /// What draws: auto = a hardware GPU where there is one, else the processor.
    #[arg(long, value_enum, default_value = "auto")]
    pub executor: ExecutorChoice,
    /// Adapter of the gpu executor (numbers: loomtree doctor) [default: the best one]
    #[arg(long, value_name = "I")]
    pub adapter: Option<usize>,
}

/// Width and height in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureSize {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Valid sides of a picture in pixels. Smaller pictures show nothing, larger ones need gigabytes.
const SIDES: RangeInclusive<u32> = 16..=8192;

impl FromStr for PictureSize {
    type Err = String;
    fn from_str(text: &str) -> Result<PictureSize, String> {
        let sides = text.split_once('x').and_then(|(w, h)| Some((w.trim().parse().ok()?, h.trim().parse().ok()?)));
        match sides {
            Some((width, height)) if SIDES.contains(&width) && SIDES.contains(&height) => {
                Ok(PictureSize { width, height })
            }
            _ => Err(format!("{text:?} is no size; write WIDTHxHEIGHT with 16 to 8192 pixels each, such as 960x720")),
        }
    }
}

/// Frames from `first` to `last`, both included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameRange {
    /// First frame.
    pub first: u32,
    /// Last frame.
    pub last: u32,
}

impl FromStr for FrameRange {
    type Err = String;
    fn from_str(text: &str) -> Result<FrameRange, String> {
        let (first, last) = text.split_once("..").unwrap_or((text, text));
        let end = |text: &str, open: u32| if text.is_empty() { Some(open) } else { text.parse().ok() };
        match (end(first, 0), end(last, u32::MAX)) {
            (Some(first), Some(last)) if first <= last && !text.is_empty() => Ok(FrameRange { first, last }),
            _ => Err(format!("{text:?} is no range of frames; write A..B with A not above B, such as 0..120")),
        }
    }
}

/// Runs the command.
pub fn run(args: RenderArgs) -> Result<(), CliError> {
    let directory = RunDirectory::open(&args.run_dir).map_err(|e| CliError::bad_input(e.to_string()))?;
    let source = FrameSource::open_with_coarse(&directory).map_err(|e| CliError::bad_input(e.to_string()))?;
    let source = source.about(recorded_origin(&directory));
    let all = source.numbers();
    let wanted = all.iter().copied().filter(|n| (args.frames.first..=args.frames.last).contains(n));
    let numbers: Vec<u32> = wanted.step_by(args.every as usize).collect();
    if numbers.is_empty() {
        let (first, last) = (all.first().copied().unwrap_or(0), all.last().copied().unwrap_or(0));
        let place = directory.path().display();
        return Err(CliError::bad_input(format!("--frames names no frame of {place}; it holds {first}..{last}")));
    }
    let threads = cores();
    let executor = open_executor(args.executor, args.adapter, threads)?;
    let options = PictureOptions {
        width: args.size.width,
        height: args.size.height,
        coloring: args.color,
        up: args.up.unwrap_or_else(|| recorded_up(&directory)),
        azimuth_deg: args.azimuth.filter(|a| a.is_finite()),
        elevation_deg: args.elevation.filter(|e| e.is_finite()),
        threads,
    };
    let terminal = io::stderr().is_terminal();
    let done = AtomicUsize::new(0);
    let drawn = |_frame: u32| {
        let done = done.fetch_add(1, Ordering::Relaxed) + 1;
        if terminal {
            // A failure to print progress does not stop the command.
            let _ = write!(io::stderr(), "\r{done} of {} pictures", numbers.len());
        }
    };
    let sheet = draw_frames(&directory, &source, &numbers, &options, &executor, &drawn);
    if terminal {
        let _ = writeln!(io::stderr());
    }
    let sheet = sheet.map_err(cli_error)?;
    let coarse = numbers.iter().filter(|&&frame| source.is_coarse(frame)).count();
    if coarse > 0 {
        note(format_args!(
            "{coarse} of the frames are those of the coarse run so far; their pictures have an orange edge"
        ));
    }
    let (count, pictures, device) = (numbers.len(), directory.pictures(), executor.device_name());
    print(&format!("{count} pictures in {}, overview in {} (drawn by {device})\n", pictures.display(), sheet.display()))
}

/// Opens the executor that draws. Software adapters are used only on request, because the native path is faster.
pub(super) fn open_executor(
    wanted: ExecutorChoice,
    adapter: Option<usize>,
    threads: usize,
) -> Result<Executor, CliError> {
    let executor = match wanted {
        ExecutorChoice::Cpu if adapter.is_some() => {
            return Err(CliError::bad_input("--adapter names a device, so it cannot go with --executor cpu"));
        }
        ExecutorChoice::Cpu => Ok(Executor::cpu(threads)),
        ExecutorChoice::Gpu => Executor::gpu(adapter, 0),
        ExecutorChoice::Auto => Executor::auto(adapter, 0, threads),
    };
    match executor {
        Ok(executor) => Ok(executor),
        Err(error @ (GpuError::NoAdapter | GpuError::NoSuchAdapter { .. })) => Err(CliError::bad_input(error)),
        Err(error) if wanted == ExecutorChoice::Auto && adapter.is_none() => {
            tracing::warn!("{error}; drawing on the processor instead");
            Ok(Executor::cpu(threads))
        }
        Err(error) => Err(CliError::failed(PictureError::Gpu(error))),
    }
}

/// The local origin from the report; zero if there is no report.
pub(super) fn recorded_origin(directory: &RunDirectory) -> DVec3 {
    Report::load(&directory.report()).map_or(DVec3::ZERO, |report| DVec3::from_array(report.header.local_origin_m))
}

/// The up axis from the report; z if there is no report.
pub(super) fn recorded_up(directory: &RunDirectory) -> UpAxis {
    let report = Report::load(&directory.report()).ok();
    report.and_then(|r| r.header.up_axis.parse().ok()).unwrap_or_default()
}

pub(super) fn cli_error(error: PictureError) -> CliError {
    match &error {
        PictureError::Frames(FramesError::Io { .. })
        | PictureError::Write(_)
        | PictureError::Folder { .. }
        | PictureError::Gpu(_) => CliError::failed(error.to_string()),
        PictureError::Frames(_) | PictureError::NothingToSee { .. } => CliError::bad_input(error.to_string()),
    }
}
