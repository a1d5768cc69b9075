//! The front door: parses the command line, calls the library, maps errors to exit codes.

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use loomtree::cli::{self, CliError, Verbosity, launcher};
use loomtree::coordinator::Launch;

/// Distributed simulator for very large cloth: one worker process per (simulated) GPU.
#[derive(Parser)]
#[command(version, arg_required_else_help = true, max_term_width = 100)]
struct Arguments {
    /// Say nothing but results and errors
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
    /// Say more: a line per step and what else the log knows (as LOOMTREE_LOG=loomtree=debug)
    #[arg(short, long, global = true)]
    verbose: bool,
    /// Print the result as JSON on stdout, and what people read on stderr
    #[arg(long, global = true)]
    json: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Simulate a scene on N workers
    Run(cli::run::RunArgs),
    /// Show the work queues for a topology
    Schedule(cli::schedule::ScheduleArgs),
    /// Re-time a recorded run on another machine (modelled, not measured)
    Predict(cli::predict::PredictArgs),
    /// Write a topology file for this machine
    Topology(cli::topology::TopologyArgs),
    /// Check a scene or a mesh
    Check(cli::check::CheckArgs),
    /// Solve a symmetric positive definite system on N workers
    Solve(cli::solve::SolveArgs),
    /// Put the segments of a shot together that were made one by one (run --only-segment)
    Join(cli::join::JoinArgs),
    /// Compare two runs of one mesh frame by frame
    Compare(cli::compare::CompareArgs),
    /// Write the frames of a run for other programs (USD, glTF, MDD, PC2, VTK, PLY)
    Convert(cli::convert::ConvertArgs),
    /// Show a run in the browser, while it goes on or afterwards
    View(cli::view::ViewArgs),
    /// Steer a run that goes on (run --live)
    Live(cli::live::LiveArgs),
    /// Write a run as one HTML file with pictures, curves, tables and a timeline
    Report(cli::report::ReportArgs),
    /// Draw the frames of a run as PNG
    Render(cli::render::RenderArgs),
    /// Show adapters, cores, shared memory and what dead runs have left
    Doctor(cli::doctor::DoctorArgs),
    /// Measure this program on this machine
    Bench(cli::bench::BenchArgs),
    /// Test collision queries with rational coordinates against their truth
    Ccd(cli::ccd::CcdArgs),
    /// Write a commented scene to start from
    Init(cli::init::InitArgs),
    /// Write a commented scene from meshes of cloth
    NewScene(cli::new_scene::NewSceneArgs),
    /// Print a JSON Schema of scene files, for editors
    Schema(cli::init::SchemaArgs),
    /// Print a script that completes the command line for a shell
    Completions(cli::completions::CompletionsArgs),
    /// Write manual pages of every command
    Man(cli::man::ManArgs),
    /// The coordinator alone: prints the run's identifier and waits for its workers
    #[command(hide = true)]
    Coordinator(cli::run::RunArgs),
    /// A worker process; started by `loomtree run`
    #[command(hide = true)]
    Worker(cli::worker::WorkerArgs),
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    if arguments.json {
        cli::answer_in_json();
    }
    cli::start_log(match (arguments.quiet, arguments.verbose) {
        (true, _) => Verbosity::Quiet,
        (_, true) => Verbosity::Verbose,
        _ => Verbosity::Usual,
    });
    let result = match arguments.command {
        Command::Completions(_) | Command::Man(_) | Command::Coordinator(_) | Command::Worker(_) if arguments.json => {
            Err(CliError::bad_input("this command prints no result that could be JSON: leave out --json"))
        }
        Command::Run(args) => launcher::under(&args.launcher.clone(), |launch| cli::run::run(args, launch)),
        Command::Schedule(args) => cli::schedule::run(args),
        Command::Predict(args) => cli::predict::run(args),
        Command::Topology(args) => cli::topology::run(args),
        Command::Check(args) => cli::check::check(&args, &mut std::io::stdout()),
        Command::Solve(args) => launcher::under(&args.launcher.clone(), |launch| cli::solve::run(args, &launch)),
        Command::Join(args) => cli::join::run(args),
        Command::Compare(args) => cli::compare::run(args),
        Command::Convert(args) => cli::convert::run(args),
        Command::View(args) => cli::view::run(args),
        Command::Live(args) => cli::live::run(args),
        Command::Report(args) => cli::report::run(args),
        Command::Render(args) => cli::render::run(args),
        Command::Doctor(args) => cli::doctor::run(args, &adapter_lines(), triangles_of),
        Command::Bench(args) => launcher::under(&args.launcher.clone(), |launch| cli::bench::run(args, &launch)),
        Command::Ccd(args) => cli::ccd::run(args),
        Command::Init(args) => cli::init::init(args),
        Command::NewScene(args) => cli::new_scene::run(&args),
        Command::Schema(args) => cli::init::schema(args),
        Command::Completions(args) => cli::completions::run(args, Arguments::command()),
        Command::Man(args) => cli::man::run(&args, Arguments::command()),
        Command::Coordinator(args) => cli::run::run(args, Launch::Await),
        Command::Worker(args) => cli::worker::run(args),
    };
    cli::exit_code(result)
}

/// Adapters by the number that --adapter takes.
fn adapter_lines() -> Vec<String> {
    let lines = loomtree::gpu::adapters().into_iter().enumerate().map(|(number, adapter)| {
        let mib = |bytes: u64| bytes >> 20;
        let (binding, buffer) = (mib(adapter.max_binding_bytes), mib(adapter.max_buffer_bytes));
        format!("{number}: {}, at most {binding} MiB per binding, {buffer} MiB per buffer", adapter.describe())
    });
    lines.collect()
}

fn triangles_of(path: &std::path::Path) -> Result<usize, CliError> {
    let scene = loomtree::scene::load(path, &Default::default()).map_err(CliError::bad_input)?;
    Ok(scene.mesh.triangles.len())
}
