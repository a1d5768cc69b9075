//! `loomtree render`: shaded pictures of one run or of several side by side, contact sheets and movies.

use std::io::{self, IsTerminal, Write};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::{AtomicUsize, Ordering};

use clap::Args;
use serde_json::json;

use super::render_subjects::Runs;
use super::{CliError, answer};
use crate::gpu::{Executor, GpuError};
use crate::os::console::note;
use crate::output::picture::{
    CameraFile, Coloring, Destination, Ground, LENS_MM, MovieOptions, PictureError, PictureOptions, UpAxis, draw_frames,
};
use crate::output::{FramesError, write_atomically};
use crate::protocol::ExecutorChoice;
use crate::transport::cores;

/// Draw shaded PNG pictures of a run's frames, a contact sheet, and a movie.
#[derive(Args, Clone, Debug)]
pub struct RenderArgs {
    /// Run directory (what `loomtree run` was given as --out); several are drawn side by side with one camera
    #[arg(required = true, value_name = "RUN")]
    pub run_dirs: Vec<PathBuf>,
    /// Draw every K-th frame
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub every: u32,
    /// Size of a picture in pixels (of each run's part of it)
    #[arg(long, value_name = "WxH", default_value = "960x720")]
    pub size: PictureSize,
    /// Draw frames A to B (both included); either end may be left out
    #[arg(long, value_name = "A..B", default_value = "..")]
    pub frames: FrameRange,
    /// Folder for the pictures, or a .png file for a single frame [default: pictures/ of the (first) run]
    #[arg(long, value_name = "DIR|FILE")]
    pub out: Option<PathBuf>,
    /// Also write a movie: mp4 through ffmpeg where that is installed, otherwise an animated PNG
    #[arg(long, value_name = "FILE")]
    pub movie: Option<PathBuf>,
    /// Pictures per second of the movie [default: as fast as the scene's time]
    #[arg(long, value_name = "F", value_parser = movie_rate, requires = "movie")]
    pub fps: Option<f64>,
    /// What colors mean: shaded (fabric, or pieces where there are several), fabric, piece, rank, strain, contact,
    /// height, segment or normal
    #[arg(long, value_name = "COLORING", default_value = "shaded")]
    pub color: Coloring,
    /// Leave out a piece of cloth or an obstacle, by its name in the scene
    #[arg(long, value_name = "NAME")]
    pub hide: Vec<String>,
    /// What fills the picture: auto (the cloth, and who wears it), cloth, all (cloth and the obstacles near it), a
    /// piece or obstacle by name, or a point
    #[arg(long, value_name = "NAME|X,Y,Z", default_value = "auto", allow_hyphen_values = true)]
    pub target: String,
    /// Draw everything F times as large
    #[arg(long, value_name = "F", default_value_t = 1.0, value_parser = zoom)]
    pub zoom: f32,
    /// Focal length of the lens for a sensor 24 mm high: 24 is wide, 85 long [default: 45]
    #[arg(long, value_name = "MM", value_parser = lens)]
    pub lens: Option<f32>,
    /// Axis that points up: y or z [default: against the run's gravity]
    #[arg(long, value_name = "AXIS")]
    pub up: Option<UpAxis>,
    /// Direction of the camera around the up axis, degrees [default: where most of the cloth is seen]
    #[arg(long, value_name = "DEGREES", allow_negative_numbers = true)]
    pub azimuth: Option<f32>,
    /// Height of the camera above the horizon, degrees [default: 15, or 35 for cloth that lies]
    #[arg(long, value_name = "DEGREES", allow_negative_numbers = true)]
    pub elevation: Option<f32>,
    /// Camera from a file (as --save-camera writes it), which may move from key to key
    #[arg(long, value_name = "FILE", conflicts_with_all = ["azimuth", "elevation", "target", "lens"])]
    pub camera: Option<PathBuf>,
    /// Write the camera of the first picture to a file, to be edited
    #[arg(long, value_name = "FILE")]
    pub save_camera: Option<PathBuf>,
    /// Ground: auto (below everything; a flat floor under all of the cloth becomes the ground), off, or its height in
    /// meters
    #[arg(long, value_name = "auto|off|H", default_value = "auto", allow_negative_numbers = true)]
    pub ground: Ground,
    /// Leave shadows out, which takes half of the time
    #[arg(long)]
    pub no_shadows: bool,
    /// Divide triangles of the cloth into four, N times, by Loop's rounding scheme; the picture then shows another
    /// surface than the run has computed
    #[arg(long, value_name = "N", num_args = 0..=1, default_value_t = 0, default_missing_value = "1",
        value_parser = clap::value_parser!(u32).range(0..=4))]
    pub smooth: u32,
    /// Pictures that are drawn at a time; each needs about 60 MB (at 960x720) and twice the frame [default: one a core,
    /// of large pictures fewer]
    #[arg(long, value_name = "T", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// What draws: auto = a hardware GPU where there is one, else the processor
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

