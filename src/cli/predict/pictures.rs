//! A prediction as pictures: the first step as a trace, and one product of it as a timeline like the paper's Fig. 3.

use std::path::Path;

use super::Prediction;
use crate::cli::CliError;
use crate::interconnect::{ReplaySpan, ReplayedStep};
use crate::output::{RankEvents, Timeline, TimelineBox, TraceWriter};
use crate::telemetry::{Activity, Event, EventName};

impl Prediction {
    /// The first step with all its tasks, as events of a run.
    pub(super) fn write_trace(&self, path: &Path) -> Result<(), CliError> {
        let Some(step) = self.steps.first() else { return Ok(()) };
        let ranks = self.topology.gpus();
        let devices = vec![format!("modelled {}", self.topology.device().name); ranks];
        let ns = |seconds: f64| (seconds * 1e9).round() as u64;
        let mut events: Vec<Vec<Event>> = vec![Vec::new(); ranks];
        for task in &step.spans {
            let activity = match task.name {
                EventName::Receive | EventName::Publish => Activity::Transfer,
                EventName::AllReduce => Activity::Wait,
                _ => Activity::Compute,
            };
            let (source, vector) = task.from.unwrap_or((task.rank, task.rank));
            events[task.rank].push(Event {
                name: task.name as u32,
                activity: activity as u32,
                step: step.step,
                stage: 0,
                source: source as u32,
                vector: vector as u32,
                asked_ns: ns(task.span.start_s),
                start_ns: ns(task.span.start_s),
                end_ns: ns(task.span.done_s),
                bytes: task.bytes as u64,
                flops: 0,
            });
        }
        let all: Vec<RankEvents> =
            events.iter().enumerate().map(|(rank, events)| RankEvents { rank, epoch_unix_ns: 0, events }).collect();
        let written = TraceWriter::create(path, &devices, 0).and_then(|mut writer| writer.append(&all));
        written.map_err(|error| CliError::failed(format!("--trace: {error}")))
    }

    /// One product: receipts above, kernels below, as in the paper's Fig. 3.
    pub(super) fn timeline(&self) -> Timeline {
        let mut timeline = Timeline {
            title: self.title(),
            subtitle: format!(
                "a matrix-vector product of step {} between two reductions; modelled, not measured",
                self.steps.first().map_or(0, |step| step.step)
            ),
            rows: (0..self.topology.gpus()).map(|rank| format!("rank {rank}")).collect(),
            ..Timeline::default()
        };
        let Some(step) = self.steps.first() else { return timeline };
        let Some((from_s, to_s)) = product_span(step) else { return timeline };
        let within = |task: &&ReplaySpan| {
            task.span.start_s >= from_s && task.span.done_s <= to_s && task.span.done_s > task.span.start_s
        };
        let shown: Vec<&ReplaySpan> =
            step.spans.iter().filter(within).filter(|task| task.name != EventName::AllReduce).collect();
        let lanes = shown.iter().map(|task| task.lane + 1).max().unwrap_or(1);
        for task in &shown {
            let group_name = match (task.name, task.from) {
                (EventName::Receive, Some((source, _))) => format!("receipt from rank {source}"),
                (name, _) => name.text().to_string(),
            };
            let group = group_of(&mut timeline, group_name);
            let (lane, end_s, label) = match (task.name, task.from) {
                (EventName::Receive, Some((_, owner))) => (task.lane, task.span.released_s, format!("v{owner}")),
                (EventName::SpmvBlock, Some((_, vector))) => {
                    (lanes, task.span.done_s, format!("A{},{vector}", task.rank))
                }
                (name, _) => (lanes, task.span.done_s, name.text().to_string()),
            };
            let (row, start_s, end_s) = (task.rank, task.span.start_s - from_s, end_s - from_s);
            timeline.boxes.push(TimelineBox { row, lane, start_s, end_s, label, group });
        }
        add_latencies(&mut timeline, &shown, from_s);
        timeline
    }
}

/// The bytes of a receipt are through before they are there: the rest of the way, up to the next receipt of the lane.
fn add_latencies(timeline: &mut Timeline, shown: &[&ReplaySpan], from_s: f64) {
    let receipts = || shown.iter().filter(|task| task.name == EventName::Receive);
    for task in receipts() {
        let same_lane = receipts().filter(|other| other.rank == task.rank && other.lane == task.lane);
        let later = same_lane.map(|other| other.span.start_s).filter(|start_s| *start_s >= task.span.released_s);
        let end_s = later.fold(task.span.done_s, f64::min);
        if end_s > task.span.released_s {
            let group = group_of(timeline, "latency of the path".to_string());
            timeline.faint = Some(group);
            let (start_s, end_s) = (task.span.released_s - from_s, end_s - from_s);
            let label = "latency".to_string();
            timeline.boxes.push(TimelineBox { row: task.rank, lane: task.lane, start_s, end_s, label, group });
        }
    }
}

fn group_of(timeline: &mut Timeline, name: String) -> usize {
    timeline.groups.iter().position(|known| *known == name).unwrap_or_else(|| {
        timeline.groups.push(name);
        timeline.groups.len() - 1
    })
}

/// Start and end of a product of the step. Ranks reach the first one at different times, after kernels of unequal length; a
/// reduction brings them together, so the first product behind one is taken, if there is any.
fn product_span(step: &ReplayedStep) -> Option<(f64, f64)> {
    let is_product =
        |task: &&ReplaySpan| matches!(task.name, EventName::SpmvLocal | EventName::SpmvRemote | EventName::SpmvBlock);
    let products = || step.spans.iter().filter(is_product);
    let earliest = |times: &mut dyn Iterator<Item = f64>| times.fold(f64::INFINITY, f64::min);
    let reductions = || step.spans.iter().filter(|task| task.name == EventName::AllReduce).map(|task| task.span);
    let first_s = earliest(&mut products().map(|task| task.span.start_s));
    // The end of the reduction behind the first product; products start no earlier than that.
    let met_s = earliest(&mut reductions().filter(|span| span.start_s >= first_s).map(|span| span.done_s));
    let from_s = match products().any(|task| task.span.start_s >= met_s) {
        true => met_s,
        false => first_s,
    };
    let to_s = earliest(&mut reductions().map(|span| span.start_s).filter(|start_s| *start_s > from_s));
    from_s.is_finite().then_some((from_s, to_s))
}
