//! `loomtree schedule`: shows the work queues for a topology file. Its times are modeled from the file, not measured.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use clap::ValueEnum;

use super::{CliError, print_to};
use crate::interconnect::{
    LowerBound, Plan, ScheduleKind, Topology, candidates, lower_bound, plan, root_crossings, transfer_times,
};
use crate::os::console::{is_json, note};
use crate::output::{Timeline, TimelineBox, write_timeline};

/// Bytes of one row of a vector: three components in single precision.
const ROW_BYTES: f64 = 12.0;
/// Stages per row of the text table. Wider schedules continue below.
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
    /// Also print the lower bound that no schedule beats and what every schedule reaches of it (text format)
    #[arg(long)]
    pub explain: bool,
    /// Draw the schedule (ranks over modelled time, colored by link) into this SVG file
    #[arg(long, value_name = "FILE")]
    pub svg: Option<PathBuf>,
}

/// Output form of `loomtree schedule`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ScheduleFormat {
    /// A table.
    Text,
    /// {"gpus":n,"queues":[[{"source":t,"vector":v},..],..]}, of best also "pieces"
    Json,
}

/// Runs the command; the result goes to stdout.
pub fn run(args: ScheduleArgs) -> Result<(), CliError> {
    write_schedule(&args, &mut io::stdout().lock())
}

/// Runs the command and writes the result to `out`. A closed pipe is not an error.
pub fn write_schedule(args: &ScheduleArgs, out: &mut impl Write) -> Result<(), CliError> {
    let topology = Topology::read(&args.topology).map_err(CliError::bad_input)?;
    let sub_vector_bytes = sub_vector_bytes(args.rows, topology.gpus());
    let plan = plan(args.schedule, &topology, sub_vector_bytes)
        .map_err(|error| CliError::bad_input(format!("{}: {error}", args.topology.display())))?;
    if let Some(path) = &args.svg {
        draw(path, &plan, &topology, sub_vector_bytes)?;
    }
    let mut text = Vec::new();
    if is_json() {
        let mut lines = Vec::new();
        write_text(&plan, &topology, args, sub_vector_bytes, &mut lines).map_err(CliError::failed)?;
        note(String::from_utf8_lossy(&lines).trim_end());
    }
    let format = if is_json() { ScheduleFormat::Json } else { args.format };
    let written = match format {
        ScheduleFormat::Json => write_json(&plan, &mut text),
        ScheduleFormat::Text => write_text(&plan, &topology, args, sub_vector_bytes, &mut text),
    };
    written.map_err(|error| CliError::failed(format!("cannot write the schedule: {error}")))?;
    print_to(out, &String::from_utf8_lossy(&text))
}

/// Bytes of one zero-padded sub-vector of a vector with `rows` rows.
fn sub_vector_bytes(rows: u32, gpus: usize) -> f64 {
    (rows as usize).div_ceil(gpus) as f64 * ROW_BYTES
}

/// Writes one queue per line, so that people and diff tools can read it.
fn write_json(plan: &Plan, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "{{\"gpus\":{},\"queues\":[", plan.schedule.gpus)?;
    for (rank, queue) in plan.schedule.queues.iter().enumerate() {
        let comma = if rank + 1 == plan.schedule.gpus { "" } else { "," };
        writeln!(out, "{}{comma}", serde_json::to_string(queue)?)?;
    }
    let Some(pieces) = &plan.pieces else { return writeln!(out, "]}}") };
    writeln!(out, "],\"pieces\":{{\"chunks\":{},\"queues\":[", pieces.chunks)?;
    for (rank, queue) in pieces.queues.iter().enumerate() {
        let comma = if rank + 1 == plan.schedule.gpus { "" } else { "," };
        writeln!(out, "{}{comma}", serde_json::to_string(queue)?)?;
    }
    writeln!(out, "]}}}}")
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
    if let Some(pieces) = &plan.pieces {
        writeln!(
            out,
            "sub-vectors travel in {} chunk(s) on routes of their own (--format json lists them); below: the order in \
             which whole sub-vectors are taken",
            pieces.chunks
        )?;
    }
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
    if args.explain {
        explain(&lower_bound(topology, sub_vector_bytes), topology, sub_vector_bytes, out)?;
    }
    Ok(())
}

