//! The coordinator alone: prints the run's identifier, waits for `loomtree-worker` processes, runs the scene.

use std::process::ExitCode;

use clap::Parser;
use loomtree::cli;
use loomtree::coordinator::Launch;

/// Coordinator of a run whose workers somebody else starts (see scripts/launch.sh).
#[derive(Parser)]
#[command(version)]
struct Arguments {
    #[command(flatten)]
    run: cli::run::RunArgs,
}

fn main() -> ExitCode {
    cli::start_log();
    cli::exit_code(cli::run::run(Arguments::parse().run, Launch::Await))
}
