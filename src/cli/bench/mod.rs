//! `loomtree bench`: measures this program on this machine, and models other machines. Every table says what it ran on;
//! modeled figures stand in tables or columns of their own that say so.

mod assembly;
mod collision;
mod common;
mod device;
mod drape;
mod interconnect;
mod matrix_free;
mod ranks;
mod runs;
mod scaling;
mod sewn;
mod spmv;
mod step;
mod strain;
mod table;
mod table1;
mod time;
mod time_hybrid;
mod time_levels;
mod time_play;
mod time_sweep;

use clap::Subcommand;

use super::CliError;
use super::launcher::LauncherArgs;
use crate::coordinator::Launch;
use crate::os::console;

/// Arguments of `loomtree bench`.
#[derive(Clone, Debug, clap::Args)]
pub struct BenchArgs {
    /// Who starts the workers.
    #[command(flatten)]
    pub launcher: LauncherArgs,
    #[command(subcommand)]
    what: Bench,
}

#[derive(Clone, Debug, Subcommand)]
enum Bench {
    /// Memory bandwidth of the executor: copy and read, to hold the others against
    Device(device::DeviceBench),
    /// Matrix-vector product of scenes' matrices in contact on 1 to 16 ranks: gather first, pipelined with every
    /// schedule, halo rows; modeled on a topology file's machine and measured on this one, apart; bandwidth and bytes
    /// exchanged
    Spmv(spmv::SpmvBench),
    /// Collision detection and impact zones of scenes on several numbers of worker processes: time, tests, their split
    Collision(runs::ScenesBench),
    /// Whole steps of scenes on several numbers of worker processes: time, speed-up, bytes, shares of the stages
    Step(runs::ScenesBench),
    /// Assembly of scenes' matrices on several numbers of worker processes: element records, index fill, value fill
    Assembly(runs::ScenesBench),
    /// Strong and weak scaling of whole steps (weak: --resolution triangles per worker), measured on this machine and
    /// modeled on a topology file's
    Scaling(scaling::ScalingBench),
    /// The same integrator with and without a stored matrix (cpu executor, one rank): product, memory, whole step
    MatrixFree(matrix_free::MatrixFreeBench),
    /// The eleven benchmarks of P-Cloth's Table 1 with scenes of this project: frames per second on 1, 2 and 4 workers,
    /// measured here, modeled on a topology file's machine, and theirs, apart
    Table1(table1::Table1Bench),
    /// Memory of scenes' workers per structure and vertex
    Memory(runs::ScenesBench),
    /// Drape coefficient and folds of every round cloth of a run, such as one of scenes/cusick.toml
    Drape(drape::DrapeBench),
    /// Stretch of every piece of cloth of a run, and how far it goes beyond the strain limits
    Strain(strain::StrainBench),
    /// Modeled, not measured: products on the machines of topology files, every exchange and schedule
    Interconnect(interconnect::InterconnectBench),
    /// Modeled from measured steps: a shot split in time over 2 to 512 processes, played on a virtual clock
    Time(time::TimeBench),
}

/// Runs a benchmark and prints its tables.
pub fn run(args: BenchArgs, launch: &Launch) -> Result<(), CliError> {
    if !matches!(args.what, Bench::Interconnect(_) | Bench::Drape(_) | Bench::Strain(_)) {
        warn_of_load();
    }
    match args.what {
        Bench::Device(bench) => device::run(&bench),
        Bench::Spmv(bench) => spmv::run(&bench),
        Bench::Collision(bench) => bench.each(launch)?.iter().try_for_each(collision::run),
        Bench::Step(bench) => bench.each(launch)?.iter().try_for_each(step::time),
        Bench::Assembly(bench) => bench.each(launch)?.iter().try_for_each(assembly::run),
        Bench::Scaling(bench) => scaling::run(&bench, launch),
        Bench::MatrixFree(bench) => matrix_free::run(&bench),
        Bench::Table1(bench) => table1::run(&bench, launch),
        Bench::Memory(bench) => bench.each(launch)?.iter().try_for_each(step::memory),
        Bench::Drape(bench) => drape::run(&bench),
        Bench::Strain(bench) => strain::run(&bench),
        Bench::Interconnect(bench) => interconnect::run(&bench),
        Bench::Time(bench) => time::run(&bench, launch),
    }
}

/// Prints the load average, because other work on the machine distorts times.
fn warn_of_load() {
    let load =
        std::fs::read_to_string("/proc/loadavg").ok().and_then(|text| text.split(' ').next()?.parse::<f64>().ok());
    if let Some(load) = load {
        let note = if load > 1.5 { ": the machine is busy, trust ratios only" } else { "" };
        console::note(format_args!("load average {load:.2}{note}"));
    }
}
