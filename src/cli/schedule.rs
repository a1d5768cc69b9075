//! `loomtree schedule`: shows the work queues for a topology file. Its times are modelled from the file, not measured.

use std::io::{self, Write};
use std::path::PathBuf;

use clap::ValueEnum;
use clap::builder::PossibleValue;

use super::CliError;
use crate::interconnect::{Plan, ScheduleKind, Topology, candidates, plan, root_crossings};

/// Bytes of one row of a vector: three components in single precision.
const ROW_BYTES: f64 = 12.0;
/// Stages side by side in the text table; wider schedules continue below.
const STAGES_PER_BLOCK: usize = 12;

/// Arguments of `loomtree schedule`.
#[derive(Clone, Debug, clap::Args)]
pub struct ScheduleArgs {
    /// Topology file (TOML)
    pub topology: PathBuf,
    /// How to make the work queues; auto = the cheapest by modelled time
    #[arg(long, default_value = "auto")]
    pub schedule: ScheduleKind,
    /// Table for people, or JSON for programs
    #[arg(long, default_value = "text")]
    pub format: ScheduleFormat,
    /// Rows (vertices) of the whole vector that modelled times are for
    #[arg(long, default_value_t = 600_000, value_parser = clap::value_parser!(u32).range(1..))]
    pub rows: u32,
}

/// Output form of `loomtree schedule`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ScheduleFormat {
    /// A table.
    Text,
    /// {"gpus":n,"queues":[[{"source":t,"vector":v},..],..]}
    Json,
}

impl ValueEnum for ScheduleKind {
    fn value_variants<'a>() -> &'a [Self] {
        &ScheduleKind::ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(PossibleValue::new(self.name()))
    }
}

/// Runs the command; the result goes to stdout.
pub fn run(args: ScheduleArgs) -> Result<(), CliError> {
    let mut out = io::BufWriter::new(io::stdout().lock());
    write_schedule(&args, &mut out)
}

/// Runs the command; the result goes to `out`. A reader that went away is no error.
pub fn write_schedule(args: &ScheduleArgs, out: &mut impl Write) -> Result<(), CliError> {
    let topology = Topology::read(&args.topology).map_err(CliError::bad_input)?;
    let sub_vector_bytes = sub_vector_bytes(args.rows, topology.gpus());
    let plan = plan(args.schedule, &topology, sub_vector_bytes)
        .map_err(|error| CliError::bad_input(format!("{}: {error}", args.topology.display())))?;
    let written = match args.format {
        ScheduleFormat::Json => write_json(&plan, out),
        ScheduleFormat::Text => write_text(&plan, &topology, args, sub_vector_bytes, out),
    };
    match written.and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(CliError::failed(format!("cannot write the schedule: {error}")))
        }
        _ => Ok(()),
    }
}

/// Bytes of one zero-padded sub-vector of a vector with `rows` rows.
fn sub_vector_bytes(rows: u32, gpus: usize) -> f64 {
    (rows as usize).div_ceil(gpus) as f64 * ROW_BYTES
}

/// One queue per line, so that people and diffs can read it as well.
fn write_json(plan: &Plan, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "{{\"gpus\":{},\"queues\":[", plan.schedule.gpus)?;
    for (rank, queue) in plan.schedule.queues.iter().enumerate() {
        let comma = if rank + 1 == plan.schedule.gpus { "" } else { "," };
        writeln!(out, "{}{comma}", serde_json::to_string(queue)?)?;
    }
    writeln!(out, "]}}")
}

fn write_text(
    plan: &Plan,
    topology: &Topology,
    args: &ScheduleArgs,
    sub_vector_bytes: f64,
    out: &mut impl Write,
) -> io::Result<()> {
    let chosen = if args.schedule == ScheduleKind::Auto { " (chosen by modelled time)" } else { "" };
    let gpus = topology.gpus();
    writeln!(out, "{}: {gpus} x {}", topology.name(), topology.device().name)?;
    writeln!(
        out,
        "schedule {}{chosen}: {} stages; vJ<-S = receives sub-vector J from rank S",
        plan.kind,
        plan.schedule.stages()
    )?;
    let crossings = root_crossings(&plan.schedule, topology);
    let stages: Vec<usize> = (0..plan.schedule.stages()).collect();
    for block in stages.chunks(STAGES_PER_BLOCK) {
        writeln!(out)?;
        write_row(out, "stage", block.iter().map(|stage| (stage + 1).to_string()))?;
        for (rank, queue) in plan.schedule.queues.iter().enumerate() {
            let cells = block.iter().map(|stage| format!("v{}<-{}", queue[*stage].vector, queue[*stage].source));
            write_row(out, &format!("rank {rank}"), cells)?;
        }
        write_row(out, "modelled us", block.iter().map(|stage| format!("{:.1}", plan.cost.stage_s[*stage] * 1e6)))?;
        if let Some(crossings) = &crossings {
            write_row(out, "cross root", block.iter().map(|stage| crossings[*stage].len().to_string()))?;
        }
    }
    writeln!(out)?;
    if let (Some(crossings), Some(root)) = (&crossings, topology.root()) {
        writeln!(out, "{}", root_sentence(crossings, topology.node_name(root)))?;
    }
    writeln!(
        out,
        "modelled total (from the file, not measured) for {} rows in sub-vectors of {:.3} MB:",
        args.rows,
        sub_vector_bytes * 1e-6
    )?;
    for candidate in candidates(topology, sub_vector_bytes) {
        let mark = if candidate.kind == plan.kind { "   <- shown above" } else { "" };
        writeln!(out, "  {:<9} {:>12.1} us{mark}", candidate.kind, candidate.cost.total_s * 1e6)?;
    }
    Ok(())
}

fn write_row(out: &mut impl Write, head: &str, cells: impl Iterator<Item = String>) -> io::Result<()> {
    write!(out, "{head:<12}")?;
    for cell in cells {
        write!(out, " {cell:>8}")?;
    }
    writeln!(out)
}

/// Which stages use the root switch.
fn root_sentence(crossings: &[Vec<usize>], root: &str) -> String {
    let used: Vec<String> = crossings
        .iter()
        .enumerate()
        .filter(|(_, vectors)| !vectors.is_empty())
        .map(|(stage, _)| (stage + 1).to_string())
        .collect();
    match used.len() {
        0 => format!("no stage crosses the root switch {root}"),
        1 => format!("stage {} crosses the root switch {root}", used[0]),
        n if n == crossings.len() => format!("every stage crosses the root switch {root}"),
        _ => format!("stages {} cross the root switch {root}", used.join(", ")),
    }
}
