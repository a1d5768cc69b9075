//! `loomtree bench table1`: the eleven benchmarks of P-Cloth's Table 1 [Li et al. 2020] with this project's scenes:
//! steps per second on 1, 2 and 4 workers (a frame is a time step there). Columns called measured come from processes
//! that share this machine, columns called modelled from the events of a run of the same steps, re-timed on the machine
//! of a topology file as `loomtree predict` does it, and columns called paper from their table.

use std::path::PathBuf;

use super::common::{Common, machine, median, worker_counts};
use super::runs::{SceneBench, Settings};
use super::sewn::sewn;
use super::table::FigureTable;
use crate::cli::CliError;
use crate::coordinator::Launch;
use crate::interconnect::Topology;
use crate::os::console::note;
use crate::scene::PreconditionerKind;
use crate::solver::ExchangeMode;

/// Numbers of workers of the table.
const WORKERS: [usize; 3] = [1, 2, 4];

/// A row of the paper's table.
#[derive(Clone, Copy, Debug)]
struct Benchmark {
    name: &'static str,
    /// The scene of this project, without its ending.
    scene: &'static str,
    triangles: u64,
    /// Steps per second of simulated time.
    steps_per_s: f64,
    /// Frames per second on 1, 2 and 4 Titan Xp.
    fps: [f64; 3],
}

const fn row(name: &'static str, scene: &'static str, triangles: u64, steps_per_s: f64, fps: [f64; 3]) -> Benchmark {
    Benchmark { name, scene, triangles, steps_per_s, fps }
}

/// [Li et al. 2020, Table 1], in its order.
const TABLE: [Benchmark; 11] = [
    row("Miku", "ruffles", 1_330_000, 1000.0, [0.48, 1.67, 2.59]),
    row("Andy", "three_pieces", 538_000, 1000.0, [0.86, 2.21, 4.87]),
    row("Flag", "flag", 1_200_000, 250.0, [1.17, 2.19, 5.45]),
    row("Sphere", "sphere", 700_000, 200.0, [0.76, 2.04, 4.21]),
    row("Funnel", "funnel", 550_000, 2000.0, [1.74, 2.87, 5.20]),
    row("Twisting", "twisting", 550_000, 2000.0, [1.71, 2.47, 3.72]),
    row("Sphere-1M", "sphere_1m", 1_000_000, 200.0, [0.23, 1.31, 2.11]),
    row("Kneel", "kneel", 1_650_000, 250.0, [0.61, 1.74, 2.48]),
    row("Princess", "princess", 510_000, 250.0, [1.23, 2.59, 5.12]),
    row("Zoey", "pleats", 569_000, 500.0, [0.38, 1.16, 2.04]),
    row("Kimono", "kimono", 1_000_000, 1000.0, [0.24, 0.58, 1.11]),
];

/// Arguments of `loomtree bench table1`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct Table1Bench {
    #[command(flatten)]
    common: Common,
    /// Folder of the scenes
    #[arg(long, value_name = "DIR", default_value = "scenes")]
    scenes: PathBuf,
    /// Triangles of each scene as a share of the paper's
    #[arg(long, default_value_t = 0.02, value_parser = share, conflicts_with = "resolution")]
    share: f64,
    /// Triangles of each scene, in place of a share of the paper's
    #[arg(long, value_parser = crate::cli::count)]
    resolution: Option<u64>,
    /// Benchmarks of the table, by name or scene, separated by commas [default: all]
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    only: Vec<String>,
    /// Numbers of worker processes: 1, 2 and 4, or some of them
    #[arg(long, value_delimiter = ',', default_value = "1,2,4", value_parser = worker_counts)]
    workers: Vec<usize>,
    /// Steps per run that are counted
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Steps before the counted ones
    #[arg(long, default_value_t = 2)]
    skip: u32,
    /// Rounds: every number of workers is run this many times, interleaved
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Steps as long as the scene has them, in place of the paper's
    #[arg(long)]
    own_steps: bool,
    /// Machine of the modelled columns, with schedule best [default: Titan Xp on a balanced tree of PCIe 3 x16 links]
    #[arg(long, value_name = "FILE")]
    topology: Option<PathBuf>,
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1.0 => Ok(value),
        _ => Err("expected a share above 0, up to 1".into()),
    }
}

/// Columns of figures of each kind, on 1, 2 and 4 workers.
const COLUMNS: [&str; 15] = [
    "triangles",
    "step_ms",
    "measured_fps_1",
    "measured_fps_2",
    "measured_fps_4",
    "contacts",
    "iterations",
    "modelled_fps_1",
    "modelled_fps_2",
    "modelled_fps_4",
    "paper_triangles",
    "paper_step_ms",
    "paper_fps_1",
    "paper_fps_2",
    "paper_fps_4",
];

