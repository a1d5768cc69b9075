//! Solves zones: min sum(m |d|^2) / 2 over the displacements d subject to the rows, by accelerated descent on the multipliers.
//!
//! d = M^-1 A^T y follows from the multipliers y in closed form, so a step is: gather d per vertex; per row
//! y' = max(0, y + (target - A d) / bound), the multiplier update of the augmented Lagrangian method with its quadratic
//! term bounded from above by a diagonal one (`bound` is a row sum of |A M^-1 A^T|); extrapolate. Every iterate is a sum of
//! internal forces, so linear momentum is kept whenever it stops. One workgroup per zone; nothing is added by atomics.
//!
//! Promises nothing about rows that contradict each other: it stops at the limit on iterations.

use std::sync::Mutex;

use super::problem::{Batch, Row, ZoneSpan};
use super::solve_cpu;
use crate::gpu::{DeviceVec, Executor, GpuExecutor, GpuStruct, KernelSource, ReadBatch, gpu_struct};

static SOLVE: KernelSource =
    KernelSource::new::<SolveParams>("impact_zone/solve.wgsl", include_str!("solve.wgsl"), "solve").with_structs(&[
        DeviceZone::LAYOUT,
        DeviceVertex::LAYOUT,
        DeviceRow::LAYOUT,
        Multipliers::LAYOUT,
        DeviceStatus::LAYOUT,
    ]);

/// Invocations per workgroup, as in the shader.
const LANES: u64 = 64;
/// Loop turns of an invocation in one dispatch at most; software drivers end loops silently above 65,535.
const TURNS: u64 = 50_000;

gpu_struct! {
    struct SolveParams { zones: u32, iterations: u32 }
}
gpu_struct! {
    struct DeviceZone { first_vertex: u32, vertices: u32, first_row: u32, rows: u32, tolerance: f32 }
}
gpu_struct! {
    struct DeviceVertex { inverse_mass: f32, first_entry: u32, end_entry: u32 }
}
gpu_struct! {
    struct DeviceRow { normal: [f32; 3], value: f32, weights: [f32; 4], vertices: [u32; 4], bound: f32, pad: [f32; 3] }
}
gpu_struct! {
    struct Multipliers { held: f32, tried: f32, next: f32 }
}
gpu_struct! {
    struct DeviceStatus { momentum: f32, iterations: u32, converged: u32 }
}

/// What a zone's solve gave.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ZoneResult {
    /// Displacement of every vertex, metres.
    pub displacements: Vec<[f64; 3]>,
    /// Multiplier of every row of the zone, to go on from.
    pub multipliers: Vec<f64>,
    /// Iterations made.
    pub iterations: u32,
    /// True if no constraint was off by more than the tolerance.
    pub converged: bool,
}

