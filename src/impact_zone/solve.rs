//! Solves zones: min sum(m |d|^2) / 2 over the displacements d subject to the rows, by descent on the multipliers.
//!
//! d = M^-1 A^T y follows from the multipliers y. A sweep gives one row after the other the multiplier
//! y' = max(0, y + (target - A d) / yielding) that closes its gap (projected Gauss-Seidel: the multiplier update of the
//! augmented Lagrangian method, row by row) and moves its vertices along. Most rows of a zone never act, so a sweep over all
//! rows is followed by some over those that do, with Nesterov's extrapolation, dropped where it points uphill. Rows of one
//! color share no vertex: a workgroup per zone does them at once, with a barrier after each color. Nothing is added by
//! atomics. What is returned is a sum of internal forces whenever it stops, so linear momentum is kept.
//!
//! Promises nothing about rows that contradict each other: it stops at the limit on iterations.

use std::sync::Mutex;

use super::problem::{Row, ZoneBatch, ZoneSpan};
use super::solve_cpu;
use crate::gpu::{DeviceVec, Executor, GpuExecutor, GpuStruct, KernelSource, ReadBatch, gpu_struct};

static SOLVE: KernelSource =
    KernelSource::new::<SolveParams>("impact_zone/solve.wgsl", include_str!("solve.wgsl"), "solve").with_structs(&[
        DeviceZone::LAYOUT,
        DeviceRow::LAYOUT,
        Multipliers::LAYOUT,
        Displacements::LAYOUT,
        DeviceStatus::LAYOUT,
    ]);

/// Invocations per workgroup, as in the shader.
const LANES: u64 = 64;
/// Loop turns of an invocation in one dispatch at most; software drivers end loops silently above 65,535.
const TURNS: u64 = 50_000;

/// Sweeps over the acting rows after each over all rows, at most; as in the shader.
pub(super) const MOST_INNER: u32 = 20;

gpu_struct! {
    struct SolveParams { zones: u32, iterations: u32 }
}
gpu_struct! {
    struct DeviceZone { first_vertex: u32, vertices: u32, first_row: u32, rows: u32, first_color: u32, colors: u32, tolerance: f32 }
}
gpu_struct! {
    struct DeviceRow { normal: [f32; 3], value: f32, weights: [f32; 4], vertices: [u32; 4], yielding: f32, pad: [f32; 3] }
}
gpu_struct! {
    struct Multipliers { now: f32, held: f32, working: u32 }
}
gpu_struct! {
    struct Displacements { now: [f32; 3], held: [f32; 3] }
}
gpu_struct! {
    struct DeviceStatus { momentum: f32, inner: u32, iterations: u32, converged: u32 }
}

/// Result of a zone's solve.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ZoneResult {
    /// Displacement of every vertex, meters.
    pub displacements: Vec<[f64; 3]>,
    /// Multiplier of every row of the zone that moves anything, in the order they were given, to go on from.
    pub multipliers: Vec<f64>,
    /// Number of sweeps made.
    pub iterations: u32,
    /// True if the last sweep over all rows changed no gap by more than the tolerance.
    pub converged: bool,
}

/// Solves all zones of `batch`, each in at most `iterations` sweeps. On a device in f32; its result is for
/// [`Executor::take_fault`] to confirm.
pub fn solve(executor: &Executor, batch: &ZoneBatch, iterations: u32) -> Vec<ZoneResult> {
    match executor {
        Executor::Cpu(cpu) => {
            let results = Mutex::new(vec![ZoneResult::default(); batch.zones.len()]);
            cpu.for_ranges(batch.zones.len(), 1, |range| {
                for zone in range {
                    let result = solve_cpu::solve(batch, zone, iterations);
                    if let Ok(mut results) = results.lock() {
                        results[zone] = result;
                    }
                }
            });
            results.into_inner().unwrap_or_default()
        }
        Executor::Gpu(gpu) => on_device(executor, gpu, batch, iterations),
    }
}

/// Loop turns of an invocation per sweep at most.
fn turns_per_sweep(batch: &ZoneBatch, zone: &ZoneSpan) -> u64 {
    let colors = &batch.colors[zone.first_color as usize..=(zone.first_color + zone.colors) as usize];
    let of_color = |w: &[u32]| 1 + u64::from(w[1] - w[0]).div_ceil(LANES);
    let sweep: u64 = colors.windows(2).map(of_color).sum();
    // One turn for the sweep, one per halving of the workgroup in the reduction.
    sweep
        + u64::from(zone.rows).div_ceil(LANES)
        + u64::from(zone.vertices).div_ceil(LANES)
        + 1
        + u64::from(LANES.ilog2())
}

