//! `loomtree join`: puts the segments of a shot together that were made one by one.

use std::path::PathBuf;

use super::CliError;
use super::run_split;
use crate::coordinator::{GivenOptions, Launch, RunOptions, RunPlaces, Scope};
use crate::os::console::note;
use crate::output::{Existing, RunDirectory, RunManifest};

/// Arguments of `loomtree join`.
#[derive(Clone, Debug, clap::Args)]
pub struct JoinArgs {
    /// Run directory of a shot that is split in time
    pub run: PathBuf,
    /// Worker processes of the hand-overs [default: as recorded]
    #[arg(long, short = 'n', value_name = "N")]
    pub workers: Option<usize>,
}

/// Runs the command.
///
/// # Errors
/// A segment is missing, or a hand-over fails.
pub fn run(args: JoinArgs) -> Result<(), CliError> {
    let directory = RunDirectory::open(&args.run).map_err(CliError::bad_input)?;
    let manifest = RunManifest::load(&directory).map_err(CliError::bad_input)?;
    let recorded: RunOptions = manifest.flags().map_err(CliError::bad_input)?;
    let mut options = GivenOptions::none().over(&recorded).map_err(CliError::bad_input)?;
    options.workers = args.workers.unwrap_or(options.workers);
    if options.time.segments < 2 {
        note(format_args!("{} is not split in time; there is nothing to join", args.run.display()));
        return Ok(());
    }
    let places = RunPlaces { scene: manifest.scene_path.clone(), out: args.run, existing: Existing::Resume };
    run_split::run(Some(&manifest.text_to_read()), &options, &places, Scope::Join, &Launch::Spawn)
}