/// Prints the lower bound, its origin, and the distance of every schedule from it.
fn explain(bound: &LowerBound, topology: &Topology, sub_vector_bytes: f64, out: &mut impl Write) -> io::Result<()> {
    let gpus = topology.gpus();
    if gpus == 1 {
        return writeln!(out, "\nlower bound: 0.0 us, a single GPU receives nothing");
    }
    let name = |gpu: usize| topology.node_name(gpu).to_string();
    writeln!(out, "\nlower bound on any schedule (from the file, not measured):")?;
    writeln!(
        out,
        "  {:>10.1} us  ingress: {} must take in {} sub-vectors over its own links",
        bound.ingress_s * 1e6,
        name(bound.ingress_gpu),
        gpus - 1
    )?;
    let inside: Vec<String> = bound.cut_gpus.iter().map(|gpu| name(*gpu)).collect();
    writeln!(out, "  {:>10.1} us  worst cut: into {{{}}}", bound.cut_s * 1e6, inside.join(" "))?;
    writeln!(out, "  {:>10.1} us  shortest latency before the last byte can be there", bound.latency_s * 1e6)?;
    let unit_s = bound.ingress_s / (gpus - 1) as f64;
    writeln!(out, "  {:>10.1} us  = {:.2} sub-vector times", bound.total_s() * 1e6, bound.total_s() / unit_s)?;
    writeln!(out, "  schedule   modelled us   sub-vector times   over the bound")?;
    for candidate in candidates(topology, sub_vector_bytes) {
        let total_s = candidate.cost.total_s;
        writeln!(
            out,
            "  {:<9} {:>12.1} {:>18.2} {:>16.3}",
            candidate.kind,
            total_s * 1e6,
            total_s / unit_s,
            total_s / bound.total_s()
        )?;
    }
    Ok(())
}

/// Draws every transfer as a box from its start to its end, colored by the busiest link of its path.
fn draw(path: &Path, plan: &Plan, topology: &Topology, sub_vector_bytes: f64) -> Result<(), CliError> {
    let transfers = plan.transfers(sub_vector_bytes);
    let mut load_s = vec![[0.0f64; 2]; topology.links().len()];
    let hops = |source: usize, rank: usize| topology.path(source, rank).iter();
    for (rank, queue) in transfers.queues.iter().enumerate() {
        for transfer in queue {
            for hop in hops(transfer.source, rank) {
                let seconds = transfer.bytes / topology.links()[hop.link].bandwidth_gb_s;
                load_s[hop.link][usize::from(hop.forward)] += seconds;
            }
        }
    }
    let mut groups: Vec<(usize, bool)> = Vec::new();
    let mut boxes = Vec::new();
    for (rank, (queue, spans)) in transfers.queues.iter().zip(transfer_times(&transfers, topology)).enumerate() {
        for (transfer, span) in queue.iter().zip(spans) {
            let load = |hop: &&crate::interconnect::Hop| load_s[hop.link][usize::from(hop.forward)];
            let busiest = hops(transfer.source, rank).max_by(|a, b| load(a).total_cmp(&load(b)));
            let Some(link) = busiest.map(|hop| (hop.link, hop.forward)) else { continue };
            let group = groups.iter().position(|known| *known == link).unwrap_or_else(|| {
                groups.push(link);
                groups.len() - 1
            });
            let label = format!("v{}<-{}", transfer.owner, transfer.source);
            let (start_s, end_s, lane) = (span.start_s, span.released_s, transfer.lane);
            boxes.push(TimelineBox { row: rank, lane, start_s, end_s, label, group });
        }
    }
    let link_name = |(link, forward): &(usize, bool)| {
        let [a, b] = topology.links()[*link].ends.map(|node| topology.node_name(node));
        if *forward { format!("{a} to {b}") } else { format!("{b} to {a}") }
    };
    let timeline = Timeline {
        title: format!("{}: schedule {}, {:.1} us", topology.name(), plan.kind, plan.cost.total_s * 1e6),
        subtitle:
            "modelled from the topology file, not measured; vJ<-S: receives (a piece of) sub-vector J from rank S; \
                   colour: busiest link of the path"
                .into(),
        rows: (0..plan.schedule.gpus).map(|rank| format!("rank {rank}")).collect(),
        groups: groups.iter().map(link_name).collect(),
        faint: None,
        boxes,
    };
    write_timeline(path, &timeline).map_err(|error| CliError::failed(format!("--svg: {error}")))
}

fn write_row(out: &mut impl Write, head: &str, cells: impl Iterator<Item = String>) -> io::Result<()> {
    write!(out, "{head:<12}")?;
    for cell in cells {
        write!(out, " {cell:>8}")?;
    }
    writeln!(out)
}

/// A sentence about the stages that use the root switch.
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
