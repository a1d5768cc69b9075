//! `loomtree bench interconnect`: the matrix-vector product of the paper's Fig. 5 by the clock. Everything it prints is
//! modeled from a topology file; nothing is measured.

use std::path::PathBuf;

use super::common::positive;
use super::table::FigureTable;
use crate::cli::CliError;
use crate::interconnect::{Demand, DeviceModel, ProductKernels, ScheduleKind, Topology, TransferPlan, plan, product_s};

/// Arguments of `loomtree bench interconnect`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct InterconnectBench {
    /// Machines (topology files)
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "topology/titan_xp_4.toml,topology/titan_v_8.toml,topology/pcie5_4.toml"
    )]
    topology: Vec<PathBuf>,
    /// Block rows of the matrix
    #[arg(long, default_value_t = 500_000, value_parser = clap::value_parser!(u32).range(64..))]
    rows: u32,
    /// 3x3 blocks per row
    #[arg(long, default_value_t = 13.5, value_parser = positive)]
    blocks: f64,
    /// Shares of the memory bandwidth that the kernel reaches
    #[arg(long, value_delimiter = ',', default_value = "1,0.333", value_parser = positive)]
    efficiency: Vec<f64>,
    /// Also write the tables as JSON and SVG into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Bytes of a row of a vector.
const ROW_BYTES: f64 = 12.0;
/// Values and column of a block.
const BLOCK_BYTES: f64 = 40.0;
const BLOCK_FLOPS: f64 = 18.0;

/// Columns that the picture shows as curves.
const CURVES: [&str; 6] = ["gather_first", "gather_first_best", "full_fat_tree", "full_ring", "full_best", "halo_best"];

/// Modeled speed-ups of one product on one machine over one GPU.
struct Speedups {
    one_gpu_ms: f64,
    /// With schedules direct, fat-tree, ring and best.
    gather_first: [f64; 4],
    /// With schedules fat-tree, ring and best.
    full: [f64; 3],
    halo: f64,
}

pub(super) fn run(bench: &InterconnectBench) -> Result<(), CliError> {
    for file in &bench.topology {
        let machine = Topology::read(file).map_err(CliError::bad_input)?;
        for &efficiency in &bench.efficiency {
            let title = format!(
                "modelled, not measured: speed-up of a product over one GPU, {} rows, {}, kernel at {:.0} % of the memory \
                 bandwidth",
                bench.rows,
                machine.device().name,
                efficiency * 100.0
            );
            let name = format!("interconnect_{}_{:.0}", machine.name(), efficiency * 100.0);
            let columns = vec![
                "gpus",
                "one_gpu_ms",
                "gather_first",
                "gather_first_fat_tree",
                "gather_first_ring",
                "gather_first_best",
                "full_fat_tree",
                "full_ring",
                "full_best",
                "halo_best",
            ];
            let mut table = FigureTable::modeled(&name, title, columns);
            for gpus in [2, 4, 8, 16].into_iter().filter(|gpus| *gpus <= machine.gpus()) {
                let topology = machine.with_first_gpus(gpus).map_err(CliError::bad_input)?;
                let found = speedups(&topology, bench, efficiency)?;
                let mut row = vec![gpus as f64, found.one_gpu_ms];
                row.extend(found.gather_first.into_iter().chain(found.full));
                row.push(found.halo);
                table.push(row);
            }
            table.finish_curves(bench.out.as_deref(), Some(("gpus", &CURVES)))?;
        }
    }
    Ok(())
}

/// Rank r holds rows / n rows. A square sheet is cut into strips, so that neighboring ranks read sqrt(rows) rows of
/// each other; a halo row is in three blocks of the reader.
fn speedups(topology: &Topology, bench: &InterconnectBench, efficiency: f64) -> Result<Speedups, CliError> {
    let ranks = topology.gpus();
    let rows = f64::from(bench.rows);
    let (own_rows, border_rows) = (rows / ranks as f64, rows.sqrt());
    let device =
        DeviceModel { bandwidth_gb_s: topology.device().bandwidth_gb_s * efficiency, ..topology.device().clone() };
    // Blocks once, a row of the result and one of the vector.
    let kernel_s = |blocks: f64, rows: f64| match blocks {
        0.0 => 0.0,
        _ => device.kernel_s(blocks * BLOCK_BYTES + rows * 2.0 * ROW_BYTES, blocks * BLOCK_FLOPS),
    };
    let one_gpu_s = kernel_s(rows * bench.blocks, rows);
    let neighbors = |rank: usize| (0..ranks).filter(move |other| rank.abs_diff(*other) == 1);
    let own_blocks = own_rows * bench.blocks;
    let block = |rank: usize, vector: usize| {
        let remote_blocks = 3.0 * border_rows;
        match rank.abs_diff(vector) {
            0 => kernel_s(own_blocks - neighbors(rank).count() as f64 * remote_blocks, own_rows),
            1 => kernel_s(remote_blocks, border_rows),
            _ => 0.0,
        }
    };
    let blocks = (0..ranks).map(|rank| (0..ranks).map(|vector| block(rank, vector)).collect()).collect();
    let blocks = ProductKernels::Blocks(blocks);
    let sub_vector_bytes = (rows / ranks as f64).ceil() * ROW_BYTES;
    let modeled = |transfers: &TransferPlan, kernels: &ProductKernels, order: &[Vec<usize>]| {
        product_s(topology, transfers, kernels, order).map_err(|error| CliError::failed(error.to_string()))
    };
    let full = |kind: ScheduleKind, kernels: &ProductKernels| {
        let plan = plan(kind, topology, sub_vector_bytes).map_err(CliError::bad_input)?;
        let vectors = |queue: &Vec<crate::interconnect::QueueNode>| queue.iter().map(|node| node.vector).collect();
        let order: Vec<Vec<usize>> = plan.schedule.queues.iter().map(vectors).collect();
        Ok::<f64, CliError>(one_gpu_s / modeled(&plan.transfers(sub_vector_bytes), kernels, &order)?)
    };
    let whole = ProductKernels::Whole(vec![kernel_s(own_blocks, own_rows); ranks]);
    let halves = |rank: usize| {
        let remote_rows = neighbors(rank).count() as f64 * border_rows;
        let local_rows = own_rows - remote_rows;
        (kernel_s(local_rows * bench.blocks, local_rows), kernel_s(remote_rows * bench.blocks, remote_rows))
    };
    let halves = ProductKernels::Halo((0..ranks).map(halves).collect());
    let demands: Vec<Demand> = (0..ranks)
        .flat_map(|owner| neighbors(owner).map(move |reader| (owner, reader)))
        .map(|(owner, reader)| Demand { owner, bytes: border_rows * ROW_BYTES, readers: vec![reader] })
        .collect();
    let (halo, _) = TransferPlan::best_for(topology, &demands);
    Ok(Speedups {
        one_gpu_ms: one_gpu_s * 1e3,
        gather_first: [
            full(ScheduleKind::Direct, &whole)?,
            full(ScheduleKind::FatTree, &whole)?,
            full(ScheduleKind::Ring, &whole)?,
            full(ScheduleKind::Best, &whole)?,
        ],
        full: [
            full(ScheduleKind::FatTree, &blocks)?,
            full(ScheduleKind::Ring, &blocks)?,
            full(ScheduleKind::Best, &blocks)?,
        ],
        halo: one_gpu_s / modeled(&halo, &halves, &vec![Vec::new(); ranks])?,
    })
}
