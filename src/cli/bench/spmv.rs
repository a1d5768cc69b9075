//! `loomtree bench spmv`: the matrix-vector product of the matrices of scenes in contact on 1 to 16 ranks, P-Cloth's Fig. 5
//! [Li et al. 2020]: all-gather first [Cevahir et al. 2009], the pipelined product with every schedule, and halo rows.
//! Modeled on the machine of a topology file from the bytes and flops of these very matrices, and measured with ranks
//! that are threads of this machine; the two never share a table.

use std::path::{Path, PathBuf};

use super::common::{Common, machine, median, positive, worker_counts};
use super::ranks::{ModelState, median_s, seconds_of};
use super::table::FigureTable;
use crate::cli::CliError;
use crate::gpu::bandwidth_gb_s;
use crate::interconnect::{
    DeviceModel, Kernel, KernelTimes, Phase, Plan, ProductExchange, QueueNode, RecordedProduct, RecordedStep, Replay,
    ScheduleKind, Topology, Traffic, direct, plan, replay,
};
use crate::model::GlobalModel;
use crate::output::Machine;
use crate::scene::Overrides;
use crate::solver::ExchangeMode;
use crate::telemetry::Event;

/// Arguments of `loomtree bench spmv`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct SpmvBench {
    #[command(flatten)]
    common: Common,
    /// Scenes whose matrices are multiplied
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "scenes/flag.toml,scenes/sphere.toml,scenes/funnel.toml,scenes/twisting.toml"
    )]
    scene: Vec<PathBuf>,
    /// Triangles of each scene
    #[arg(long, default_value_t = 20_000, value_parser = crate::cli::count)]
    resolution: u64,
    /// Numbers of ranks
    #[arg(long, value_delimiter = ',', default_value = "1,2,4,8,16", value_parser = worker_counts)]
    workers: Vec<usize>,
    /// Products to time
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..))]
    repeat: u32,
    /// Rounds: on this machine every way to multiply is measured this many times, interleaved; the fastest median counts
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// The matrix is that of the first step with so many contacts per vertex
    #[arg(long, default_value_t = 0.05, value_parser = positive)]
    contacts: f64,
    /// Or that after so many steps, whichever comes first; 0: of the start state
    #[arg(long, default_value_t = 600)]
    steps: u32,
    /// Machine of the modeled table [default: Titan Xp on a balanced tree of PCIe 3 x16 links]
    #[arg(long, value_name = "FILE")]
    topology: Option<PathBuf>,
    /// Shares of the memory bandwidth that the modeled kernel reaches, a table each
    #[arg(long, value_delimiter = ',', default_value = "1", value_parser = positive)]
    efficiency: Vec<f64>,
}

/// Schedules of the pipelined product, in the order of the columns.
const SCHEDULES: [ScheduleKind; 4] =
    [ScheduleKind::FatTree, ScheduleKind::Ring, ScheduleKind::Direct, ScheduleKind::Best];
/// Columns of speed-ups, modeled.
const MODELED: [&str; 10] = [
    "ranks",
    "one_gpu_ms",
    "gather_first",
    "gather_first_ring",
    "gather_first_best",
    "full_fat_tree",
    "full_ring",
    "full_direct",
    "full_best",
    "halo_best",
];
/// Columns of speed-ups, measured: on one machine nothing is forwarded, so one order is enough for the baseline and for halos.
const MEASURED: [&str; 8] =
    ["ranks", "one_rank_ms", "gather_first", "full_fat_tree", "full_ring", "full_direct", "full_best", "halo"];

pub(super) fn run(bench: &SpmvBench) -> Result<(), CliError> {
    let machine = machine(bench.topology.as_deref(), bench.workers.iter().copied().max().unwrap_or(1))?;
    for file in &bench.scene {
        of_scene(bench, file, &machine)?;
    }
    Ok(())
}

/// Recorded products of one scene, for all its tables.
struct SceneProducts<'a> {
    bench: &'a SpmvBench,
    state: ModelState,
    /// For names of files.
    stem: String,
    /// Scene, size and step, for titles.
    what: String,
    /// One product for one rank, and for every number of ranks.
    recorded: Vec<Recorded>,
}

