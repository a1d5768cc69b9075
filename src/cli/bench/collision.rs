//! `loomtree bench collision`: time, tests and their even split, zones, with real worker processes. P-Cloth's counterparts:
//! Figs. 10 and 12 [Li et al. 2020].

use super::runs::{Runs, SceneBench, Size};
use super::table::FigureTable;
use crate::cli::CliError;
use crate::output::{QueryRecord, StepRecord};

/// Prints the tables of collision detection and of impact zones for a scene.
pub(super) fn run(bench: &SceneBench) -> Result<(), CliError> {
    let (size, all) = bench.run()?;
    let out = bench.settings.common.out.as_deref();
    collision_table(bench, size, &all).finish(out, Some(("workers", "speedup")))?;
    zone_table(bench, &all).finish(out, None)
}

fn collision_s(step: &StepRecord) -> f64 {
    let s = &step.stage_seconds;
    s.proximity + s.contacts + s.positions + s.continuous + s.zones
}

/// Largest over mean of the tests of the ranks.
fn imbalance(query: &QueryRecord) -> f64 {
    let most = query.tests_per_rank.iter().copied().max().unwrap_or(0) as f64;
    if query.total.tests == 0 { 1.0 } else { most * query.tests_per_rank.len() as f64 / query.total.tests as f64 }
}

/// The part of the patches of triangles that culling did not leave out.
fn searched(step: &StepRecord) -> f64 {
    let [some, all] =
        [0, 1].map(|which| (step.proximity.total.patches[which] + step.continuous.total.patches[which]) as f64);
    if all > 0.0 { some / all } else { 1.0 }
}

fn collision_table(bench: &SceneBench, size: Size, all: &[Runs]) -> FigureTable {
    let columns = vec![
        "workers",
        "proximity_ms",
        "ccd_ms",
        "zones_ms",
        "all_ms",
        "us_per_triangle",
        "speedup",
        "tests",
        "worst_max_over_mean",
        "searched_part",
        "pairs",
        "contacts",
        "bytes_of_a_rank",
    ];
    let mut table = FigureTable::new(bench.name("collision"), bench.title(size), columns);
    let base = all.first().map_or(f64::NAN, |runs| runs.median(collision_s));
    for runs in all {
        let seconds = runs.median(collision_s);
        let largest = |query: &QueryRecord| query.bytes_per_rank.iter().copied().max().unwrap_or(0) as f64;
        table.push(vec![
            runs.workers as f64,
            runs.median(|step| step.stage_seconds.proximity) * 1e3,
            runs.median(|step| step.stage_seconds.continuous) * 1e3,
            runs.median(|step| step.stage_seconds.zones) * 1e3,
            seconds * 1e3,
            seconds * 1e6 / size.triangles as f64,
            base / seconds,
            runs.mean(|step| (step.proximity.total.tests + step.continuous.total.tests) as f64),
            runs.most(|step| imbalance(&step.proximity).max(imbalance(&step.continuous))),
            runs.mean(searched),
            runs.mean(|step| (step.proximity.total.pairs + step.continuous.total.pairs) as f64),
            runs.mean(|step| step.contacts as f64),
            runs.most(|step| largest(&step.proximity).max(largest(&step.continuous))),
        ]);
    }
    table
}

/// Number of steps per number of rounds. The counts are the same for every number of workers; those of the first are
/// shown.
fn zone_table(bench: &SceneBench, all: &[Runs]) -> FigureTable {
    let columns = vec!["rounds", "steps", "zones", "largest_zone", "impacts", "iterations", "fail_safes", "halvings"];
    let title = format!("Rounds of continuous detection and impact zones: {}", bench.scene.display());
    let mut table = FigureTable::new(bench.name("zones"), title, columns);
    let Some(runs) = all.first() else { return table };
    let most = runs.most(|step| step.zones.rounds as f64) as u32;
    for rounds in 0..=most {
        let steps: Vec<&StepRecord> = runs.steps.iter().filter(|step| step.zones.rounds == rounds).collect();
        if steps.is_empty() {
            continue;
        }
        let sum = |figure: fn(&StepRecord) -> u64| steps.iter().map(|step| figure(step)).sum::<u64>() as f64;
        table.push(vec![
            rounds as f64,
            steps.len() as f64,
            sum(|step| step.zones.zones),
            steps.iter().map(|step| step.zones.largest).max().unwrap_or(0) as f64,
            sum(|step| step.zones.impacts),
            sum(|step| step.zones.iterations),
            sum(|step| step.zones.fail_safes),
            sum(|step| u64::from(step.zones.halvings)),
        ]);
    }
    table
}