/// Solves all zones of `batch`, each with at most `iterations` iterations. On a device in f32; its result is for
/// [`Executor::take_fault`] to confirm.
pub fn solve(executor: &Executor, batch: &Batch, iterations: u32) -> Vec<ZoneResult> {
    match executor {
        Executor::Cpu(cpu) => {
            let results = Mutex::new(vec![ZoneResult::default(); batch.zones.len()]);
            cpu.for_ranges(batch.zones.len(), 1, |range| {
                for zone in range {
                    let result = native(batch, zone, iterations);
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

fn native(batch: &Batch, zone: usize, iterations: u32) -> ZoneResult {
    solve_cpu::solve(&batch.zones[zone], batch.tolerances[zone], &batch.inverse_masses, &batch.rows, iterations)
}

/// Most loop turns of an invocation per iteration, over the zone's invocations; bounded by what the busiest vertices of
/// each pass cost.
fn turns_per_iteration(batch: &Batch, zone: &ZoneSpan) -> u64 {
    let range = zone.vertex_range();
    let entries = |v: usize| u64::from(batch.gather_offsets[v + 1] - batch.gather_offsets[v]);
    let gathers: u64 = range
        .clone()
        .step_by(LANES as usize)
        .map(|first| 1 + (first..range.end.min(first + LANES as usize)).map(entries).max().unwrap_or(0))
        .sum();
    // One turn for the iteration, one per halving of the workgroup in the reduction.
    gathers + 2 * u64::from(zone.rows).div_ceil(LANES) + 1 + u64::from(LANES.ilog2())
}

fn on_device(executor: &Executor, gpu: &GpuExecutor, batch: &Batch, iterations: u32) -> Vec<ZoneResult> {
    if batch.zones.is_empty() {
        return Vec::new();
    }
    // A dispatch ends with one more gather. Which zones are too large for it must not depend on the others in the batch.
    let turns: Vec<u64> = batch.zones.iter().map(|zone| turns_per_iteration(batch, zone)).collect();
    let too_large = |zone: usize| 2 * turns[zone] > TURNS;
    let most = (0..turns.len()).filter(|&zone| !too_large(zone)).map(|zone| turns[zone]).max().unwrap_or(1);
    let per_dispatch = TURNS / most - 1;
    let mut zones: Vec<DeviceZone> = batch.zones.iter().zip(&batch.tolerances).map(device_zone).collect();
    for zone in (0..zones.len()).filter(|&zone| too_large(zone)) {
        zones[zone] = DeviceZone { vertices: 0, rows: 0, ..zones[zone] };
    }
    let zones = DeviceVec::upload(executor, &zones);
    let vertices: Vec<DeviceVertex> = batch
        .inverse_masses
        .iter()
        .zip(batch.gather_offsets.windows(2))
        .map(|(&m, w)| DeviceVertex { inverse_mass: m as f32, first_entry: w[0], end_entry: w[1] })
        .collect();
    let vertices = DeviceVec::upload(executor, &vertices);
    let gather = DeviceVec::upload(executor, &batch.gather);
    let rows: Vec<DeviceRow> = batch.rows.iter().map(device_row).collect();
    let rows = DeviceVec::upload(executor, &rows);
    let begin = |row: &Row| Multipliers { held: row.start as f32, tried: row.start as f32, next: 0.0 };
    let mut last: Vec<Multipliers> = batch.rows.iter().map(begin).collect();
    let mut multipliers = DeviceVec::upload(executor, &last);
    let mut displacements = DeviceVec::<[f32; 3]>::zeros(executor, batch.inverse_masses.len());
    let start = DeviceStatus { momentum: 1.0, iterations: 0, converged: 0 };
    let mut status = DeviceVec::upload(executor, &vec![start; batch.zones.len()]);
    let mut left = u64::from(iterations);
    while left > 0 {
        let now = left.min(per_dispatch);
        let bindings = [
            zones.binding(),
            vertices.binding(),
            gather.binding(),
            rows.binding(),
            multipliers.binding_mut(),
            displacements.binding_mut(),
            status.binding_mut(),
        ];
        let params = SolveParams { zones: batch.zones.len() as u32, iterations: now as u32 };
        gpu.run(&SOLVE, &bindings, &params, batch.zones.len() as u64 * LANES);
        left -= now;
    }
    let mut found = vec![[0.0f32; 3]; displacements.len()];
    let mut ended = vec![start; batch.zones.len()];
    let mut reads = ReadBatch::new();
    reads.add(&displacements, 0, &mut found);
    reads.add(&multipliers, 0, &mut last);
    reads.add(&status, 0, &mut ended);
    reads.finish(executor);
    let result = |zone: usize| {
        if too_large(zone) {
            return native(batch, zone, iterations);
        }
        ZoneResult {
            displacements: found[batch.zones[zone].vertex_range()].iter().map(|d| d.map(f64::from)).collect(),
            multipliers: last[batch.zones[zone].row_range()].iter().map(|m| f64::from(m.held)).collect(),
            iterations: ended[zone].iterations,
            converged: ended[zone].converged != 0,
        }
    };
    (0..batch.zones.len()).map(result).collect()
}

fn device_zone((zone, &tolerance): (&ZoneSpan, &f64)) -> DeviceZone {
    DeviceZone {
        first_vertex: zone.first_vertex,
        vertices: zone.vertices,
        first_row: zone.first_row,
        rows: zone.rows,
        tolerance: tolerance as f32,
    }
}

fn device_row(row: &Row) -> DeviceRow {
    DeviceRow {
        normal: row.normal.map(|x| x as f32),
        value: row.target as f32,
        weights: row.weights.map(|w| w as f32),
        vertices: row.vertices,
        bound: row.bound as f32,
        pad: [0.0; 3],
    }
}