/// Traffic and kernels of a product on a number of ranks, in both exchange modes.
struct Recorded {
    ranks: usize,
    halo: Product,
    full: Product,
}

type Product = (Traffic, RecordedProduct);

fn of_scene(bench: &SpmvBench, file: &Path, machine: &Topology) -> Result<(), CliError> {
    let overrides = Overrides { resolution: Some(bench.resolution), frames: None };
    let scene = crate::scene::load(file, &overrides).map_err(CliError::bad_input)?;
    let model = GlobalModel::new(&scene);
    let rows = model.rows();
    if let Some(ranks) = bench.workers.iter().find(|ranks| **ranks > rows) {
        return Err(CliError::bad_input(format!("--workers {ranks}: {} has only {rows} vertices", file.display())));
    }
    let state = ModelState::in_contact(model, &bench.common, bench.contacts, bench.steps)?;
    let stem = file.file_stem().map_or("scene".into(), |stem| stem.to_string_lossy().into_owned());
    let what = format!("{}, {rows} rows, {} contacts, step {}", scene.name, state.contacts, state.step);
    let mut products = SceneProducts { bench, state, stem, what, recorded: Vec::new() };
    products.record()?;
    products.one_rank()?;
    products.bytes()?;
    let curves = |columns: &'static [&'static str]| Some((columns[0], &columns[2..]));
    for &efficiency in &bench.efficiency {
        products.modeled(machine, efficiency)?.finish_curves(bench.common.out.as_deref(), curves(&MODELED))?;
    }
    products.measured()?.finish_curves(bench.common.out.as_deref(), curves(&MEASURED))
}

