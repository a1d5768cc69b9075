//! `loomtree bench time`: what splitting a shot in time would gain [Liang and Lin 2018], played on a virtual clock with
//! the seconds of every step of a fine and a coarse run, which were measured. The played times are modeled: the
//! processes of the model do not share a machine.

use std::path::PathBuf;

use serde_json::json;

use super::common::{machine, positive};
use super::table::FigureTable;
use super::time_hybrid;
use super::time_levels::{Level, Recorded};
use super::time_play::{COLUMNS, ShotArgs};
use super::time_sweep::{self, Sweep};
use crate::cli::{CliError, count, print};
use crate::coordinator::{Launch, RunOptions, RunPlaces, RunPlan};
use crate::output::Existing;
use crate::time_parallel::Costs;

/// Arguments of `loomtree bench time`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct TimeBench {
    /// Run directory of the shot on its fine mesh [default: a run of --scene]
    #[arg(long, value_name = "RUN", requires = "coarse")]
    fine: Option<PathBuf>,
    /// Run directory of the same shot on a coarse mesh; its steps may be longer by a whole number
    #[arg(long, value_name = "RUN", requires = "fine")]
    coarse: Option<PathBuf>,
    /// Run directory of the same shot on a still coarser mesh: a third level, by which the coarse run is split in time
    #[arg(long, value_name = "RUN", requires = "coarse")]
    coarsest: Option<PathBuf>,
    /// Scene that is run where no runs are given
    #[arg(long, value_name = "FILE", default_value = "scenes/sphere.toml")]
    scene: PathBuf,
    /// Triangles of the fine mesh of --scene
    #[arg(long, value_name = "N", default_value_t = 32_768, value_parser = count)]
    resolution: u64,
    /// Fine edge lengths in a coarse one, of the meshes of --scene
    #[arg(long, value_name = "RATIO", default_value_t = 4, value_parser = clap::value_parser!(u64).range(2..=16))]
    coarse_ratio: u64,
    /// Fine steps in a coarse step, of the runs of --scene
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=64))]
    step_ratio: u32,
    /// Fine steps that the runs of --scene make
    #[arg(long, value_name = "N", default_value_t = 240, value_parser = clap::value_parser!(u32).range(8..))]
    measured_steps: u32,
    #[command(flatten)]
    shot: ShotArgs,
    /// Machine whose links move the states [default: a balanced tree of PCIe 3 x16 links]
    #[arg(long, value_name = "FILE")]
    topology: Option<PathBuf>,
    /// Recorded runs of the shot on several workers (--trace-steps): adds the table of how many segments of how many
    /// workers each are fastest on the machine of --topology
    #[arg(long, value_name = "RUN", value_delimiter = ',', requires = "topology")]
    ranks: Vec<PathBuf>,
    /// Let a figure vary in place of the number of processes, for the largest number of them
    #[arg(long, value_enum)]
    sweep: Option<Sweep>,
    /// Also play constant costs with the ratio K of the paper, in a table of its own
    #[arg(long, value_name = "K", num_args = 0..=1, default_missing_value = "368", value_parser = positive)]
    paper: Option<f64>,
    /// Print JSON in place of the table
    #[arg(long)]
    json: bool,
    /// Also write the table as JSON and SVG into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

pub(super) fn run(bench: &TimeBench, launch: &Launch) -> Result<(), CliError> {
    if bench.sweep == Some(Sweep::Resolution) && bench.fine.is_some() {
        let what = "--sweep resolution makes its runs itself, from --scene; leave out --fine and --coarse";
        return Err(CliError::bad_input(what));
    }
    let machine = machine(bench.topology.as_deref(), 8)?;
    let levels = match (&bench.fine, &bench.coarse) {
        (Some(fine), Some(coarse)) => {
            let runs = [Some(fine), Some(coarse), bench.coarsest.as_ref()];
            runs.into_iter().flatten().map(|run| Level::read(run)).collect::<Result<Vec<_>, _>>()?
        }
        _ => measure(bench, bench.resolution, launch)?,
    };
    let recorded = Recorded::of(&levels, &machine)?;
    let first = match bench.sweep {
        None => by_processes(bench, &recorded),
        Some(sweep) => {
            let mut by_size = Vec::new();
            if sweep == Sweep::Resolution {
                for resolution in time_sweep::coarser_resolutions(bench.resolution) {
                    by_size.push(Recorded::of(&measure(bench, resolution, launch)?, &machine)?);
                }
            }
            by_size.push(recorded.clone());
            time_sweep::table(&bench.shot, &by_size, sweep)
        }
    };
    let mut tables = vec![(first, Some(&CURVES[..]))];
    if !bench.ranks.is_empty() {
        let shot = time_hybrid::Shot {
            costs: recorded.shot(u64::from(bench.shot.steps), 1.0),
            method: bench.shot.method(&recorded),
            ranks: &bench.shot.processes,
        };
        tables.push((time_hybrid::table(&shot, &recorded.title, &machine, &bench.ranks)?, None));
    }
    if let Some(ratio) = bench.paper {
        let steps = u64::from(bench.shot.steps);
        let constant = Recorded {
            costs: Costs { fine: vec![1.0], coarse: vec![vec![1.0 / ratio]], stride: 1 },
            coarse_state_s: 0.0,
            fine_state_s: 0.0,
            title: format!("constant costs with the paper's K = {ratio}, states move in no time, {steps} steps"),
            triangles: recorded.triangles,
        };
        tables.push((by_processes(bench, &constant).named("time_paper"), Some(&CURVES[..])));
    }
    if bench.json {
        // One document: what is asked for besides the numbers of processes stands beside their rows.
        print_json(bench, &recorded, tables.iter().map(|(table, _)| table).filter(|table| table.name() != "time"))?;
    }
    for (table, curves) in &tables {
        if !bench.json {
            table.print()?;
        }
        if let Some(folder) = &bench.out {
            table.write(folder, curves.map(|curves| (table.first_column(), curves)))?;
        }
    }
    Ok(())
}

