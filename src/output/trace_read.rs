//! Reads `trace.json` back into events per step and rank. It accepts only files from [`super::TraceWriter`], with one
//! event per line. A truncated last line counts as the end of the file.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use thiserror::Error;

use crate::telemetry::{Activity, Event, EventName};
use crate::transport::RANKS_MAX;

/// Why a trace cannot be read.
#[derive(Debug, Error)]
pub enum TraceReadError {
    /// The file cannot be opened or read.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The trace.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// A line is not an event of a trace.
    #[error("{}, line {line}: not an event of a trace: {message}", path.display())]
    Line {
        /// The trace.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Description of the error.
        message: String,
    },
    /// The trace holds no events.
    #[error("{} holds no events: record some with `loomtree run --trace-steps N`", path.display())]
    Empty {
        /// The trace.
        path: PathBuf,
    },
}

#[derive(Deserialize)]
struct Slice<'a> {
    name: &'a str,
    cat: &'a str,
    pid: u32,
    ts: f64,
    dur: f64,
    args: Args,
}

#[derive(Deserialize)]
struct Args {
    step: u32,
    #[serde(default)]
    stage: u32,
    source: Option<u32>,
    vector: Option<u32>,
    asked_ts: Option<f64>,
    bytes: u64,
    flops: u64,
}

/// Events of every step and rank, in the order in which the rank executed or submitted them. Times count from the first
/// event. Events that this version does not know are skipped.
pub fn read_trace(path: &Path) -> Result<BTreeMap<u32, Vec<Vec<Event>>>, TraceReadError> {
    let io_error = |source| TraceReadError::Io { path: path.to_path_buf(), source };
    let mut reader = BufReader::with_capacity(1 << 20, File::open(path).map_err(io_error)?);
    let mut steps: BTreeMap<u32, Vec<Vec<Event>>> = BTreeMap::new();
    let (mut line, mut number, mut ranks) = (Vec::new(), 0, 0);
    loop {
        line.clear();
        number += 1;
        if reader.read_until(b'\n', &mut line).map_err(io_error)? == 0 {
            break;
        }
        let whole = line.ends_with(b"\n");
        let text = line.trim_ascii_end();
        let text = text.strip_suffix(b",").unwrap_or(text);
        if !text.starts_with(b"{\"ph\":\"X\"") {
            continue;
        }
        let fault = |message: String| TraceReadError::Line { path: path.to_path_buf(), line: number, message };
        let slice: Slice = match serde_json::from_slice(text) {
            Ok(slice) => slice,
            Err(_) if !whole => break,
            Err(error) => return Err(fault(error.to_string())),
        };
        if slice.pid as usize >= RANKS_MAX {
            return Err(fault(format!("rank {} is not within 0 and {}", slice.pid, RANKS_MAX - 1)));
        }
        let Some(event) = event_of(&slice) else { continue };
        ranks = ranks.max(slice.pid as usize + 1);
        let of_step = steps.entry(slice.args.step).or_default();
        if of_step.len() < ranks {
            of_step.resize_with(ranks, Vec::new);
        }
        of_step[slice.pid as usize].push(event);
    }
    if steps.is_empty() {
        return Err(TraceReadError::Empty { path: path.to_path_buf() });
    }
    for rank in steps.values_mut().flatten() {
        rank.sort_by_key(|event| (event.asked_ns, u64::MAX - event.end_ns));
    }
    Ok(steps)
}

fn event_of(slice: &Slice<'_>) -> Option<Event> {
    let name = EventName::from_text(slice.name)?;
    let activity = match slice.cat {
        "transfer" => Activity::Transfer,
        "wait" => Activity::Wait,
        _ => Activity::Compute,
    };
    let nanoseconds = |micros: f64| (micros * 1000.0).round() as u64;
    let (start_ns, length_ns) = (nanoseconds(slice.ts), nanoseconds(slice.dur));
    Some(Event {
        name: name as u32,
        activity: activity as u32,
        step: slice.args.step,
        stage: slice.args.stage,
        source: slice.args.source.unwrap_or(slice.pid),
        vector: slice.args.vector.unwrap_or(slice.pid),
        asked_ns: slice.args.asked_ts.map_or(start_ns, nanoseconds),
        start_ns,
        end_ns: start_ns.saturating_add(length_ns),
        bytes: slice.args.bytes,
        flops: slice.args.flops,
    })
}