/// Memory that pictures under way may need together, without their frames, bytes.
const MEMORY: u64 = 2 << 30;
/// Bytes of the maps of a picture's lights, and of a sample.
const LIGHT_BYTES: u64 = 38 << 20;
const SAMPLE_BYTES: u64 = 8;

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

fn in_range(text: &str, range: RangeInclusive<f64>, what: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if range.contains(&value) => Ok(value),
        _ => Err(format!("expected {what} from {} to {}", range.start(), range.end())),
    }
}

fn zoom(text: &str) -> Result<f32, String> {
    in_range(text, 0.01..=1000.0, "a factor").map(|zoom| zoom as f32)
}

fn lens(text: &str) -> Result<f32, String> {
    in_range(text, 5.0..=2000.0, "millimeters").map(|lens| lens as f32)
}

fn movie_rate(text: &str) -> Result<f64, String> {
    in_range(text, 0.1..=240.0, "pictures per second")
}

/// Runs the command.
///
/// # Errors
/// No run, no such frame, name or camera, or a picture that cannot be drawn or written.
pub fn run(args: RenderArgs) -> Result<(), CliError> {
    let runs = Runs::open(&args.run_dirs)?;
    let all = runs.numbers();
    let wanted = all.iter().copied().filter(|n| (args.frames.first..=args.frames.last).contains(n));
    let numbers: Vec<u32> = wanted.step_by(args.every as usize).collect();
    if numbers.is_empty() {
        let Some((first, last)) = all.first().zip(all.last()) else {
            return Err(CliError::bad_input("the runs have no frame in common, so nothing can be drawn side by side"));
        };
        let place = args.run_dirs.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(" and ");
        let holds = if args.run_dirs.len() == 1 { "it holds" } else { "they have in common" };
        return Err(CliError::bad_input(format!("--frames names no frame of {place}; {holds} {first}..{last}")));
    }
    let to = destination(&args, &runs, &numbers)?;
    let threads = args.threads.map_or_else(|| threads_for(args.size), |threads| threads as usize);
    let camera = args.camera.as_deref().map(CameraFile::read).transpose().map_err(CliError::bad_input)?;
    let names = runs.parts(&args.hide, &args.target, args.color)?;
    let executor = open_executor(args.executor, args.adapter, threads)?;
    let options = PictureOptions {
        width: args.size.width,
        height: args.size.height,
        coloring: args.color,
        up: args.up.unwrap_or_else(|| runs.up()),
        azimuth_deg: args.azimuth.filter(|a| a.is_finite()),
        elevation_deg: args.elevation.filter(|e| e.is_finite()),
        target: names.target.clone(),
        zoom: args.zoom,
        lens_mm: args.lens.unwrap_or(LENS_MM),
        camera,
        origin_m: runs.origin_m(),
        ground: args.ground,
        shadows: !args.no_shadows,
        smooth: args.smooth,
        threads,
    };
    let terminal = io::stderr().is_terminal() && !crate::os::console::is_quiet();
    let done = AtomicUsize::new(0);
    let drawn = |_frame: u32| {
        let done = done.fetch_add(1, Ordering::Relaxed) + 1;
        if terminal {
            // A failure to print progress does not stop the command.
            let _ = write!(io::stderr(), "\r{done} of {} pictures", numbers.len());
        }
    };
    let subjects = runs.subjects(&names);
    let made = draw_frames(&subjects, &numbers, &options, &executor, &to, &drawn);
    if terminal {
        let _ = writeln!(io::stderr());
    }
    let made = made.map_err(cli_error)?;
    if let Some(file) = &args.save_camera {
        write_atomically(file, |out| out.write_all(made.camera.text().as_bytes())).map_err(CliError::failed)?;
    }
    let coarse = numbers.iter().filter(|&&frame| runs.is_coarse(frame)).count();
    if coarse > 0 {
        note(format_args!(
            "{coarse} of the frames are those of the coarse run so far; their pictures have an orange edge"
        ));
    }
    if let (Some(wanted), Some(movie)) = (&args.movie, &made.movie)
        && wanted != movie
    {
        note(format_args!("there is no ffmpeg in PATH, so {} is an animated PNG", movie.display()));
    }
    let (count, device) = (numbers.len(), executor.device_name());
    let mut line = match (&made.sheet, &to.file) {
        (Some(sheet), _) => format!("{count} pictures in {}, overview in {}", to.folder.display(), sheet.display()),
        (None, Some(file)) => format!("{}", file.display()),
        (None, None) => format!("{count} pictures"),
    };
    if let Some(movie) = &made.movie {
        line += &format!(", movie in {}", movie.display());
    }
    answer(&format!("{line} (drawn by {device})\n"), || {
        let (pictures, sheet, movie) = (&made.pictures, &made.sheet, &made.movie);
        json!({ "pictures": pictures, "contact_sheet": sheet, "movie": movie, "frames": numbers, "device": device })
    })
}