pub(super) fn run(bench: &Table1Bench, launch: &Launch) -> Result<(), CliError> {
    let chosen = bench.chosen()?;
    if let Some(other) = bench.workers.iter().find(|workers| !WORKERS.contains(workers)) {
        return Err(CliError::bad_input(format!("--workers {other}: the table has columns for 1, 2 and 4 workers")));
    }
    let device = machine(bench.topology.as_deref(), bench.workers.iter().copied().max().unwrap_or(1))?;
    let size = match bench.resolution {
        Some(triangles) => format!("{triangles} triangles each"),
        None => format!("{} of the paper's triangles", bench.share),
    };
    let title = format!(
        "P-Cloth's Table 1 with scenes of this project, {size}: steps per second (a frame there is a time step), the mean \
         of {} steps after {}, {} thread(s) per worker; modelled: {} of {}; paper: theirs, means of whole animations",
        bench.steps,
        bench.skip,
        bench.common.threads,
        device.device().name,
        device.name()
    );
    let mut table = FigureTable::mixed("table1", title, COLUMNS.to_vec()).with_names("benchmark");
    let path = |benchmark: &Benchmark| bench.scenes.join(benchmark.scene).with_extension("toml");
    for benchmark in &chosen {
        crate::scene::read(&path(benchmark)).map_err(CliError::bad_input)?;
    }
    let mut without = Vec::new();
    for benchmark in &chosen {
        let scene = path(benchmark);
        note(format_args!("{}: {}", benchmark.name, scene.display()));
        let mut row = vec![f64::NAN; COLUMNS.len()];
        (row[10], row[11]) = (benchmark.triangles as f64, 1e3 / benchmark.steps_per_s);
        row[12..15].copy_from_slice(&benchmark.fps);
        // Hours may have gone into the rows before this one.
        if let Err(error) = bench.measure(benchmark, scene, &device, launch, &mut row) {
            note(format_args!("{}: no figures: {}", benchmark.name, error.message));
            without.push(benchmark.name);
        }
        table.push_named(benchmark.name, row);
    }
    table.finish(bench.common.out.as_deref(), None)?;
    match &without[..] {
        [] => Ok(()),
        names => Err(CliError::failed(format!(
            "{} of {} benchmarks have no figures ({}); the lines above say why",
            names.len(),
            chosen.len(),
            names.join(", ")
        ))),
    }
}

impl Table1Bench {
    /// Measures one benchmark and models it on `device`; fills its columns of `row`.
    fn measure(
        &self,
        benchmark: &Benchmark,
        scene: PathBuf,
        device: &Topology,
        launch: &Launch,
        row: &mut [f64],
    ) -> Result<(), CliError> {
        let one = self.of(benchmark, scene, launch)?;
        let (size, all) = one.run()?;
        (row[0], row[1]) = (size.triangles as f64, one.step_s()? * 1e3);
        for runs in &all {
            let Some(place) = WORKERS.iter().position(|&workers| workers == runs.workers) else { continue };
            row[2 + place] = 1.0 / runs.mean(|step| step.stage_seconds.total);
            row[5] = runs.mean(|step| step.contacts as f64);
            row[6] = runs.mean(|step| step.iterations as f64);
            if runs.workers <= device.gpus() {
                let topology = device.with_first_gpus(runs.workers).map_err(CliError::bad_input)?;
                let mut seconds = one.predict(runs.workers, &topology)?;
                let mean = seconds.iter().sum::<f64>() / seconds.len().max(1) as f64;
                row[7 + place] = if median(&mut seconds) > 0.0 { 1.0 / mean } else { f64::NAN };
            }
        }
        Ok(())
    }

    fn chosen(&self) -> Result<Vec<&'static Benchmark>, CliError> {
        let is = |benchmark: &Benchmark, name: &str| {
            benchmark.name.eq_ignore_ascii_case(name) || benchmark.scene.eq_ignore_ascii_case(name)
        };
        if let Some(name) = self.only.iter().find(|name| !TABLE.iter().any(|row| is(row, name))) {
            let known: Vec<&str> = TABLE.iter().map(|row| row.name).collect();
            return Err(CliError::bad_input(format!(
                "--only {name}: no benchmark of the table has this name ({})",
                known.join(", ")
            )));
        }
        let wanted = |row: &&Benchmark| self.only.is_empty() || self.only.iter().any(|name| is(row, name));
        Ok(TABLE.iter().filter(wanted).collect())
    }

    fn of(&self, benchmark: &Benchmark, scene: PathBuf, launch: &Launch) -> Result<SceneBench, CliError> {
        let of_share = (benchmark.triangles as f64 * self.share).round().max(1.0) as u64;
        let settings = Settings {
            common: self.common.clone(),
            resolution: self.resolution.unwrap_or(of_share),
            workers: self.workers.clone(),
            steps: self.steps,
            rounds: self.rounds,
            exchange: ExchangeMode::Halo,
            preconditioner: None::<PreconditionerKind>,
        };
        let step_s = (!self.own_steps).then_some(1.0 / benchmark.steps_per_s);
        let sewn = sewn(&scene, settings.resolution, &self.common, launch)?;
        Ok(SceneBench::alone(scene, self.skip, step_s, settings, launch)?.in_place(sewn))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_benchmark_has_a_scene_and_differs_from_the_others() {
        let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("scenes");
        for (i, row) in TABLE.iter().enumerate() {
            assert!(folder.join(row.scene).with_extension("toml").is_file(), "{}", row.name);
            assert!(TABLE[..i].iter().all(|other| other.name != row.name && other.scene != row.scene));
            assert!(row.fps.is_sorted() && row.triangles > 500_000);
        }
    }
}
