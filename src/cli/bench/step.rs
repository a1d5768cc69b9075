//! `loomtree bench step` and `bench memory`: whole steps with real worker processes.

use std::path::PathBuf;

use super::table::Table;
use super::{CliError, Common, median, worker_counts};
use crate::cli::run::{ExchangeArg, defaults};
use crate::coordinator::{Launch, RunOptions, RunPlaces, RunPlan};
use crate::output::{Existing, Report};

/// Arguments of `loomtree bench step` and `loomtree bench memory`.
#[derive(Clone, Debug, clap::Args)]
pub struct StepBench {
    #[command(flatten)]
    common: Common,
    /// Scene to run
    #[arg(long, default_value = "scenes/flag.toml")]
    scene: PathBuf,
    /// Triangles of the scene
    #[arg(long, default_value_t = 50_000)]
    resolution: u64,
    /// Numbers of worker processes, measured in turn
    #[arg(long, value_delimiter = ',', default_value = "1,2,4,8", value_parser = worker_counts)]
    workers: Vec<usize>,
    /// Steps per run; the first fifth is not counted
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(2..))]
    steps: u32,
    /// Rounds: every number of workers is run this many times, interleaved
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// What a product exchanges
    #[arg(long, value_enum, default_value = "halo")]
    exchange: ExchangeArg,
}

/// Medians of one number of workers.
#[derive(Default)]
struct Measured {
    step_s: Vec<f64>,
    solve_s: Vec<f64>,
    iterations: f64,
    bytes_per_spmv: f64,
    device_bytes: f64,
    resident_bytes: f64,
    first_step_s: f64,
}

pub fn run(bench: &StepBench, memory: bool) -> Result<(), CliError> {
    let mut all: Vec<Measured> = bench.workers.iter().map(|_| Measured::default()).collect();
    let mut size = (0, 0);
    for _ in 0..bench.rounds {
        for (&workers, measured) in bench.workers.iter().zip(&mut all) {
            size = measure(bench, workers, measured)?;
        }
    }
    let (triangles, vertices) = size;
    let title = format!(
        "{}: {triangles} triangles, {vertices} vertices, {} thread(s) per worker",
        bench.scene.display(),
        bench.common.threads
    );
    let table =
        if memory { memory_table(bench, title, all, vertices) } else { step_table(bench, title, all, triangles) };
    table.finish(
        bench.common.out.as_deref(),
        Some(("workers", if memory { "device_bytes_per_vertex" } else { "speedup" })),
    )
}

fn step_table(bench: &StepBench, title: String, all: Vec<Measured>, triangles: usize) -> Table {
    let columns =
        vec!["workers", "step_ms", "solve_ms", "iterations", "us_per_triangle", "speedup", "bytes_per_spmv", "start_s"];
    let mut table = Table::new("step", title, columns);
    let mut base = None;
    for (&workers, mut m) in bench.workers.iter().zip(all) {
        let step = median(&mut m.step_s);
        let base = *base.get_or_insert(step);
        table.push(vec![
            workers as f64,
            step * 1e3,
            median(&mut m.solve_s) * 1e3,
            m.iterations,
            step * 1e6 / triangles as f64,
            base / step,
            m.bytes_per_spmv,
            m.first_step_s,
        ]);
    }
    table
}

fn memory_table(bench: &StepBench, title: String, all: Vec<Measured>, vertices: usize) -> Table {
    let columns =
        vec!["workers", "device_bytes", "device_bytes_per_vertex", "peak_resident_bytes", "peak_resident_per_vertex"];
    let mut table = Table::new("memory", title, columns);
    for (&workers, m) in bench.workers.iter().zip(all) {
        table.push(vec![
            workers as f64,
            m.device_bytes,
            m.device_bytes / vertices as f64,
            m.resident_bytes,
            m.resident_bytes / vertices as f64,
        ]);
    }
    table
}

fn measure(bench: &StepBench, workers: usize, measured: &mut Measured) -> Result<(usize, usize), CliError> {
    let folder =
        tempfile::tempdir().map_err(|error| CliError::failed(format!("cannot make a temporary folder: {error}")))?;
    let options = RunOptions {
        workers,
        executor: bench.common.executor.into(),
        threads: Some(bench.common.threads as usize),
        resolution: Some(bench.resolution),
        frames: Some(1),
        exchange: bench.exchange.into(),
        checkpoint_every: 0,
        heartbeat_s: 120.0,
        trace_steps: 0,
        ..defaults()
    };
    let mut plan = RunPlan::new(&bench.scene, &options).map_err(CliError::bad_input)?;
    // One frame at the end, so that frames are not part of what is measured.
    plan.scene.settings.steps_per_frame = bench.steps;
    let size = (plan.scene.mesh.triangles.len(), plan.scene.mesh.positions.len());
    let places = RunPlaces { scene: bench.scene.clone(), out: folder.path().join("run"), existing: Existing::Refuse };
    let start = std::time::Instant::now();
    crate::coordinator::run(plan, &options, &places, &Launch::Spawn)
        .map_err(|error| CliError::failed(error.to_string()))?;
    let wall = start.elapsed().as_secs_f64();
    let report = Report::load(&places.out.join("report.json")).map_err(CliError::failed)?;
    let all: f64 = report.steps.iter().map(|step| step.stage_seconds.total).sum();
    let counted = &report.steps[(bench.steps as usize).div_ceil(5)..];
    let last = counted.last().ok_or_else(|| CliError::failed("no step was measured"))?;
    measured.step_s.extend(counted.iter().map(|step| step.stage_seconds.total));
    measured.solve_s.extend(counted.iter().map(|step| step.stage_seconds.solve));
    measured.iterations = counted.iter().map(|step| step.iterations as f64).sum::<f64>() / counted.len() as f64;
    measured.bytes_per_spmv = last.bytes_per_spmv as f64;
    measured.device_bytes = last.memory_bytes_per_rank.iter().sum::<u64>() as f64;
    measured.resident_bytes = last.resident_bytes_per_rank.iter().sum::<u64>() as f64;
    // Everything before and after the steps: reading, splitting, starting, leaving.
    measured.first_step_s = wall - all;
    Ok(size)
}
