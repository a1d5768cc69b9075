//! `trace.json` of a split shot: a track per session with the jobs that it made, and arrows from every job to those
//! that start from its states. It opens in ui.perfetto.dev and chrome://tracing.

use std::path::Path;

use serde_json::{Value, json};

use super::time_job::Job;
use crate::output::{WriteError, write_atomically};

/// A job, and when it was made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Span {
    pub job: Job,
    pub session: usize,
    /// Seconds since the start of the program.
    pub begun_s: f64,
    pub ended_s: f64,
    pub steps: u32,
}

/// Writes the trace of `spans`, which are in the order in which they ended.
pub(super) fn write(path: &Path, spans: &[Span]) -> Result<(), WriteError> {
    let text = Value::Array(events(spans)).to_string();
    write_atomically(path, |out| out.write_all(text.as_bytes()))
}

/// The jobs that a job of segment `j` may start from.
fn sources(job: Job) -> Vec<Job> {
    match job {
        Job::Coarse | Job::Segment(0) => Vec::new(),
        Job::Segment(_) => vec![Job::Coarse],
        Job::Seam(j) => vec![Job::Segment(j - 1), Job::Seam(j - 1), Job::Segment(j)],
        Job::Again { sweep: 1, segment } => vec![Job::Segment(segment - 1)],
        Job::Again { sweep, segment } => vec![Job::Again { sweep: sweep - 1, segment: segment - 1 }],
    }
}

fn events(spans: &[Span]) -> Vec<Value> {
    let us = |seconds: f64| (seconds * 1e6).round();
    let mut sessions: Vec<usize> = spans.iter().map(|span| span.session).collect();
    sessions.sort_unstable();
    sessions.dedup();
    let mut events: Vec<Value> = sessions
        .iter()
        .map(|session| {
            json!({"ph": "M", "name": "process_name", "pid": session, "tid": 0,
            "args": {"name": format!("session {session}")}})
        })
        .collect();
    for span in spans {
        events.push(json!({"ph": "X", "cat": "job", "name": span.job.name(), "pid": span.session, "tid": 0,
            "ts": us(span.begun_s), "dur": us(span.ended_s - span.begun_s), "args": {"steps": span.steps}}));
    }
    let mut arrows = 0;
    for span in spans {
        for source in sources(span.job) {
            // A job that was made again hands on what it made last before this one began. A segment may begin while the
            // coarse run is under way.
            let is_source = |other: &&Span| other.job == source && other.begun_s <= span.begun_s;
            let Some(from) = spans.iter().filter(is_source).next_back() else { continue };
            let leaves_s = from.ended_s.min(span.begun_s);
            let arrow = |phase: &str, pid: usize, at_s: f64| {
                json!({"ph": phase, "bp": "e", "cat": "state", "name": "state", "id": arrows, "pid": pid, "tid": 0,
                    "ts": us(at_s)})
            };
            events.extend([arrow("s", from.session, leaves_s), arrow("f", span.session, span.begun_s)]);
            arrows += 1;
        }
    }
    events
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrows_lead_from_where_states_come_from() {
        let span = |job, session, begun_s, ended_s| Span { job, session, begun_s, ended_s, steps: 7 };
        let spans = [
            span(Job::Segment(0), 1, 0.0, 4.0),
            span(Job::Coarse, 0, 0.0, 5.0),
            span(Job::Segment(1), 1, 4.0, 8.0),
            span(Job::Seam(1), 0, 8.0, 9.0),
        ];
        let events = events(&spans);
        let of = |phase: &str| events.iter().filter(|event| event["ph"] == phase).cloned().collect::<Vec<_>>();
        assert_eq!((of("M").len(), of("X").len()), (2, 4));
        let leaves: Vec<(f64, u64)> =
            of("s").iter().map(|arrow| (arrow["ts"].as_f64().unwrap(), arrow["pid"].as_u64().unwrap())).collect();
        // Segment 1 starts from the coarse run when that is at 4 s; the seam from the ends of both segments.
        assert_eq!(leaves, [(4e6, 0), (4e6, 1), (8e6, 1)]);
        assert_eq!(of("f").iter().map(|arrow| arrow["ts"].as_f64().unwrap()).collect::<Vec<_>>(), [4e6, 8e6, 8e6]);
        assert_eq!(of("X")[1]["name"], "coarse run");
    }
}
