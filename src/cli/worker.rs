//! `loomtree-worker` and the hidden `loomtree worker`: one rank of a run.

use super::CliError;
use crate::transport::RunName;

/// Arguments of a worker.
#[derive(Clone, Debug, clap::Args)]
pub struct WorkerArgs {
    /// Identifier of the run, as the coordinator prints it
    #[arg(long, value_name = "ID")]
    pub run: String,
    /// Rank of this worker
    #[arg(long)]
    pub rank: usize,
}

/// Runs the worker until its coordinator stops it.
pub fn run(args: WorkerArgs) -> Result<(), CliError> {
    let run: RunName = args.run.parse().map_err(CliError::bad_input)?;
    match crate::worker::run(&run, args.rank) {
        Ok(()) => Ok(()),
        // The coordinator has already told the user.
        Err(crate::worker::WorkerError::Reported(_)) => Err(CliError::failed("")),
        Err(error) => Err(CliError::failed(format!("worker {}: {error}", args.rank))),
    }
}
