//! `loomtree bench drape`: drape coefficients of the round cloths of a run, as the Cusick test measures them.

use std::path::PathBuf;

use super::table::FigureTable;
use crate::cli::CliError;
use crate::cli::render_subjects::recorded_up;
use crate::output::picture::UpAxis;
use crate::output::{FrameSource, RunDirectory, drape};

/// Arguments of `loomtree bench drape`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct DrapeBench {
    /// Run directory (what `loomtree run scenes/cusick.toml` was given as --out)
    run_dir: PathBuf,
    /// Radius of the stand, meters
    #[arg(long, default_value_t = 0.09)]
    stand_m: f64,
    /// Folder for the table as JSON
    #[arg(long)]
    out: Option<PathBuf>,
}

pub(super) fn run(bench: &DrapeBench) -> Result<(), CliError> {
    let bad = |error: &dyn std::fmt::Display| CliError::bad_input(error.to_string());
    let directory = RunDirectory::open(&bench.run_dir).map_err(|error| bad(&error))?;
    let source = FrameSource::open(&directory).map_err(|error| bad(&error))?;
    let numbers = source.numbers();
    let (Some(0), Some(&last)) = (numbers.first(), numbers.last()) else {
        return Err(CliError::bad_input(format!("{} has no frame 0, the flat start", bench.run_dir.display())));
    };
    let flat = source.read(0).map_err(|error| bad(&error))?;
    let draped = source.read(last).map_err(|error| bad(&error))?;
    let title = format!("drape in frame {last} of {}, pieces in the order of the scene", bench.run_dir.display());
    let mut table =
        FigureTable::new("drape", title, vec!["piece", "drape_coefficient", "folds", "rim_least_m", "rim_most_m"]);
    let up = match recorded_up(&directory) {
        UpAxis::Y => 1,
        UpAxis::Z => 2,
    };
    for (piece, drape) in drape(&flat, &draped, bench.stand_m, up).iter().enumerate() {
        table.push(vec![(piece + 1) as f64, drape.coefficient, drape.folds as f64, drape.rim_m[0], drape.rim_m[1]]);
    }
    table.finish(bench.out.as_deref(), None)
}
