//! `loomtree bench`: measures this program on this machine, and models other machines. Every table says what it ran on;
//! modelled figures stand in tables or columns of their own that say so.

mod assembly;
mod collision;
mod device;
mod interconnect;
mod matrix_free;
mod ranks;
mod runs;
mod scaling;
mod spmv;
mod step;
mod table;

use std::path::{Path, PathBuf};

use clap::Subcommand;

use super::CliError;
use super::run::ExecutorArg;
use crate::gpu::Executor;
use crate::interconnect::Topology;
use crate::os::console;
use crate::protocol::{BindCores, WorkerSetup};

/// Arguments of `loomtree bench`.
#[derive(Clone, Debug, clap::Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    what: Bench,
}

#[derive(Clone, Debug, Subcommand)]
enum Bench {
    /// Memory bandwidth of the executor: copy and read, to hold the others against
    Device(device::DeviceBench),
    /// Matrix-vector product of scenes' matrices in contact on 1 to 16 ranks: gather first, pipelined with every schedule, halo
    /// rows; modelled on a topology file's machine and measured on this one, apart; bandwidth and bytes exchanged
    Spmv(spmv::SpmvBench),
    /// Collision detection and impact zones of scenes on several numbers of worker processes: time, tests, their split
    Collision(runs::ScenesBench),
    /// Whole steps of scenes on several numbers of worker processes: time, speed-up, bytes, shares of the stages
    Step(runs::ScenesBench),
    /// Assembly of scenes' matrices on several numbers of worker processes: element records, index fill, value fill
    Assembly(runs::ScenesBench),
    /// Strong and weak scaling of whole steps (weak: --resolution triangles per worker), measured on this machine and modelled
    /// on a topology file's
    Scaling(scaling::ScalingBench),
    /// The same integrator with and without a stored matrix (cpu executor, one rank): product, memory, whole step
    MatrixFree(matrix_free::MatrixFreeBench),
    /// Memory of scenes' workers per structure and vertex
    Memory(runs::ScenesBench),
    /// Modelled, not measured: products on the machines of topology files, every exchange and schedule
    Interconnect(interconnect::InterconnectBench),
}

/// What all benchmarks take.
#[derive(Clone, Debug, clap::Args)]
pub struct Common {
    /// What runs the kernels
    #[arg(long, value_enum, default_value = "cpu")]
    executor: ExecutorArg,
    /// Threads of each worker on the cpu executor
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    threads: u16,
    /// Also write the table as JSON (and as SVG where it is a curve) into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

impl Common {
    fn executor(&self) -> Result<Executor, CliError> {
        let setup = WorkerSetup {
            executor: self.executor.into(),
            adapter: None,
            threads: self.threads as usize,
            bind_cores: BindCores::Auto,
            ranks: 1,
            first_place: 0,
            places: 1,
            epoch: 0,
            max_message_values: 0,
            patience_s: 0.0,
            links: None,
        };
        crate::worker::make_executor(&setup, 0).map_err(CliError::bad_input)
    }
}

/// Runs the command.
pub fn run(args: BenchArgs) -> Result<(), CliError> {
    if !matches!(args.what, Bench::Interconnect(_)) {
        warn_of_load();
    }
    match args.what {
        Bench::Device(bench) => device::run(&bench),
        Bench::Spmv(bench) => spmv::run(&bench),
        Bench::Collision(bench) => bench.each()?.iter().try_for_each(collision::run),
        Bench::Step(bench) => bench.each()?.iter().try_for_each(step::time),
        Bench::Assembly(bench) => bench.each()?.iter().try_for_each(assembly::run),
        Bench::Scaling(bench) => scaling::run(&bench),
        Bench::MatrixFree(bench) => matrix_free::run(&bench),
        Bench::Memory(bench) => bench.each()?.iter().try_for_each(step::memory),
        Bench::Interconnect(bench) => interconnect::run(&bench),
    }
}

/// Other work on the machine makes times useless; say so beside them.
fn warn_of_load() {
    let load =
        std::fs::read_to_string("/proc/loadavg").ok().and_then(|text| text.split(' ').next()?.parse::<f64>().ok());
    if let Some(load) = load {
        let note = if load > 1.5 { ": the machine is busy, trust ratios only" } else { "" };
        console::note(format_args!("load average {load:.2}{note}"));
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// The machine of modelled figures: that of a topology file, or a balanced tree for `gpus` ranks.
fn machine(file: Option<&Path>, gpus: usize) -> Result<Topology, CliError> {
    let made = || Topology::default_for(gpus).map_err(CliError::bad_input);
    file.map_or_else(made, |file| Topology::read(file).map_err(CliError::bad_input))
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value < 1e6 => Ok(value),
        _ => Err("expected a positive number".to_string()),
    }
}

fn worker_counts(text: &str) -> Result<usize, String> {
    match text.parse::<usize>() {
        Ok(n) if (1..=crate::transport::RANKS_MAX).contains(&n) => Ok(n),
        _ => Err(format!("expected numbers of workers from 1 to {}, separated by commas", crate::transport::RANKS_MAX)),
    }
}
