//! `loomtree bench step` and `bench memory`: whole steps with real worker processes. P-Cloth's counterparts: Figs. 11 and 14
//! (shares of the stages, speed-up), Fig. 13 (memory) [Li et al. 2020].

use super::runs::{Runs, SceneBench, Size};
use super::table::FigureTable;
use crate::cli::CliError;
use crate::output::StepRecord;

/// Time of whole steps, and the share of every stage.
pub(super) fn time(bench: &SceneBench) -> Result<(), CliError> {
    let (size, all) = bench.run()?;
    let out = bench.settings.common.out.as_deref();
    step_table(bench, size, &all).finish(out, Some(("workers", "speedup")))?;
    stage_table(bench, &all).finish(out, None)
}

/// Memory of the workers.
pub(super) fn memory(bench: &SceneBench) -> Result<(), CliError> {
    let (size, all) = bench.run()?;
    let table = memory_table(bench, size, &all);
    table.finish(bench.settings.common.out.as_deref(), Some(("workers", "device_bytes_per_vertex")))
}

fn total(step: &StepRecord) -> f64 {
    step.stage_seconds.total
}

fn step_table(bench: &SceneBench, size: Size, all: &[Runs]) -> FigureTable {
    let columns =
        vec!["workers", "step_ms", "solve_ms", "iterations", "us_per_triangle", "speedup", "bytes_per_spmv", "start_s"];
    let mut table = FigureTable::new(bench.name("step"), bench.title(size), columns);
    let base = all.first().map_or(f64::NAN, |runs| runs.median(total));
    for runs in all {
        let step = runs.median(total);
        table.push(vec![
            runs.workers as f64,
            step * 1e3,
            runs.median(|step| step.stage_seconds.solve) * 1e3,
            runs.mean(|step| step.iterations as f64),
            step * 1e6 / size.triangles as f64,
            base / step,
            runs.steps.last().map_or(f64::NAN, |step| step.bytes_per_spmv as f64),
            runs.start_s,
        ]);
    }
    table
}

/// Percent of a step's time in the slowest rank's stages; what is left is waiting and the coordinator.
fn stage_table(bench: &SceneBench, all: &[Runs]) -> FigureTable {
    let columns = vec![
        "workers",
        "proximity",
        "contacts",
        "exchange",
        "elements",
        "index",
        "values",
        "solve",
        "advance",
        "positions",
        "ccd",
        "zones",
    ];
    let title = format!("Share of the stages, percent of the step: {}", bench.scene.display());
    let mut table = FigureTable::new(bench.name("stages"), title, columns);
    for runs in all {
        let whole = runs.mean(total);
        let share = |stage: fn(&StepRecord) -> f64| 100.0 * runs.mean(stage) / whole;
        table.push(vec![
            runs.workers as f64,
            share(|step| step.stage_seconds.proximity),
            share(|step| step.stage_seconds.contacts),
            share(|step| step.stage_seconds.exchange),
            share(|step| step.stage_seconds.elements),
            share(|step| step.stage_seconds.index_fill),
            share(|step| step.stage_seconds.value_fill),
            share(|step| step.stage_seconds.solve),
            share(|step| step.stage_seconds.advance),
            share(|step| step.stage_seconds.positions),
            share(|step| step.stage_seconds.continuous),
            share(|step| step.stage_seconds.zones),
        ]);
    }
    table
}

fn memory_table(bench: &SceneBench, size: Size, all: &[Runs]) -> FigureTable {
    let columns = vec![
        "workers",
        "device_bytes",
        "device_bytes_per_vertex",
        "collision_tables_of_a_rank",
        "collision_mesh_of_a_rank",
        "peak_resident_bytes",
        "peak_resident_of_a_rank",
        "peak_resident_per_vertex",
    ];
    let mut table = FigureTable::new(bench.name("memory"), bench.title(size), columns);
    let largest = |bytes: &[u64]| bytes.iter().copied().max().unwrap_or(0) as f64;
    for runs in all {
        let device = runs.most(|step| step.memory_bytes_per_rank.iter().sum::<u64>() as f64);
        let resident = runs.most(|step| step.resident_bytes_per_rank.iter().sum::<u64>() as f64);
        table.push(vec![
            runs.workers as f64,
            device,
            device / size.vertices as f64,
            runs.most(|step| largest(&step.proximity.bytes_per_rank).max(largest(&step.continuous.bytes_per_rank))),
            runs.most(|step| largest(&step.collision_mesh_bytes_per_rank)),
            resident,
            runs.most(|step| largest(&step.resident_bytes_per_rank)),
            resident / size.vertices as f64,
        ]);
    }
    table
}
