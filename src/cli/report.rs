//! `loomtree report`: a run as one HTML file.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::render::open_executor;
use super::render_subjects::{recorded_origin, recorded_up};
use super::{CliError, answer};
use crate::coordinator::RunOptions;
use crate::output::picture::{PictureOptions, draw_images};
use crate::output::{
    Account, FrameSource, Report, RunDirectory, RunManifest, account, check_writable, read_trace, write_atomically,
};
use crate::protocol::ExecutorChoice;
use crate::transport::cores;

/// Write a run as one HTML file with pictures, curves, tables and a timeline, to send to somebody.
#[derive(Args, Clone, Debug)]
pub struct ReportArgs {
    /// Run directory
    pub run_dir: PathBuf,
    /// The file [default: report.html in the run directory]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Pictures, evenly spaced over the run
    #[arg(long, value_name = "N", default_value_t = 6, value_parser = clap::value_parser!(u32).range(0..=100))]
    pub pictures: u32,
    /// What draws: auto = a hardware GPU where there is one, else the processor
    #[arg(long, value_enum, default_value_t)]
    pub executor: ExecutorChoice,
}

/// Runs the command.
///
/// # Errors
/// There is no report, or the file cannot be written.
pub fn run(args: ReportArgs) -> Result<(), CliError> {
    let directory = RunDirectory::open(&args.run_dir).map_err(CliError::bad_input)?;
    let report = Report::load(&directory.report()).map_err(CliError::bad_input)?;
    let out = args.out.unwrap_or_else(|| directory.path().join("report.html"));
    let unwritable = |error: &dyn std::fmt::Display| format!("{} cannot be written: {error}", out.display());
    check_writable(&out).map_err(|error| CliError::bad_input(unwritable(&error)))?;
    let pictures = match FrameSource::open(&directory) {
        Ok(source) if args.pictures > 0 => {
            let source = source.about(recorded_origin(&directory));
            let numbers = evenly(&source.numbers(), args.pictures as usize);
            let threads = cores();
            let options = PictureOptions {
                width: 720,
                height: 540,
                up: recorded_up(&directory),
                threads,
                ..PictureOptions::default()
            };
            let executor = open_executor(args.executor, None, threads)?;
            let images = draw_images(&source, &numbers, &options, &executor).map_err(super::render::cli_error)?;
            let png = |(frame, image): (u32, crate::output::picture::Image)| Ok((frame, image.png()?));
            images.into_iter().map(png).collect::<std::io::Result<Vec<_>>>().map_err(CliError::failed)?
        }
        _ => Vec::new(),
    };
    // A run may have been made without a trace; the middle one of the traced steps is past the start.
    let traced = directory.trace().is_file().then(|| read_trace(&directory.trace()).ok()).flatten().unwrap_or_default();
    let traced = traced.iter().nth(traced.len() / 2).map(|(step, ranks)| (*step, &ranks[..]));
    let options = RunManifest::load(&directory).ok().and_then(|manifest| manifest.flags::<RunOptions>().ok());
    let memory_limit_bytes = options.and_then(|options| options.memory_limit_bytes);
    let made = Account { report: &report, pictures: &pictures, traced, memory_limit_bytes };
    let html = account(&made).map_err(CliError::failed)?;
    write_atomically(&out, |file| file.write_all(html.as_bytes())).map_err(CliError::failed)?;
    let line = format!("{} ({:.1} MB)\n", out.display(), html.len() as f64 / 1e6);
    answer(&line, || json!({ "file": out, "bytes": html.len(), "pictures": pictures.len() }))
}

/// `count` of the frames, the last one always among them, and the first where there are two.
fn evenly(numbers: &[u32], count: usize) -> Vec<u32> {
    let count = count.min(numbers.len());
    let place = |i: usize| if count == 1 { numbers.len() - 1 } else { i * (numbers.len() - 1) / (count - 1) };
    (0..count).map(|i| numbers[place(i)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_spread_over_the_run() {
        assert_eq!(evenly(&[0, 1, 2, 3, 4, 5, 6], 3), [0, 3, 6]);
        assert_eq!(evenly(&[0, 1], 6), [0, 1]);
        assert_eq!(evenly(&[0, 1, 2], 1), [2]);
        assert_eq!(evenly(&[], 3), [0; 0]);
    }
}