/// As many threads as there are cores, unless the pictures under way would need more than [`MEMORY`].
fn threads_for(size: PictureSize) -> usize {
    let samples = 4 * u64::from(size.width) * u64::from(size.height);
    let picture = LIGHT_BYTES + samples * SAMPLE_BYTES;
    cores().min((MEMORY / picture).max(1) as usize)
}

/// Where the pictures go.
fn destination(args: &RenderArgs, runs: &Runs, numbers: &[u32]) -> Result<Destination, CliError> {
    let several = args.run_dirs.len() > 1;
    let movie = args.movie.clone().map(|path| MovieOptions {
        path,
        fps: args.fps.unwrap_or_else(|| (runs.frames_per_second() / f64::from(args.every)).clamp(0.1, 240.0)),
    });
    let mut to = Destination {
        folder: runs.pictures(),
        prefix: if several { "side_by_side_" } else { "frame_" }.into(),
        sheet: if several { "side_by_side.png" } else { "contact_sheet.png" }.into(),
        file: None,
        movie,
    };
    match &args.out {
        Some(out) if is_png(out) && numbers.len() == 1 => to.file = Some(out.clone()),
        Some(out) if is_png(out) => {
            let (count, name) = (numbers.len(), out.display());
            return Err(CliError::bad_input(format!(
                "--out {name} is one picture, but {count} frames are chosen: choose one with --frames, or name a folder"
            )));
        }
        Some(out) if out.is_file() => {
            return Err(CliError::bad_input(format!("--out {} is neither a folder nor a .png file", out.display())));
        }
        Some(out) => to.folder = out.clone(),
        None => {}
    }
    Ok(to)
}

fn is_png(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) && !path.is_dir()
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

pub(super) fn cli_error(error: PictureError) -> CliError {
    match &error {
        PictureError::Frames(FramesError::Io { .. })
        | PictureError::Write(_)
        | PictureError::Folder { .. }
        | PictureError::Gpu(_) => CliError::failed(error.to_string()),
        PictureError::Frames(_)
        | PictureError::NothingToSee { .. }
        | PictureError::Name(_)
        | PictureError::Values { .. } => CliError::bad_input(error.to_string()),
    }
}
