//! `loomtree join`: puts the segments of a shot together that were made one by one.

use std::path::PathBuf;

use serde_json::json;

use super::run_split;
use super::{CliError, answer};
use crate::coordinator::{GivenOptions, Launch, RunOptions, RunPlaces, Scope};
use crate::os::console::{is_json, note};
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
        let line = format!("{} is not split in time; there is nothing to join\n", args.run.display());
        return if is_json() {
            answer(&line, || json!({ "run": args.run, "status": "whole" }))
        } else {
            note(line.trim_end());
            Ok(())
        };
    }
    let places = RunPlaces { scene: manifest.scene_path.clone(), out: args.run, existing: Existing::Resume };
    run_split::run(Some(&manifest.text_to_read()), &options, &places, Scope::Join, &Launch::Spawn)?.answer()
}