/// Columns that the picture shows as curves.
const CURVES: [&str; 3] = ["speedup", "eq6", "eq16"];

fn by_processes(bench: &TimeBench, recorded: &Recorded) -> FigureTable {
    let costs = recorded.shot(u64::from(bench.shot.steps), 1.0);
    let method = bench.shot.method(recorded);
    let mut table = FigureTable::modeled("time", bench.shot.title(recorded, &costs), COLUMNS.to_vec());
    for &processes in &bench.shot.processes {
        for levels in 1..=costs.coarse.len() {
            let costs = Costs { coarse: costs.coarse[..levels].to_vec(), ..costs.clone() };
            table.push(bench.shot.row(&costs, processes, &method).1);
        }
    }
    table
}

/// Prints one JSON object. `others`: tables besides that by numbers of processes, each under its name.
fn print_json<'a>(
    bench: &TimeBench,
    recorded: &Recorded,
    others: impl Iterator<Item = &'a FigureTable>,
) -> Result<(), CliError> {
    let costs = recorded.shot(u64::from(bench.shot.steps), 1.0);
    let method = bench.shot.method(recorded);
    let mut rows = Vec::new();
    for &processes in &bench.shot.processes {
        for levels in 1..=costs.coarse.len() {
            let costs = Costs { coarse: costs.coarse[..levels].to_vec(), ..costs.clone() };
            let (played, row) = bench.shot.row(&costs, processes, &method);
            let named = COLUMNS.iter().zip(row).map(|(name, value)| {
                let whole = !matches!(*name, "speedup" | "eq6" | "eq16" | "idle_share");
                (name.to_string(), if whole { json!(value as u64) } else { json!(value) })
            });
            let mut named: serde_json::Map<_, _> = named.collect();
            named.insert("coarse_processes".to_string(), json!(played.coarse_processes));
            rows.push(serde_json::Value::Object(named));
        }
    }
    let mut document = json!({
        "kind": "modelled", "title": bench.shot.title(recorded, &costs), "steps": costs.fine.len(), "k": costs.ratio(),
        "rows": rows,
    });
    for table in others {
        document[table.name()] = table.document();
    }
    let text = serde_json::to_string_pretty(&document).map_err(CliError::failed)?;
    print(&(text + "\n"))
}

/// Runs the scene on its levels, one after the other, with one worker of one thread. `resolution`: triangles of the
/// fine one.
fn measure(bench: &TimeBench, resolution: u64, launch: &Launch) -> Result<Vec<Level>, CliError> {
    let folder =
        tempfile::tempdir().map_err(|error| CliError::failed(format!("cannot make a temporary folder: {error}")))?;
    let area = bench.coarse_ratio * bench.coarse_ratio;
    let coarse = (resolution / area).max(32);
    [(resolution, 1), (coarse, bench.step_ratio)]
        .into_iter()
        .map(|(triangles, stretch)| {
            let options = RunOptions {
                resolution: Some(triangles),
                threads: Some(1),
                frames: Some(1),
                checkpoint_every: 0,
                heartbeat_s: 600.0,
                ..RunOptions::default()
            };
            let mut plan = RunPlan::new(&bench.scene, &options).map_err(CliError::bad_input)?;
            plan.scene.settings.step_s *= f64::from(stretch);
            // One frame at the end, so that writing frames is not measured.
            plan.scene.settings.steps_per_frame =
                (bench.measured_steps / bench.step_ratio * bench.step_ratio) / stretch;
            let places = RunPlaces {
                scene: bench.scene.clone(),
                out: folder.path().join(triangles.to_string()),
                existing: Existing::Refuse,
            };
            crate::coordinator::run(plan, &options, &places, launch)
                .map_err(|error| CliError::failed(error.to_string()))?;
            let level = Level::read(&places.out)?;
            Ok(Level { place: format!("{} ({triangles} triangles)", bench.scene.display()), ..level })
        })
        .collect()
}
