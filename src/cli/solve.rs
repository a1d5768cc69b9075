//! `loomtree solve`: runs the distributed PCG for any symmetric positive definite matrix and prints JSON to stdout.

use std::path::PathBuf;
use std::time::Duration;

use super::CliError;
use super::launcher::LauncherArgs;
use super::solve_report::{SolveFacts, report};
use super::solve_trace::{SOLVES_MOST, TraceFolder};
use crate::coordinator::options::positive_seconds;
use crate::coordinator::plan::check_workers;
use crate::coordinator::solve::{SolveOptions, SolvePlan, solve};
use crate::coordinator::{CrewError, Launch, SessionError, SessionOptions};
use crate::interconnect::ScheduleKind;
use crate::linear_system::{SolveParams, read_right_hand_side, read_system};
use crate::output::check_writable;
use crate::protocol::{BindCores, ExecutorChoice};
use crate::scene::PreconditionerKind;
use crate::solver::ExchangeMode;
use crate::step::Failure;

/// Arguments of `loomtree solve`.
#[derive(Clone, Debug, clap::Args)]
pub struct SolveArgs {
    /// Matrix: Matrix Market (coordinate real symmetric, or general with symmetric values), or 3x3 blocks as CLTHBSR1 (.bsr)
    pub matrix: PathBuf,
    /// Right-hand side: a Matrix Market array or one number per line; 'matrix' = the one stored in a .bsr file
    /// [default: A*1, so that the solution is 1 everywhere]
    #[arg(long, value_name = "FILE")]
    pub rhs: Option<PathBuf>,
    /// Who starts the workers.
    #[command(flatten)]
    pub launcher: LauncherArgs,
    /// Workers, each with its own device and block of rows
    #[arg(long, short = 'n', value_name = "N", default_value_t = 1)]
    pub workers: usize,
    /// Relative residual |b - A x| / |b| to reach, checked in double precision
    #[arg(long, value_name = "R", default_value_t = SolveParams::default().relative_tolerance, value_parser = tolerance)]
    pub rtol: f64,
    /// Most PCG iterations
    #[arg(long, value_name = "N", default_value_t = SolveParams::default().max_iterations)]
    pub max_iterations: u32,
    /// Write the solution as a Matrix Market array
    #[arg(long, value_name = "FILE")]
    pub solution: Option<PathBuf>,
    /// What a matrix-vector product exchanges: halo = only the rows that are read, full = whole sub-vectors (P-Cloth)
    #[arg(long, value_enum, default_value = "halo")]
    pub exchange: ExchangeMode,
    /// Order of the transfers
    #[arg(long, value_enum, default_value_t)]
    pub schedule: ScheduleKind,
    /// Preconditioner; auto = the fastest for the executor and size
    #[arg(long, value_enum, default_value = "auto")]
    pub preconditioner: PreconditionerKind,
    /// Topology file; workers sit on its first GPUs [default: a balanced binary tree]
    #[arg(long, value_name = "FILE")]
    pub topology: Option<PathBuf>,
    /// What runs the kernels; auto = a hardware GPU where there is one, else cpu
    #[arg(long, value_enum, default_value = "auto")]
    pub executor: ExecutorChoice,
    /// Adapter of the gpu executor (numbers: loomtree doctor) [default: rank modulo adapters]
    #[arg(long, value_name = "I")]
    pub adapter: Option<usize>,
    /// Threads of each worker on the cpu executor [default: cores / workers]
    #[arg(long, value_name = "T", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Whether workers of one thread that share cores evenly (more workers than cores) keep to one core each; never = the
    /// system decides
    #[arg(long, value_enum, default_value = "auto")]
    pub bind_cores: BindCores,
    /// Record what the workers compute, transfer and wait for (with --repeat: in the first 20 solves) and write trace.json (for
    /// ui.perfetto.dev) and report.json into this folder, which loomtree predict takes like a run directory
    #[arg(long, value_name = "DIR")]
    pub trace: Option<PathBuf>,
    /// Seconds without a sign of life after which a worker counts as hung
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = positive_seconds)]
    pub heartbeat: f64,
    /// Solve K times and time products on their own, for benchmarks; the median counts
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub repeat: u32,
}

fn tolerance(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value < 1.0 => Ok(value),
        _ => Err("expected a number between 0 and 1".to_string()),
    }
}

