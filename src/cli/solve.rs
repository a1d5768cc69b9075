//! `loomtree solve`: the distributed PCG on its own, for any symmetric positive definite matrix. JSON goes to stdout.

use std::path::PathBuf;
use std::time::Duration;

use super::CliError;
use super::run::{BindCoresArg, ExchangeArg, ExecutorArg, PreconditionerArg};
use super::solve_report::{SolveFacts, report};
use super::solve_trace::{SOLVES_MOST, TraceFolder};
use crate::coordinator::plan::plan_transfers;
use crate::coordinator::{Crew, CrewError, Launch};
use crate::interconnect::{Plan, ScheduleKind};
use crate::linear_system::{
    BlockSystem, SolveParams, SolveResult, locality_order, read_right_hand_side, read_system, share_between_chunks,
};
use crate::math::DIM;
use crate::partition::RowPartition;
use crate::protocol::{ToCoordinator, ToWorker, WorkerSetup};
use crate::step::{ExchangePlan, Failure};
use crate::telemetry::Event;
use crate::transport::{MachineError, RANKS_MAX};

/// Arguments of `loomtree solve`.
#[derive(Clone, Debug, clap::Args)]
pub struct SolveArgs {
    /// Matrix: Matrix Market (coordinate real symmetric, or general with symmetric values), or 3x3 blocks as CLTHBSR1 (.bsr)
    pub matrix: PathBuf,
    /// Right-hand side: a Matrix Market array or one number per line; 'matrix' = the one stored in a .bsr file
    /// [default: A*1, so that the solution is 1 everywhere]
    #[arg(long, value_name = "FILE")]
    pub rhs: Option<PathBuf>,
    /// Workers, each with its own device and block of rows
    #[arg(long, short = 'n', value_name = "N", default_value_t = 1)]
    pub workers: usize,
    /// Relative residual |b - A x| / |b| to reach, checked in double precision
    #[arg(long, value_name = "R", default_value_t = 0.01, value_parser = tolerance)]
    pub rtol: f64,
    /// Most PCG iterations
    #[arg(long, value_name = "N", default_value_t = 2000)]
    pub max_iterations: u32,
    /// Write the solution as a Matrix Market array
    #[arg(long, value_name = "FILE")]
    pub solution: Option<PathBuf>,
    /// What a matrix-vector product exchanges: halo = only the rows that are read, full = whole sub-vectors (P-Cloth)
    #[arg(long, value_enum, default_value = "halo")]
    pub exchange: ExchangeArg,
    /// Order of the transfers; auto = the cheapest by the modelled cost
    #[arg(long, default_value = "auto")]
    pub schedule: ScheduleKind,
    /// Preconditioner; auto = the fastest for the executor and size
    #[arg(long, value_enum, default_value = "auto")]
    pub preconditioner: PreconditionerArg,
    /// Topology file; workers sit on its first GPUs [default: a balanced binary tree]
    #[arg(long, value_name = "FILE")]
    pub topology: Option<PathBuf>,
    /// What runs the kernels; auto = a hardware GPU where there is one, else cpu
    #[arg(long, value_enum, default_value = "auto")]
    pub executor: ExecutorArg,
    /// Adapter of the gpu executor (numbers: loomtree doctor) [default: rank modulo adapters]
    #[arg(long, value_name = "I")]
    pub adapter: Option<usize>,
    /// Threads of each worker on the cpu executor [default: cores / workers]
    #[arg(long, value_name = "T", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Whether workers of one thread that share cores evenly (more workers than cores) keep to one core each; never = the
    /// system decides
    #[arg(long, value_enum, default_value = "auto")]
    pub bind_cores: BindCoresArg,
    /// Record what the workers compute, transfer and wait for (with --repeat: in the first 20 solves) and write trace.json (for
    /// ui.perfetto.dev) and report.json into this folder, which loomtree predict takes like a run directory
    #[arg(long, value_name = "DIR")]
    pub trace: Option<PathBuf>,
    /// Solve K times and time products on their own, for benchmarks; the median counts
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub repeat: u32,
}

/// Where the workers of a solve come from.
const LAUNCH: Launch = Launch::Spawn;

