//! The hybrid table of `loomtree bench time`: of a number of ranks in all, how many segments of how many workers each.

use std::path::{Path, PathBuf};

use super::table::FigureTable;
use crate::cli::CliError;
use crate::cli::predict::RecordedRun;
use crate::interconnect::{KernelTimes, Replay, ReplayedStep, ScheduleKind, Topology, plan};
use crate::time_parallel::{Costs, Method};

/// Bytes of a sub-vector's row on a link.
const ROW_BYTES: f64 = 12.0;

/// What splitting a step over workers gains on a machine.
struct Space {
    workers: usize,
    /// The step on one device over the step on `workers`, from recorded steps that are played on the machine.
    speedup: f64,
    /// Largest memory of a rank, bytes.
    memory_bytes: f64,
}

impl Space {
    fn of(run: &Path, machine: &Topology) -> Result<Space, CliError> {
        let recorded = RecordedRun::read(run)?;
        let topology = machine.with_first_gpus(recorded.ranks).map_err(CliError::bad_input)?;
        let rows = recorded.rows()?;
        let plan = plan(ScheduleKind::Auto, &topology, rows.div_ceil(recorded.ranks) as f64 * ROW_BYTES)
            .map_err(CliError::bad_input)?;
        let how = Replay {
            topology: &topology,
            plan: &plan,
            exchange: recorded.exchange(),
            kernels: KernelTimes::Device,
            rows,
        };
        let steps = recorded.replay(&how)?;
        let sum = |seconds: fn(&ReplayedStep) -> f64| steps.iter().map(seconds).sum::<f64>();
        let memory = recorded.report.steps.iter().flat_map(|step| &step.memory_bytes_per_rank);
        Ok(Space {
            workers: recorded.ranks,
            speedup: sum(|step| step.one_gpu_s) / sum(|step| step.total_s),
            memory_bytes: memory.copied().max().unwrap_or(0) as f64,
        })
    }
}

/// Columns of the table.
const COLUMNS: [&str; 8] = ["ranks", "segments", "workers", "speedup", "space_speedup", "memory_gb", "fits", "fastest"];

/// A shot to be split.
pub(super) struct Shot<'a> {
    /// Seconds of its steps on one worker, and those of its coarse run, which keeps one worker.
    pub costs: Costs,
    pub method: Method,
    /// Numbers of ranks in all.
    pub ranks: &'a [usize],
}

/// The table. `runs`: recorded runs on several workers each.
pub(super) fn table(
    shot: &Shot<'_>,
    measured: &str,
    machine: &Topology,
    runs: &[PathBuf],
) -> Result<FigureTable, CliError> {
    let mut spaces = vec![Space { workers: 1, speedup: 1.0, memory_bytes: 0.0 }];
    for run in runs {
        let space = Space::of(run, machine)?;
        if spaces.iter().any(|known| known.workers == space.workers && space.workers > 1) {
            let what = format!("{}: another run of --ranks has {} workers, too", run.display(), space.workers);
            return Err(CliError::bad_input(what));
        }
        match space.workers {
            1 => spaces[0] = space,
            _ => spaces.push(space),
        }
    }
    if spaces[0].memory_bytes == 0.0 {
        // One worker holds what several hold together, or less, since they hold some rows twice.
        let all = spaces.iter().map(|space| space.memory_bytes * space.workers as f64);
        spaces[0].memory_bytes = all.fold(0.0, f64::max);
    }
    let costs = &shot.costs;
    let limit_bytes = machine.device().memory_gb * 1e9;
    let title = format!(
        "modelled, not measured: segments x workers for a shot of {} steps from measured steps of {measured}; steps on \
         several workers are recorded ones played on {} ({}, {} GB)",
        costs.fine.len(),
        machine.name(),
        machine.device().name,
        machine.device().memory_gb,
    );
    let mut table = FigureTable::modeled("time_hybrid", title, COLUMNS.to_vec());
    for &ranks in shot.ranks {
        let mut rows: Vec<Vec<f64>> = Vec::new();
        for space in spaces.iter().filter(|space| ranks.is_multiple_of(space.workers)) {
            let processes = ranks / space.workers;
            let fine = costs.fine.iter().map(|seconds| seconds / space.speedup).collect();
            let split = Costs { fine, ..costs.clone() };
            // The played speed-up is over one process, which is the step on `workers` ranks here.
            let over_one = if processes == 1 { 1.0 } else { split.play(processes, &shot.method).speedup };
            let fits = f64::from(space.memory_bytes <= limit_bytes);
            rows.push(vec![
                ranks as f64,
                processes as f64,
                space.workers as f64,
                over_one * space.speedup,
                space.speedup,
                space.memory_bytes / 1e9,
                fits,
                0.0,
            ]);
        }
        let speed = |row: &Vec<f64>| if row[6] > 0.0 { row[3] } else { 0.0 };
        if let Some(best) = rows.iter_mut().max_by(|a, b| speed(a).total_cmp(&speed(b))) {
            best[7] = 1.0;
        }
        rows.into_iter().for_each(|row| table.push(row));
    }
    Ok(table)
}