impl SceneProducts<'_> {
    fn record(&mut self) -> Result<(), CliError> {
        let more = self.bench.workers.iter().copied().filter(|ranks| *ranks > 1);
        for ranks in std::iter::once(1).chain(more) {
            let [halo, full] = [ExchangeMode::Halo, ExchangeMode::Full].map(|mode| self.product(ranks, mode));
            self.recorded.push(Recorded { ranks, halo: halo?, full: full? });
        }
        Ok(())
    }

    /// Time of a product on one rank against the bandwidth of the memory.
    fn one_rank(&self) -> Result<(), CliError> {
        let (bench, common) = (self.bench, &self.bench.common);
        let bandwidth =
            bandwidth_gb_s(&common.executor()?, 512 << 20).map_err(|error| CliError::failed(error.to_string()))?;
        let timed = self.state.on_ranks(common, ExchangeMode::Halo, &[Vec::new()], |simulation, transport| {
            let times = simulation.time_products(transport, bench.repeat).map_err(|error| error.to_string())?;
            Ok((times, simulation.product_bytes(), simulation.padding_ratio))
        })?;
        let [(times, bytes, padding)] = &timed[..] else { return Err(CliError::failed("one rank has one result")) };
        let best = times.iter().map(seconds_of).fold(f64::INFINITY, f64::min);
        let middle = median(&mut times.iter().map(seconds_of).collect::<Vec<_>>());
        let rate = *bytes as f64 / middle / 1e9;
        let title = format!(
            "measured: one product on one rank, {} thread(s), padding {padding:.3}: {}",
            common.threads, self.what
        );
        let columns = vec!["rows", "median_ms", "min_ms", "bytes", "gb_s", "read_gb_s", "share_of_read"];
        let mut table = FigureTable::new(format!("spmv_{}", self.stem), title, columns);
        let rows = self.state.model.rows() as f64;
        let share = rate / bandwidth.read_gb_s;
        table.push(vec![rows, middle * 1e3, best * 1e3, *bytes as f64, rate, bandwidth.read_gb_s, share]);
        table.finish(common.out.as_deref(), None)
    }

    /// Prints the bytes that ranks receive per product.
    fn bytes(&self) -> Result<(), CliError> {
        let title = format!("counted: bytes that all ranks receive per product: {}", self.what);
        let columns = vec!["ranks", "halo_bytes", "full_bytes", "halo_over_full"];
        let mut table = FigureTable::new(format!("spmv_{}_bytes", self.stem), title, columns);
        for Recorded { ranks, halo, full } in self.recorded.iter().filter(|recorded| recorded.ranks > 1) {
            let [halo, full] = [halo, full].map(|(traffic, _)| traffic.received.iter().flatten().sum::<f64>());
            table.push(vec![*ranks as f64, halo, full, halo / full]);
        }
        table.finish(self.bench.common.out.as_deref(), Some(("ranks", "halo_over_full")))
    }

    /// Traffic and kernels of one product on `ranks` ranks.
    fn product(&self, ranks: usize, mode: ExchangeMode) -> Result<Product, CliError> {
        let queues = direct(ranks).queues;
        let events: Vec<Vec<Event>> =
            self.state.on_ranks(&self.bench.common, mode, &queues, |simulation, transport| {
                simulation.record_product(transport).map_err(|error| error.to_string())
            })?;
        let step = RecordedStep::of_events(self.state.step, &events).map_err(CliError::failed)?;
        let product = step.phases.into_iter().find_map(|phase| match phase {
            Phase::Product(traffic, product) => Some((traffic, product)),
            _ => None,
        });
        product.ok_or_else(|| CliError::failed("no product was recorded"))
    }

    /// Speed-ups by the clock on the machine of the topology file; ranks that it has no GPUs for are left out.
    fn modeled(&self, machine: &Topology, efficiency: f64) -> Result<FigureTable, CliError> {
        let device = machine.device();
        let derated = DeviceModel { bandwidth_gb_s: device.bandwidth_gb_s * efficiency, ..device.clone() };
        let machine = machine.with_device(derated);
        let title = format!(
            "modelled, not measured: speed-up of a product over one {} on {}, kernel at {:.0} % of the memory bandwidth: {}",
            device.name,
            machine.name(),
            efficiency * 100.0,
            self.what
        );
        let slow = if efficiency == 1.0 { String::new() } else { format!("_{:.0}", efficiency * 100.0) };
        let mut table = FigureTable::modeled(format!("spmv_{}_modelled{slow}", self.stem), title, MODELED.to_vec());
        let one_gpu_s = self.recorded.first().map_or(f64::NAN, |one| kernel_s(machine.device(), &one.halo.1));
        let wanted = |ranks: &usize| self.bench.workers.contains(ranks) && *ranks <= machine.gpus();
        for Recorded { ranks, halo, full } in self.recorded.iter().filter(|recorded| wanted(&recorded.ranks)) {
            let topology = machine.with_first_gpus(*ranks).map_err(CliError::bad_input)?;
            let seconds = |kind, exchange| match exchange {
                // Kernels of whole row blocks, as the halo product has them.
                ProductExchange::Full => self.product_s(&topology, full, kind, exchange),
                _ => self.product_s(&topology, halo, kind, exchange),
            };
            let mut row = vec![*ranks as f64, one_gpu_s * 1e3];
            for kind in [ScheduleKind::Direct, ScheduleKind::Ring, ScheduleKind::Best] {
                row.push(one_gpu_s / seconds(kind, ProductExchange::GatherFirst)?);
            }
            for kind in SCHEDULES {
                row.push(one_gpu_s / seconds(kind, ProductExchange::Full)?);
            }
            row.push(one_gpu_s / seconds(ScheduleKind::Best, ProductExchange::Halo)?);
            table.push(row);
        }
        Ok(table)
    }

    /// Modeled time of a recorded product; NaN if the schedule does not exist for this number of ranks.
    fn product_s(
        &self,
        topology: &Topology,
        (traffic, product): &Product,
        kind: ScheduleKind,
        exchange: ProductExchange,
    ) -> Result<f64, CliError> {
        let rows = self.state.model.rows();
        let Some(plan) = self.plan(kind, topology) else { return Ok(f64::NAN) };
        let phases = vec![Phase::Product(traffic.clone(), product.clone())];
        let step = RecordedStep { step: self.state.step, phases };
        let how = Replay { topology, plan: &plan, exchange, kernels: KernelTimes::Device, rows };
        Ok(replay(&step, &how, false).map_err(CliError::failed)?.total_s)
    }

    fn plan(&self, kind: ScheduleKind, topology: &Topology) -> Option<Plan> {
        let sub_vector_rows = self.state.model.rows().div_ceil(topology.gpus());
        plan(kind, topology, sub_vector_rows as f64 * 12.0).ok()
    }

    /// Speed-ups on this machine, with ranks that are threads of this process.
    fn measured(&self) -> Result<FigureTable, CliError> {
        let cores = Machine::here().cores;
        let title = format!(
            "measured on this machine of {cores} core(s), ranks are threads of it: speed-up of a product over one rank, {} \
             thread(s) per rank: {}",
            self.bench.common.threads, self.what
        );
        let mut table = FigureTable::new(format!("spmv_{}_measured", self.stem), title, MEASURED.to_vec());
        let one = Way { mode: ExchangeMode::Halo, gather_first: false, queues: vec![Vec::new()] };
        let mut ways = vec![Some(one)];
        for &ranks in &self.bench.workers {
            ways.extend(self.ways(ranks)?);
        }
        let mut seconds = vec![f64::NAN; ways.len()];
        for _ in 0..self.bench.rounds {
            for (way, best_s) in ways.iter().zip(&mut seconds) {
                if let Some(way) = way {
                    // The first number replaces the initial NaN.
                    *best_s = self.time(way)?.min(*best_s);
                }
            }
        }
        let one_rank_s = seconds[0];
        for (&ranks, row) in self.bench.workers.iter().zip(seconds[1..].chunks(MEASURED.len() - 2)) {
            let speed_ups = row.iter().map(|seconds| one_rank_s / seconds);
            table.push([ranks as f64, one_rank_s * 1e3].into_iter().chain(speed_ups).collect());
        }
        Ok(table)
    }

    /// The way of exchanging behind each of the columns [`MEASURED`]; none where the number of ranks has no such
    /// schedule.
    fn ways(&self, ranks: usize) -> Result<Vec<Option<Way>>, CliError> {
        let topology = Topology::default_for(ranks).map_err(CliError::bad_input)?;
        let order = direct(ranks).queues;
        let way = |mode, gather_first, queues| Some(Way { mode, gather_first, queues });
        let mut ways = vec![way(ExchangeMode::Full, true, order.clone())];
        for kind in SCHEDULES {
            let plan = self.plan(kind, &topology);
            ways.push(plan.and_then(|plan| way(ExchangeMode::Full, false, plan.schedule.queues)));
        }
        ways.push(way(ExchangeMode::Halo, false, order));
        Ok(ways)
    }

    /// Median seconds of a product.
    fn time(&self, way: &Way) -> Result<f64, CliError> {
        let times = self.state.on_ranks(&self.bench.common, way.mode, &way.queues, |simulation, transport| {
            let times = match way.gather_first {
                true => simulation.time_gather_first(transport, self.bench.repeat),
                false => simulation.time_products(transport, self.bench.repeat),
            };
            times.map_err(|error| error.to_string())
        })?;
        Ok(median_s(&times))
    }
}

/// A way to multiply on ranks of this machine.
struct Way {
    mode: ExchangeMode,
    gather_first: bool,
    /// Work queue of every rank.
    queues: Vec<Vec<QueueNode>>,
}

/// Modeled time of all kernels of a product as one.
fn kernel_s(device: &DeviceModel, product: &RecordedProduct) -> f64 {
    let all = match product {
        RecordedProduct::Halo(halves) => halves.iter().map(|(local, remote)| local.plus(*remote)).collect::<Vec<_>>(),
        RecordedProduct::Full(blocks) => blocks.iter().flatten().copied().collect(),
    };
    let sum = all.into_iter().fold(Kernel::default(), Kernel::plus);
    device.kernel_s(sum.bytes, sum.flops)
}