fn tolerance(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value < 1.0 => Ok(value),
        _ => Err("expected a number between 0 and 1".to_string()),
    }
}

/// A solve that can start: everything that can be refused has been checked.
pub struct SolveJob {
    /// The arguments.
    pub args: SolveArgs,
    /// The matrix.
    pub system: BlockSystem,
    /// Right-hand side, one value per row of the file.
    pub rhs: Vec<f64>,
    /// Rows and ranks.
    pub partition: RowPartition,
    /// Work queues and how they were chosen.
    pub transfers: Plan,
    /// Numbers for all ranks.
    pub params: SolveParams,
    /// Threads of each rank on the cpu executor.
    pub threads: usize,
    /// Rows of the matrix in the file.
    pub file_rows: usize,
    /// Block row of the file of each block row of the system, if it was reordered.
    pub order: Option<Vec<u32>>,
    /// The topology's name.
    pub topology: String,
    /// Where the trace goes, if one is wanted.
    pub trace: Option<TraceFolder>,
}

/// Runs the command.
///
/// # Errors
/// Bad input (exit code 2), or a solve that failed or did not converge (exit code 1).
pub fn run(args: SolveArgs) -> Result<(), CliError> {
    let job = prepare(args)?;
    let facts = job.facts();
    let (results, executor) = run_on_workers(job)?;
    if let Some(folder) = &facts.trace {
        folder.write(facts.header(), &executor, &results)?;
    }
    report(&facts, &executor, &results)
}

/// Reads and checks everything.
///
/// # Errors
/// Bad input.
pub fn prepare(args: SolveArgs) -> Result<SolveJob, CliError> {
    if args.workers == 0 || args.workers > RANKS_MAX {
        return Err(CliError::bad_input(format!("--workers {}: expected 1 to {RANKS_MAX}", args.workers)));
    }
    if let Some(path) = &args.solution {
        check_writable(path)?;
    }
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
    let (workers, block_rows) = (args.workers, system.block_rows());
    if workers > block_rows {
        return Err(CliError::bad_input(format!(
            "--workers {workers}: the matrix has only {block_rows} block rows (three rows each); use at most as many workers"
        )));
    }
    let partition = RowPartition::new(block_rows, workers);
    let topology = args.topology.as_deref();
    let (transfers, topology) =
        plan_transfers(topology, args.schedule, workers, partition.sub_vector_rows()).map_err(CliError::bad_input)?;
    let threads = args.threads.map_or_else(|| LAUNCH.machine().threads_per_worker(workers), usize::from);
    let params = SolveParams {
        relative_tolerance: args.rtol,
        max_iterations: args.max_iterations,
        repeat: args.repeat,
        time_products: args.repeat > 1,
        host_threads: threads,
        preconditioner: args.preconditioner.into(),
        record_solves: if args.trace.is_some() { SOLVES_MOST } else { 0 },
    };
    let file_rows = system.scalar_rows;
    let order = args.preconditioner.may_sweep().then(|| better_order(&system, partition.chunk_rows())).flatten();
    let (system, rhs) = match &order {
        None => (system, rhs),
        Some(order) => (system.reordered(order), blockwise(order, rhs)),
    };
    let trace = args.trace.as_deref().map(TraceFolder::new).transpose()?;
    Ok(SolveJob { args, system, rhs, partition, transfers, params, threads, file_rows, order, topology, trace })
}

/// An order that brings coupled rows together, if it cuts clearly fewer couplings between chunks than the file's.
fn better_order(system: &BlockSystem, chunk_rows: usize) -> Option<Vec<u32>> {
    const CLEARLY: f64 = 0.8;
    let natural: Vec<u32> = (0..system.block_rows() as u32).collect();
    let order = locality_order(system, chunk_rows);
    let share = |order: &[u32]| share_between_chunks(system, order, chunk_rows);
    (share(&order) < CLEARLY * share(&natural)).then_some(order)
}

/// Values of a vector in another order of the block rows; missing ones are zero.
fn blockwise(order: &[u32], values: Vec<f64>) -> Vec<f64> {
    let at = |index: usize| values.get(index).copied().unwrap_or(0.0);
    order.iter().flat_map(|&old| (0..DIM).map(move |c| old as usize * DIM + c)).map(at).collect()
}

