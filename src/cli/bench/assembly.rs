//! `loomtree bench assembly`: time of the two fills of the matrix with real worker processes, P-Cloth's Fig. 7 [Li et al.
//! 2020]. Everything here is measured. The elastic Index Table is filled in the first step only (docs/papers.md, D12), so
//! what index fill costs in later steps is the table of that step's contacts.

use super::runs::{Runs, SceneBench};
use super::table::FigureTable;
use crate::cli::CliError;
use crate::output::StepRecord;

pub(super) fn run(bench: &SceneBench) -> Result<(), CliError> {
    let (size, all) = bench.run()?;
    let title = format!("measured: assembly per step, {}", bench.title(size));
    let columns = vec![
        "workers",
        "elements_ms",
        "index_fill_ms",
        "value_fill_ms",
        "assembly_ms",
        "speedup",
        "share_of_step_percent",
        "contacts",
    ];
    let mut table = FigureTable::new(bench.name("assembly"), title, columns);
    let base = all.first().map_or(f64::NAN, |runs| runs.median(assembly));
    for runs in &all {
        table.push(row(runs, base));
    }
    table.finish(bench.settings.common.out.as_deref(), Some(("workers", "speedup")))
}

/// Seconds of element records and both fills, of the slowest rank.
fn assembly(step: &StepRecord) -> f64 {
    let stages = &step.stage_seconds;
    stages.elements + stages.index_fill + stages.value_fill
}

fn row(runs: &Runs, base: f64) -> Vec<f64> {
    let median = runs.median(assembly);
    vec![
        runs.workers as f64,
        runs.median(|step| step.stage_seconds.elements) * 1e3,
        runs.median(|step| step.stage_seconds.index_fill) * 1e3,
        runs.median(|step| step.stage_seconds.value_fill) * 1e3,
        median * 1e3,
        base / median,
        100.0 * runs.mean(assembly) / runs.mean(|step| step.stage_seconds.total),
        runs.mean(|step| step.contacts as f64),
    ]
}
