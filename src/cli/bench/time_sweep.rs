//! The tables of `loomtree bench time --sweep`: one figure varies in place of the number of processes.

use clap::ValueEnum;

use super::table::FigureTable;
use super::time_levels::Recorded;
use super::time_play::{COLUMNS, Rule, ShotArgs};
use crate::time_parallel::Costs;

/// What varies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Sweep {
    /// Length of the shot: 1/8 to 8 times --steps
    Seconds,
    /// Length of a coarse step: 1/2 to 8 times the recorded one, if its cost did not change with it
    StepRatio,
    /// Triangles of the fine mesh: 1/16, 1/4 and all of --resolution, each with runs of its own
    Resolution,
    /// The rules for the cuts
    Partition,
}

/// Triangles of the fine meshes below `finest` that a sweep by resolution measures, ascending.
pub(super) fn coarser_resolutions(finest: u64) -> impl Iterator<Item = u64> {
    [16, 4].into_iter().map(move |divisor| (finest / divisor).max(1))
}

/// A table with the columns of the one by processes, after a first one with what varies.
fn empty(shot: &ShotArgs, recorded: &Recorded, [name, head]: [&'static str; 2], note: &str) -> FigureTable {
    let costs = recorded.shot(u64::from(shot.steps), 1.0);
    FigureTable::modeled(name, shot.title(recorded, &costs) + note, [&[head][..], &COLUMNS].concat())
}

/// Adds the row of a value: the shot with the largest number of processes.
fn push(table: &mut FigureTable, shot: &ShotArgs, value: f64, (recorded, costs): (&Recorded, &Costs), rule: Rule) {
    let processes = shot.processes.iter().copied().max().unwrap_or(2);
    let (_, row) = shot.row(costs, processes, &shot.method_with(recorded, rule));
    table.push([vec![value], row].concat());
}

/// The table of a sweep. `by_size`: pairs of runs on meshes of several sizes, ascending; all sweeps but that by
/// resolution look at the last one alone.
pub(super) fn table(shot: &ShotArgs, by_size: &[Recorded], sweep: Sweep) -> FigureTable {
    let finest = by_size.last().expect("a pair of runs");
    let steps = u64::from(shot.steps);
    match sweep {
        Sweep::Seconds => {
            let mut table = empty(shot, finest, ["time_seconds", "steps"], "");
            for power in -3..=3 {
                let steps = ((steps as f64 * 2f64.powi(power)).round() as u64).max(2);
                push(&mut table, shot, steps as f64, (finest, &finest.shot(steps, 1.0)), shot.partition);
            }
            table
        }
        Sweep::StepRatio => {
            let mut table = empty(shot, finest, ["time_step_ratio", "step_ratio"], "");
            for power in -1..=3 {
                let stretch = 2f64.powi(power);
                let ratio = finest.costs.stride as f64 * stretch;
                push(&mut table, shot, ratio, (finest, &finest.shot(steps, stretch)), shot.partition);
            }
            table
        }
        Sweep::Resolution => {
            let shots: Vec<Costs> = by_size.iter().map(|recorded| recorded.shot(steps, 1.0)).collect();
            let ratios: Vec<String> = shots.iter().map(|costs| format!("{:.1}", costs.ratio())).collect();
            let note = format!("; K from the coarsest on: {}", ratios.join(", "));
            let mut table = empty(shot, finest, ["time_resolution", "triangles"], &note);
            for (recorded, costs) in by_size.iter().zip(&shots) {
                push(&mut table, shot, recorded.triangles as f64, (recorded, costs), shot.partition);
            }
            table
        }
        Sweep::Partition => {
            let rules = Rule::value_variants();
            let names = rules.iter().enumerate().map(|(i, rule)| format!("{i} = {rule:?}").to_lowercase());
            let note = format!("; rules: {}", names.collect::<Vec<_>>().join(", "));
            let mut table = empty(shot, finest, ["time_partition", "rule"], &note);
            let costs = finest.shot(steps, 1.0);
            rules.iter().enumerate().for_each(|(i, &rule)| push(&mut table, shot, i as f64, (finest, &costs), rule));
            table
        }
    }
}
