//! One worker process: `loomtree-worker --run ID --rank R`.

use std::process::ExitCode;

use clap::Parser;
use loomtree::cli;

/// One rank of a run; the coordinator prints the run's identifier.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    #[command(flatten)]
    worker: cli::worker::WorkerArgs,
}

fn main() -> ExitCode {
    cli::start_log();
    cli::exit_code(cli::worker::run(Arguments::parse().worker))
}
