//! `loomtree bench spmv`: the matrix-vector product of a scene's own matrix. Time and bandwidth come from one rank that
//! holds the whole matrix; bytes exchanged are counted with the ranks as threads, in both exchange modes.

use std::path::PathBuf;

use super::table::Table;
use super::{CliError, Common, median, worker_counts};
use crate::gpu::{Executor, bandwidth_gb_s};
use crate::interconnect::direct;
use crate::model::{GlobalModel, RankModel};
use crate::partition::RowPartition;
use crate::scene::Overrides;
use crate::solver::ExchangeMode;
use crate::step::{ExchangePlan, Simulation};
use crate::transport::{InProcessTransport, SoloTransport, Transport};

/// Arguments of `loomtree bench spmv`.
#[derive(Clone, Debug, clap::Args)]
pub struct SpmvBench {
    #[command(flatten)]
    common: Common,
    /// Scene whose matrix is multiplied
    #[arg(long, default_value = "scenes/flag.toml")]
    scene: PathBuf,
    /// Triangles of the scene
    #[arg(long, default_value_t = 1_000_000)]
    resolution: u64,
    /// Numbers of ranks for which exchanged bytes are counted
    #[arg(long, value_delimiter = ',', default_value = "2,4,8", value_parser = worker_counts)]
    workers: Vec<usize>,
    /// Products to time
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..))]
    repeat: u32,
}

pub fn run(bench: &SpmvBench) -> Result<(), CliError> {
    let overrides = Overrides { resolution: Some(bench.resolution), frames: None };
    let scene = crate::scene::load(&bench.scene, &overrides).map_err(CliError::bad_input)?;
    let model = GlobalModel::new(&scene);
    time_one_rank(bench, &model)?;
    let title = format!("bytes per product over all ranks, {} rows of {}", model.rows(), scene.name);
    let mut table = Table::new("spmv_bytes", title, vec!["ranks", "halo_bytes", "full_bytes", "halo_over_full"]);
    for &ranks in &bench.workers {
        if ranks > model.rows() {
            return Err(CliError::bad_input(format!(
                "--workers {ranks}: the cloth has only {} vertices",
                model.rows()
            )));
        }
        let [halo, full] = [ExchangeMode::Halo, ExchangeMode::Full].map(|mode| counted_bytes(&model, ranks, mode));
        let (halo, full) = (halo?, full?);
        table.push(vec![ranks as f64, halo, full, halo / full]);
    }
    table.finish(bench.common.out.as_deref(), Some(("ranks", "halo_over_full")))
}

fn time_one_rank(bench: &SpmvBench, model: &GlobalModel) -> Result<(), CliError> {
    let bandwidth =
        bandwidth_gb_s(&bench.common.executor()?, 512 << 20).map_err(|error| CliError::failed(error.to_string()))?;
    let mut simulation = first_step(model, 1, bench.common.executor()?)?;
    let (mut seconds, bytes) =
        simulation.time_products(bench.repeat).map_err(|error| CliError::failed(error.to_string()))?;
    let best = seconds.iter().copied().fold(f64::INFINITY, f64::min);
    let middle = median(&mut seconds);
    let rate = bytes as f64 / middle / 1e9;
    let title = format!(
        "one product, one rank, {} thread(s): {} rows, padding {:.3}",
        bench.common.threads,
        model.rows(),
        simulation.padding_ratio
    );
    let mut table =
        Table::new("spmv", title, vec!["rows", "median_ms", "min_ms", "bytes", "gb_s", "read_gb_s", "share_of_read"]);
    table.push(vec![
        model.rows() as f64,
        middle * 1e3,
        best * 1e3,
        bytes as f64,
        rate,
        bandwidth.read_gb_s,
        rate / bandwidth.read_gb_s,
    ]);
    table.finish(bench.common.out.as_deref(), None)
}

/// A single rank after its first step, so that its matrix holds values.
fn first_step(model: &GlobalModel, ranks: usize, executor: Executor) -> Result<Simulation, CliError> {
    let partition = RowPartition::new(model.rows(), ranks);
    let mut part = None;
    RankModel::split(model, &partition, |_, own| {
        part = Some(own);
        Ok::<(), CliError>(())
    })?;
    let part = part.ok_or_else(|| CliError::failed("the model has no part"))?;
    let plan = ExchangePlan { mode: ExchangeMode::Halo, queue: Vec::new() };
    let mut simulation = Simulation::new(executor, part, &plan).map_err(|error| CliError::failed(error.to_string()))?;
    simulation
        .step(&mut SoloTransport::new(Box::new(|| false)), 1, false)
        .map_err(|error| CliError::failed(error.to_string()))?;
    Ok(simulation)
}

/// Bytes that all ranks together receive per product, counted over one step.
fn counted_bytes(model: &GlobalModel, ranks: usize, mode: ExchangeMode) -> Result<f64, CliError> {
    let partition = RowPartition::new(model.rows(), ranks);
    let schedule = direct(ranks);
    let mut parts = Vec::new();
    RankModel::split(model, &partition, |_, own| {
        parts.push(own);
        Ok::<(), CliError>(())
    })?;
    let results: Vec<Result<f64, String>> = std::thread::scope(|scope| {
        let ranks: Vec<_> = parts
            .into_iter()
            .zip(InProcessTransport::group(ranks))
            .zip(&schedule.queues)
            .map(|((part, transport), queue)| {
                scope.spawn(move || bytes_of_rank(part, transport, ExchangePlan { mode, queue: queue.clone() }))
            })
            .collect();
        ranks.into_iter().map(|rank| rank.join().unwrap_or_else(|_| Err("a rank panicked".to_string()))).collect()
    });
    results.into_iter().sum::<Result<f64, String>>().map_err(CliError::failed)
}

fn bytes_of_rank(part: RankModel, mut transport: impl Transport, plan: ExchangePlan) -> Result<f64, String> {
    let mut simulation = Simulation::new(Executor::cpu(1), part, &plan).map_err(|error| error.to_string())?;
    let stats = simulation.step(&mut transport, 1, false).map_err(|error| error.to_string())?;
    Ok(stats.spmv_bytes as f64 / stats.products as f64)
}