impl SolveJob {
    /// What the report needs of the job once the system is given away.
    pub fn facts(&self) -> SolveFacts {
        SolveFacts {
            rows: self.file_rows,
            block_rows: self.system.block_rows(),
            workers: self.args.workers,
            exchange: self.args.exchange.into(),
            schedule: self.transfers.kind,
            rtol: self.args.rtol,
            max_iterations: self.args.max_iterations,
            solution: self.args.solution.clone(),
            order: self.order.clone(),
            matrix: self.args.matrix.clone(),
            topology: self.topology.clone(),
            trace: self.trace.clone(),
        }
    }
}

/// Longest silence of a worker while it reads its part or works without waiting for others.
const SILENCE_LIMIT: Duration = Duration::from_secs(300);

/// Solves on worker processes; the results in rank order and the executor's name.
///
/// # Errors
/// A worker failed or its executor cannot be had.
pub fn run_on_workers(job: SolveJob) -> Result<(Vec<SolveResult>, String), CliError> {
    let SolveJob { args, system, rhs, partition, transfers, params, threads, .. } = job;
    let ranks = partition.ranks();
    let max_message_values = partition.sub_vector_rows() * 2 * DIM;
    if ranks > 1 {
        LAUNCH.machine().check_transfers(ranks, max_message_values).map_err(|error| match error {
            MachineError::TooSmall(text) => CliError::bad_input(text),
            MachineError::Unreadable(text) => CliError::failed(text),
        })?;
    }
    let named = |error: CrewError| match error {
        CrewError::Failed { failure: Failure::BadInput(text), .. } => CliError::bad_input(text),
        CrewError::Failed { failure: Failure::Other(text), .. } => {
            CliError::failed(format!("{}: {text}", args.matrix.display()))
        }
        other => CliError::failed(other),
    };
    let mut crew = Crew::assemble(ranks, &LAUNCH, SILENCE_LIMIT).map_err(named)?;
    let setup = WorkerSetup {
        executor: args.executor.into(),
        adapter: args.adapter,
        threads,
        bind_cores: args.bind_cores.into(),
        ranks,
        max_message_values,
        patience_s: 3600.0,
        links: None,
    };
    system
        .split(rhs, &partition, |rank, mut part| {
            let arrays = std::mem::take(&mut part.arrays);
            let exchange = ExchangePlan { mode: args.exchange.into(), queue: transfers.schedule.queues[rank].clone() };
            crew.send(
                rank,
                &ToWorker::Solve { setup: setup.clone(), exchange, params, system: Box::new(part) },
                &arrays.to_bytes(),
            )?;
            crew.flush(rank, SILENCE_LIMIT)
        })
        .map_err(named)?;
    let mut results: Vec<Option<SolveResult>> = vec![None; ranks];
    let mut name = String::new();
    crew.collect(SILENCE_LIMIT, |rank, message, arrays| match (message, arrays) {
        (ToCoordinator::Solved { stats, executor, mut record }, [x, events]) => {
            let x = x.chunks_exact(size_of::<f64>()).map(bytemuck::pod_read_unaligned).collect();
            record.events = events.chunks_exact(size_of::<Event>()).map(bytemuck::pod_read_unaligned).collect();
            results[rank] = Some(SolveResult { stats, x, record });
            name = executor;
            true
        }
        _ => false,
    })
    .map_err(named)?;
    crew.dismiss();
    Ok((results.into_iter().flatten().collect(), name))
}

/// Finds out before a long solve that its result could not be written.
fn check_writable(path: &std::path::Path) -> Result<(), CliError> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(std::path::Path::new("."));
    let refused = |what: String| CliError::bad_input(format!("--solution {}: {what}", path.display()));
    if path.is_dir() {
        return Err(refused("is a folder; name a file".to_string()));
    }
    if !folder.is_dir() {
        return Err(refused(format!("there is no folder {}", folder.display())));
    }
    match tempfile::tempfile_in(folder) {
        Ok(_) => Ok(()),
        Err(error) => Err(refused(format!("cannot write into {}: {error}", folder.display()))),
    }
}
