//! What the page is told of a run again and again: frames, and when the report has changed its content in columns.

use serde_json::{Value, json};

use super::watched::{Look, Watched};
use crate::coordinator::RunOptions;
use crate::output::{Report, RunDirectory, RunManifest, StepRecord};

/// A look at the run as JSON. `have`: the version of the report that the page has.
pub(super) fn state(run: &Watched, have: Option<&str>) -> Value {
    let Look { generation, frames, coarse, report, silent_s } = run.look();
    let mut state = json!({
        "path": run.path().display().to_string(),
        "generation": generation,
        "frames": ranges(&frames),
        "coarse": ranges(&coarse),
        "silent_s": silent_s,
        "steered": run.path().join("live.sock").exists(),
    });
    if let Some((version, report)) = report {
        state["version"] = json!(version);
        if have != Some(version.as_str()) {
            state["report"] = report_of(run, &report);
        }
    }
    state
}

/// Numbers as ranges [from, to], both included.
fn ranges(numbers: &[u32]) -> Vec<[u32; 2]> {
    let mut ranges: Vec<[u32; 2]> = Vec::new();
    for &number in numbers {
        match ranges.last_mut() {
            Some([_, to]) if *to + 1 == number => *to = number,
            _ => ranges.push([number, number]),
        }
    }
    ranges
}

fn report_of(run: &Watched, report: &Report) -> Value {
    let directory = RunDirectory::open(run.path()).ok();
    let manifest = directory.and_then(|directory| RunManifest::load(&directory).ok());
    let options: Option<RunOptions> = manifest.and_then(|manifest| manifest.flags().ok());
    let frames = report.frames.iter().filter(|frame| !frame.let_go.is_empty() || frame.beyond_limits.is_some());
    let events = frames.map(|frame| {
        let let_go: usize = frame.let_go.iter().map(|group| group.vertices.len()).sum();
        let beyond = frame.beyond_limits.as_ref().map(|beyond| beyond.triangles);
        json!({ "frame": frame.frame, "let_go": let_go, "beyond_limits": beyond })
    });
    json!({
        "header": report.header,
        "events": events.collect::<Vec<_>>(),
        "steps": columns(&report.steps),
        "segments": report.segments,
        "seams": report.seams,
        "cuts": options.as_ref().map(|options| options.time.cuts.clone()).unwrap_or_default(),
        "split": options.as_ref().map_or(1, |options| options.time.segments),
        "memory_limit_bytes": options.as_ref().and_then(|options| options.memory_limit_bytes),
    })
}

/// The records of the steps, a list per figure.
fn columns(steps: &[StepRecord]) -> Value {
    let column = |value: &dyn Fn(&StepRecord) -> Value| steps.iter().map(value).collect::<Vec<Value>>();
    let tables = |step: &StepRecord| -> Vec<u64> {
        let (near, along) = (&step.proximity.bytes_per_rank, &step.continuous.bytes_per_rank);
        near.iter().zip(along).map(|(near, along)| *near.max(along)).collect()
    };
    json!({
        "step": column(&|s| json!(s.step)),
        "frame": column(&|s| json!(s.frame)),
        "session": column(&|s| json!(s.session)),
        "substeps": column(&|s| json!(s.substeps)),
        "iterations": column(&|s| json!(s.iterations)),
        "residual": column(&|s| json!(s.residual)),
        "contacts": column(&|s| json!(s.contacts)),
        "gap_m": column(&|s| json!(s.smallest_gap_m)),
        "zones": column(&|s| json!(s.zones.zones)),
        "bytes": column(&|s| json!(s.bytes_moved)),
        "total_s": column(&|s| json!(s.stage_seconds.total)),
        "stages": steps.iter().map(|s| json!(s.stage_seconds)).collect::<Vec<_>>(),
        "memory": column(&|s| json!(s.memory_bytes_per_rank)),
        "resident": column(&|s| json!(s.resident_bytes_per_rank)),
        "tables": column(&|s| json!(tables(s))),
        "guided": column(&|s| json!(s.guidance.is_some())),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_join_what_follows() {
        assert_eq!(ranges(&[]), [[0; 2]; 0]);
        assert_eq!(ranges(&[0, 1, 2, 5, 7, 8]), [[0, 2], [5, 5], [7, 8]]);
    }
}