/// Runs the command.
///
/// # Errors
/// Bad input (exit code 2), or a solve that failed or did not converge (exit code 1).
pub fn run(mut args: SolveArgs, launch: &Launch) -> Result<(), CliError> {
    // Every process of a world is a worker.
    if let (Some(ranks), 1) = (launch.ranks(), args.workers) {
        args.workers = ranks;
    }
    if let Some(path) = &args.solution {
        check_solution(path)?;
    }
    let plan = prepare(&args, launch)?;
    let trace = args.trace.as_deref().map(TraceFolder::new).transpose()?;
    let facts = facts(&args, &plan, trace);
    let session = args.session();
    launch.machine().prepare(args.workers)?;
    let (results, executor) = solve(plan, &session, launch).map_err(|error| match error {
        SessionError::Crew(CrewError::Failed { failure: Failure::BadInput(text), .. }) => CliError::bad_input(text),
        SessionError::Crew(CrewError::Failed { failure: Failure::Other(text), .. }) => {
            CliError::failed(format!("{}: {text}", args.matrix.display()))
        }
        other if other.is_bad_input() => CliError::bad_input(other),
        other => CliError::failed(other),
    })?;
    if let Some(folder) = &facts.trace {
        folder.write(facts.header(), &executor, &results)?;
    }
    report(&facts, &executor, &results)
}

/// Reads and checks all input.
///
/// # Errors
/// Bad input.
pub fn prepare(args: &SolveArgs, launch: &Launch) -> Result<SolvePlan, CliError> {
    // Checked before a large file is read.
    check_workers(args.workers, usize::MAX, "").map_err(CliError::bad_input)?;
    let (system, stored_rhs) = read_system(&args.matrix).map_err(CliError::bad_input)?;
    let rhs = match &args.rhs {
        None => system.times_ones(),
        Some(path) if path.as_os_str() == "matrix" => stored_rhs.ok_or_else(|| {
            let matrix = args.matrix.display();
            CliError::bad_input(format!(
                "--rhs matrix: {matrix} holds no right-hand side; only .bsr files (CLTHBSR1) do"
            ))
        })?,
        Some(path) => read_right_hand_side(path, system.scalar_rows).map_err(CliError::bad_input)?,
    };
    let options = SolveOptions {
        workers: args.workers,
        topology: args.topology.clone(),
        exchange: args.exchange,
        schedule: args.schedule,
        params: SolveParams {
            relative_tolerance: args.rtol,
            max_iterations: args.max_iterations,
            repeat: args.repeat,
            time_products: args.repeat > 1,
            host_threads: args.session().threads_of(1, launch.machine().as_ref()),
            preconditioner: args.preconditioner,
            record_solves: if args.trace.is_some() { SOLVES_MOST } else { 0 },
        },
    };
    SolvePlan::new(system, rhs, &options).map_err(CliError::bad_input)
}

/// Collects what the report needs, because the system is moved into the solve.
fn facts(args: &SolveArgs, plan: &SolvePlan, trace: Option<TraceFolder>) -> SolveFacts {
    SolveFacts {
        rows: plan.file_rows,
        block_rows: plan.partition.rows(),
        workers: args.workers,
        exchange: args.exchange,
        schedule: plan.transfers.kind,
        rtol: args.rtol,
        solution: args.solution.clone(),
        order: plan.order.clone(),
        matrix: args.matrix.clone(),
        topology: plan.topology.clone(),
        trace,
    }
}

impl SolveArgs {
    /// Options of the session that the workers run in.
    fn session(&self) -> SessionOptions {
        SessionOptions {
            workers: self.workers,
            executor: self.executor,
            adapter: self.adapter,
            threads: self.threads.map(usize::from),
            bind_cores: self.bind_cores,
            silence: Duration::from_secs_f64(self.heartbeat),
        }
    }
}

/// Checks before a long solve that its result can be written.
fn check_solution(path: &std::path::Path) -> Result<(), CliError> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(std::path::Path::new("."));
    let refused = |what: String| CliError::bad_input(format!("--solution {}: {what}", path.display()));
    if path.is_dir() {
        return Err(refused("is a folder; name a file".to_string()));
    }
    if !folder.is_dir() {
        return Err(refused(format!("there is no folder {}", folder.display())));
    }
    check_writable(path).map_err(|error| refused(format!("cannot be written: {error}")))
}
