//! `loomtree bench scaling`: whole steps on more and more worker processes, P-Cloth's Figs. 14 and 17 [Li et al. 2020]:
//! strong (the same cloth for all) and weak (as many triangles per worker). Everything here is measured, on processes that
//! share this machine; what other machines would make of it says `loomtree predict`.

use super::CliError;
use super::runs::{SceneBench, Size};
use super::table::Table;

pub fn run(bench: &SceneBench) -> Result<(), CliError> {
    let out = bench.common.out.as_deref();
    let (size, all) = bench.run()?;
    let mut strong = Table::new(
        "scaling_strong",
        format!("measured: strong scaling of a step, {}", bench.title(size)),
        vec!["workers", "step_ms", "solve_ms", "iterations", "speedup", "efficiency"],
    );
    let total = |step: &crate::output::StepRecord| step.stage_seconds.total;
    let base = all.first().map_or((1.0, f64::NAN), |runs| (runs.workers as f64, runs.median(total)));
    for runs in &all {
        let (workers, step_s) = (runs.workers as f64, runs.median(total));
        let speedup = base.1 / step_s;
        let solve_ms = runs.median(|step| step.stage_seconds.solve) * 1e3;
        let iterations = runs.mean(|step| step.iterations as f64);
        strong.push(vec![workers, step_s * 1e3, solve_ms, iterations, speedup, speedup * base.0 / workers]);
    }
    strong.finish(out, Some(("workers", "speedup")))?;
    weak(bench)?.finish(out, Some(("workers", "efficiency_per_iteration")))
}

/// Larger cloth needs more iterations, so the time of an iteration stands beside the time of a step.
fn weak(bench: &SceneBench) -> Result<Table, CliError> {
    let title = format!(
        "measured: weak scaling of a step, {}: {} triangles asked for per worker, {} thread(s) per worker",
        bench.scene.display(),
        bench.resolution,
        bench.common.threads
    );
    let columns =
        vec!["workers", "triangles", "step_ms", "iterations", "iteration_ms", "efficiency", "efficiency_per_iteration"];
    let mut table = Table::new("scaling_weak", title, columns);
    let mut base = None;
    for &workers in &bench.workers {
        let resolution = bench.resolution.saturating_mul(workers as u64);
        let one = SceneBench { workers: vec![workers], resolution, ..bench.clone() };
        let (Size { triangles, .. }, all) = one.run()?;
        for runs in &all {
            let step_s = runs.median(|step| step.stage_seconds.total);
            let iterations = runs.mean(|step| step.iterations as f64);
            let iteration_s = runs.median(|step| step.stage_seconds.solve / step.iterations.max(1) as f64);
            let (base_step_s, base_iteration_s) = *base.get_or_insert((step_s, iteration_s));
            table.push(vec![
                workers as f64,
                triangles as f64,
                step_s * 1e3,
                iterations,
                iteration_s * 1e3,
                base_step_s / step_s,
                base_iteration_s / iteration_s,
            ]);
        }
    }
    Ok(table)
}
