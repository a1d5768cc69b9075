//! `loomtree bench scaling`: whole steps on more and more worker processes, P-Cloth's Figs. 14 and 17 [Li et al. 2020]:
//! strong (the same cloth for all) and weak (as many triangles per worker). Columns called measured come from processes that
//! share this machine; columns called modeled from the events of a run of the same steps, re-timed on the machine of a
//! topology file as `loomtree predict` does it.

use std::path::PathBuf;

use super::common::{machine, median};
use super::runs::{Runs, SceneBench, ScenesBench, Size};
use super::table::FigureTable;
use crate::cli::CliError;
use crate::coordinator::Launch;
use crate::interconnect::Topology;

/// Arguments of `loomtree bench scaling`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ScalingBench {
    #[command(flatten)]
    scenes: ScenesBench,
    /// Machine of the modeled columns, with schedule best [default: Titan Xp on a balanced tree of PCIe 3 x16 links];
    /// more workers than it has GPUs are not modeled
    #[arg(long, value_name = "FILE")]
    topology: Option<PathBuf>,
}

pub(super) fn run(bench: &ScalingBench, launch: &Launch) -> Result<(), CliError> {
    let most = bench.scenes.settings.workers.iter().copied().max().unwrap_or(1);
    let machine = machine(bench.topology.as_deref(), most)?;
    bench.scenes.each(launch)?.iter().try_for_each(|scene| of_scene(scene, &machine))
}

fn of_scene(scene: &SceneBench, machine: &Topology) -> Result<(), CliError> {
    let out = scene.settings.common.out.as_deref();
    let curves = ["measured_speedup", "modelled_speedup"];
    strong(scene, machine)?.finish_curves(out, Some(("workers", &curves)))?;
    let curves = ["measured_efficiency", "measured_efficiency_per_iteration", "modelled_efficiency_per_iteration"];
    weak(scene, machine)?.y_label("efficiency").finish_curves(out, Some(("workers", &curves)))
}

fn strong(bench: &SceneBench, machine: &Topology) -> Result<FigureTable, CliError> {
    let (size, all) = bench.run()?;
    let title = format!("strong scaling of a step, {}; modelled: {}", bench.title(size), name(machine));
    let columns = vec![
        "workers",
        "measured_step_ms",
        "measured_solve_ms",
        "iterations",
        "measured_speedup",
        "measured_efficiency",
        "modelled_step_ms",
        "modelled_speedup",
        "modelled_efficiency",
    ];
    let mut table = FigureTable::mixed(bench.name("scaling_strong"), title, columns);
    let mut base = None;
    for runs in &all {
        let (workers, step_s, modeled_s) = (runs.workers as f64, step_s(runs), modeled_s(bench, runs, machine)?);
        let (base_workers, base_s, base_modeled_s) = *base.get_or_insert((workers, step_s, modeled_s));
        let (speedup, modeled_speedup) = (base_s / step_s, base_modeled_s / modeled_s);
        let share = base_workers / workers;
        table.push(vec![
            workers,
            step_s * 1e3,
            runs.median(|step| step.stage_seconds.solve) * 1e3,
            runs.mean(|step| step.iterations as f64),
            speedup,
            speedup * share,
            modeled_s * 1e3,
            modeled_speedup,
            modeled_speedup * share,
        ]);
    }
    Ok(table)
}

/// Larger cloth needs more iterations, so the time of an iteration stands beside the time of a step.
fn weak(bench: &SceneBench, machine: &Topology) -> Result<FigureTable, CliError> {
    let title = format!(
        "weak scaling of a step, {}: {} triangles asked for per worker, {} thread(s) per worker; modelled: {}",
        bench.scene.display(),
        bench.settings.resolution,
        bench.settings.common.threads,
        name(machine)
    );
    let columns = vec![
        "workers",
        "triangles",
        "measured_step_ms",
        "iterations",
        "measured_iteration_ms",
        "measured_efficiency",
        "measured_efficiency_per_iteration",
        "modelled_step_ms",
        "modelled_efficiency",
        "modelled_efficiency_per_iteration",
    ];
    let mut table = FigureTable::mixed(bench.name("scaling_weak"), title, columns);
    let mut base = None;
    for &workers in &bench.settings.workers {
        let mut one = bench.clone();
        one.settings.workers = vec![workers];
        one.settings.resolution = bench.settings.resolution.saturating_mul(workers as u64);
        let (Size { triangles, .. }, all) = one.run()?;
        for runs in &all {
            let (step_s, modeled_s) = (step_s(runs), modeled_s(&one, runs, machine)?);
            let iterations = runs.mean(|step| step.iterations as f64);
            let iteration_s = runs.median(|step| step.stage_seconds.solve / step.iterations.max(1) as f64);
            let modeled_iteration_s = modeled_s / iterations.max(1.0);
            let now = [step_s, iteration_s, modeled_s, modeled_iteration_s];
            let first = *base.get_or_insert(now);
            let efficiency = |figure: usize| first[figure] / now[figure];
            table.push(vec![
                workers as f64,
                triangles as f64,
                step_s * 1e3,
                iterations,
                iteration_s * 1e3,
                efficiency(0),
                efficiency(1),
                modeled_s * 1e3,
                efficiency(2),
                efficiency(3),
            ]);
        }
    }
    Ok(table)
}

fn name(machine: &Topology) -> String {
    format!("{} of {}", machine.device().name, machine.name())
}

fn step_s(runs: &Runs) -> f64 {
    runs.median(|step| step.stage_seconds.total)
}

/// Median modeled step; NaN if the machine has too few GPUs.
fn modeled_s(bench: &SceneBench, runs: &Runs, machine: &Topology) -> Result<f64, CliError> {
    if runs.workers > machine.gpus() {
        return Ok(f64::NAN);
    }
    let topology = machine.with_first_gpus(runs.workers).map_err(CliError::bad_input)?;
    Ok(median(&mut bench.predict(runs.workers, &topology)?))
}