fn on_device(executor: &Executor, gpu: &GpuExecutor, batch: &ZoneBatch, iterations: u32) -> Vec<ZoneResult> {
    if batch.zones.is_empty() {
        return Vec::new();
    }
    // Which zones are too large for a dispatch must not depend on the others in the batch.
    let turns: Vec<u64> = batch.zones.iter().map(|zone| turns_per_sweep(batch, zone)).collect();
    let too_large = |zone: usize| turns[zone] > TURNS;
    let most = (0..turns.len()).filter(|&zone| !too_large(zone)).map(|zone| turns[zone]).max().unwrap_or(TURNS);
    let per_dispatch = TURNS / most;
    let mut zones: Vec<DeviceZone> = batch.zones.iter().zip(&batch.tolerances).map(device_zone).collect();
    for zone in (0..zones.len()).filter(|&zone| too_large(zone)) {
        zones[zone] = DeviceZone { vertices: 0, rows: 0, colors: 0, ..zones[zone] };
    }
    let zones = DeviceVec::upload(executor, &zones);
    let inverse_masses =
        DeviceVec::upload(executor, &batch.inverse_masses.iter().map(|&m| m as f32).collect::<Vec<_>>());
    let rows = DeviceVec::upload(executor, &batch.rows.iter().map(device_row).collect::<Vec<_>>());
    let colors = DeviceVec::upload(executor, &batch.colors);
    let mut last: Vec<Multipliers> = batch.rows.iter().map(begin).collect();
    let mut multipliers = DeviceVec::upload(executor, &last);
    let mut displacements = DeviceVec::upload(executor, &displacements_at_start(batch));
    let start = DeviceStatus { momentum: 1.0, inner: 0, iterations: 0, converged: 0 };
    let mut status = DeviceVec::upload(executor, &vec![start; batch.zones.len()]);
    let mut left = u64::from(iterations);
    while left > 0 {
        let now = left.min(per_dispatch);
        let bindings = [
            zones.binding(),
            inverse_masses.binding(),
            rows.binding(),
            colors.binding(),
            multipliers.binding_mut(),
            displacements.binding_mut(),
            status.binding_mut(),
        ];
        let params = SolveParams { zones: batch.zones.len() as u32, iterations: now as u32 };
        gpu.run(&SOLVE, &bindings, &params, batch.zones.len() as u64 * LANES);
        left -= now;
    }
    let mut ended = vec![start; batch.zones.len()];
    let mut reads = ReadBatch::new();
    reads.add(&multipliers, 0, &mut last);
    reads.add(&status, 0, &mut ended);
    reads.finish(executor);
    let result = |zone: usize| {
        if too_large(zone) {
            return solve_cpu::solve(batch, zone, iterations);
        }
        let span = &batch.zones[zone];
        let held: Vec<f64> = last[span.row_range()].iter().map(|m| f64::from(m.held)).collect();
        ZoneResult {
            displacements: batch.displacements(span, &held),
            multipliers: batch.as_given(span, &held),
            iterations: ended[zone].iterations,
            converged: ended[zone].converged != 0,
        }
    };
    (0..batch.zones.len()).map(result).collect()
}

fn begin(row: &Row) -> Multipliers {
    Multipliers { now: row.start as f32, held: row.start as f32, working: 0 }
}

/// Displacements of all zones' vertices that belong to the rows' first multipliers.
fn displacements_at_start(batch: &ZoneBatch) -> Vec<Displacements> {
    let of_zone = |zone: &ZoneSpan| {
        let start: Vec<f64> = batch.rows[zone.row_range()].iter().map(|row| row.start).collect();
        batch.displacements(zone, &start)
    };
    let narrow = |d: [f64; 3]| Displacements { now: d.map(|x| x as f32), held: d.map(|x| x as f32) };
    batch.zones.iter().flat_map(of_zone).map(narrow).collect()
}

fn device_zone((zone, &tolerance): (&ZoneSpan, &f64)) -> DeviceZone {
    DeviceZone {
        first_vertex: zone.first_vertex,
        vertices: zone.vertices,
        first_row: zone.first_row,
        rows: zone.rows,
        first_color: zone.first_color,
        colors: zone.colors,
        tolerance: tolerance as f32,
    }
}

fn device_row(row: &Row) -> DeviceRow {
    DeviceRow {
        normal: row.normal.map(|x| x as f32),
        value: row.target as f32,
        weights: row.weights.map(|w| w as f32),
        vertices: row.vertices,
        yielding: row.yielding as f32,
        pad: [0.0; 3],
    }
}
