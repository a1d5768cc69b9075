//! `trace.json` for ui.perfetto.dev and chrome://tracing: a process per rank with tracks for steps, computing,
//! transfers and waiting, and arrows from each published message to its reception.
//!
//! The file is a JSON array that is closed again after every step, so it can be opened at any time. If the process dies
//! during a write, only the closing bracket is missing, which both viewers accept. Slices of one track never overlap.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::atomic::WriteError;
use crate::telemetry::{Activity, Event, EventName};

/// Events of one rank, with the reference time of their nanoseconds.
#[derive(Clone, Copy, Debug)]
pub struct RankEvents<'a> {
    /// Rank.
    pub rank: usize,
    /// `Recorder::epoch_unix_ns` of the rank.
    pub epoch_unix_ns: u64,
    /// Recorded events, in any order.
    pub events: &'a [Event],
}

/// Kinds of tracks, in display order.
const TRACKS: [&str; 4] = ["step", "compute", "transfer", "wait"];
/// Limit of tracks of one kind per rank, needed when events of that kind overlap.
const LANES: usize = 64;
/// Text after the last event.
const END: &[u8] = b"\n]\n";

/// Position of a slice.
#[derive(Clone, Copy)]
struct Place {
    rank: usize,
    tid: usize,
    start_ns: i128,
    end_ns: i128,
}

/// Appends steps to a trace.
pub struct TraceWriter {
    path: PathBuf,
    file: File,
    base_unix_ns: u64,
    /// For every rank and kind: the end of the last slice on each track, nanoseconds.
    lanes: Vec<[Vec<i128>; TRACKS.len()]>,
    arrows: u64,
    empty: bool,
    buffer: Vec<u8>,
}

impl TraceWriter {
    /// Starts a trace of ranks on `devices` (one name per rank). Time 0 is `base_unix_ns`, for example the smallest
    /// epoch of the ranks.
    pub fn create(path: &Path, devices: &[String], base_unix_ns: u64) -> Result<TraceWriter, WriteError> {
        let file = File::create(path).map_err(WriteError::at(path))?;
        let mut writer = TraceWriter {
            path: path.to_path_buf(),
            file,
            base_unix_ns,
            lanes: Vec::new(),
            arrows: 0,
            empty: true,
            buffer: b"[".to_vec(),
        };
        writer.name_ranks(0, devices, "");
        writer.buffer.extend_from_slice(END);
        let buffer = std::mem::take(&mut writer.buffer);
        writer.file.write_all(&buffer).map_err(WriteError::at(path))?;
        Ok(writer)
    }

    /// Adds the ranks of another session: rank r of session s is rank s * n + r of the trace, for n ranks a session.
    pub fn add_session(&mut self, session: usize, devices: &[String]) -> Result<(), WriteError> {
        self.name_ranks(session * devices.len(), devices, &format!("session {session} "));
        self.append(&[])
    }

    fn name_ranks(&mut self, first: usize, devices: &[String], session: &str) {
        for (rank, device) in devices.iter().enumerate() {
            let name = serde_json::Value::from(format!("{session}rank {rank} ({device})"));
            let pid = first + rank;
            self.entry(format_args!(
                r#"{{"ph":"M","name":"process_name","pid":{pid},"tid":0,"args":{{"name":{name}}}}}"#
            ));
            self.entry(format_args!(
                r#"{{"ph":"M","name":"process_sort_index","pid":{pid},"tid":0,"args":{{"sort_index":{pid}}}}}"#
            ));
        }
    }

    /// Appends the events of all ranks from one or several steps. Arrows connect events of one call only.
    pub fn append(&mut self, ranks: &[RankEvents<'_>]) -> Result<(), WriteError> {
        let mut flows = Flows::default();
        for rank in ranks {
            self.append_rank(rank, &mut flows);
        }
        for (from, to) in flows.pairs() {
            self.arrows += 1;
            // "s" binds to the enclosing slice; "e" makes the arrow end at the enclosing slice instead of the next one.
            let (id, start, end) = (self.arrows, self.micros(from.end_ns - 1), self.micros(to.end_ns - 1));
            let (from_pid, from_tid, to_pid, to_tid) = (from.rank, from.tid, to.rank, to.tid);
            self.entry(format_args!(
                r#"{{"ph":"s","name":"sub-vector","cat":"flow","id":{id},"pid":{from_pid},"tid":{from_tid},"ts":{start}}}"#
            ));
            self.entry(format_args!(
                r#"{{"ph":"f","bp":"e","name":"sub-vector","cat":"flow","id":{id},"pid":{to_pid},"tid":{to_tid},"ts":{end}}}"#
            ));
        }
        if self.buffer.is_empty() {
            return Ok(());
        }
        self.buffer.extend_from_slice(END);
        let mut put = || -> io::Result<()> {
            self.file.seek(SeekFrom::End(-(END.len() as i64)))?;
            self.file.write_all(&self.buffer)
        };
        let result = put().map_err(WriteError::at(&self.path));
        self.buffer.clear();
        result
    }

    fn append_rank(&mut self, rank: &RankEvents<'_>, flows: &mut Flows) {
        let shift = i128::from(rank.epoch_unix_ns) - i128::from(self.base_unix_ns);
        let mut order: Vec<&Event> = rank.events.iter().collect();
        // Of two slices with the same start, the longer one encloses the other.
        order.sort_by_key(|event| (event.start_ns, u64::MAX - event.end_ns));
        for event in order {
            let (start_ns, end_ns) = (shift + i128::from(event.start_ns), shift + i128::from(event.end_ns));
            let end_ns = end_ns.max(start_ns);
            let tid = self.lane(rank.rank, kind(event), start_ns, end_ns);
            self.slice(rank.rank, tid, event, start_ns, end_ns);
            flows.note(event, Place { rank: rank.rank, tid, start_ns, end_ns });
        }
    }

    /// The first track of this kind that is free at `start_ns`. A new track is announced in the file.
    fn lane(&mut self, rank: usize, kind: usize, start_ns: i128, end_ns: i128) -> usize {
        if self.lanes.len() <= rank {
            self.lanes.resize_with(rank + 1, Default::default);
        }
        let lanes = &mut self.lanes[rank][kind];
        if let Some(lane) = lanes.iter().position(|filled_ns| *filled_ns <= start_ns) {
            lanes[lane] = end_ns;
            return kind * LANES + lane;
        }
        lanes.push(end_ns);
        let lane = lanes.len() - 1;
        let tid = kind * LANES + lane;
        let name = TRACKS[kind];
        let number = if lane == 0 { String::new() } else { format!(" {}", lane + 1) };
        self.entry(format_args!(
            r#"{{"ph":"M","name":"thread_name","pid":{rank},"tid":{tid},"args":{{"name":"{name}{number}"}}}}"#
        ));
        self.entry(format_args!(
            r#"{{"ph":"M","name":"thread_sort_index","pid":{rank},"tid":{tid},"args":{{"sort_index":{tid}}}}}"#
        ));
        tid
    }

    fn slice(&mut self, rank: usize, tid: usize, event: &Event, start_ns: i128, end_ns: i128) {
        let name = EventName::from_number(event.name).map_or("unknown", EventName::text);
        let category = TRACKS[kind(event)];
        let asked_ns = start_ns + i128::from(event.asked_ns) - i128::from(event.start_ns);
        let (ts, dur) = (self.micros(start_ns), self.micros(end_ns - start_ns));
        let Event { step, stage, source, vector, bytes, flops, .. } = *event;
        // A block product keeps its route, because that names the sub-vector that it multiplies.
        let plain = event.activity == Activity::Compute as u32 && event.name != EventName::SpmvBlock as u32;
        let route = match plain {
            true => String::new(),
            false => format!(r#","stage":{stage},"source":{source},"vector":{vector}"#),
        };
        let asked = match event.asked_ns == event.start_ns {
            true => String::new(),
            false => format!(r#","asked_ts":{}"#, self.micros(asked_ns)),
        };
        self.entry(format_args!(
            r#"{{"ph":"X","name":"{name}","cat":"{category}","pid":{rank},"tid":{tid},"ts":{ts},"dur":{dur},"args":{{"step":{step}{route}{asked},"bytes":{bytes},"flops":{flops}}}}}"#
        ));
    }

    fn entry(&mut self, text: std::fmt::Arguments<'_>) {
        self.buffer.extend_from_slice(if self.empty { b"\n" } else { b",\n" });
        self.empty = false;
        // Writing to a Vec cannot fail.
        let _ = self.buffer.write_fmt(text);
    }

    fn micros(&self, ns: i128) -> Micros {
        Micros(ns)
    }
}

/// Index into [`TRACKS`].
fn kind(event: &Event) -> usize {
    match event.activity {
        _ if event.name == EventName::Step as u32 => 0,
        a if a == Activity::Transfer as u32 => 2,
        a if a == Activity::Wait as u32 => 3,
        _ => 1,
    }
}

/// Nanoseconds, printed exactly as microseconds.
struct Micros(i128);

impl std::fmt::Display for Micros {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sign = if self.0 < 0 { "-" } else { "" };
        let ns = self.0.unsigned_abs();
        write!(f, "{sign}{}.{:03}", ns / 1000, ns % 1000)
    }
}

/// Matches publications with receptions. Every rank records the beginning of every exchange, even if nobody reads its
/// message. So a reception belongs to the exchange that the receiver began last. If that is its k-th exchange of this
/// name in the step, the source is its k-th exchange too.
#[derive(Default)]
struct Flows {
    /// Position of the source in each exchange. None for a publication of zero length, because an arrow cannot start
    /// there.
    begun: HashMap<Exchanges, Vec<Option<Place>>>,
    /// Source exchange, index of the exchange, receiving rank and position.
    received: Vec<(Exchanges, usize, u32, Place)>,
}

/// Step, name of the publication, publishing rank.
type Exchanges = (u32, u32, u32);

impl Flows {
    /// Adds the events of a rank in the order in which it recorded them.
    fn note(&mut self, event: &Event, place: Place) {
        if event.activity != Activity::Transfer as u32 {
            return;
        }
        let Some(name) = EventName::from_number(event.name) else { return };
        let (rank, shown) = (place.rank as u32, place.end_ns > place.start_ns);
        if name == EventName::Publish || name.is_share() && event.vector == rank {
            self.begun.entry((event.step, event.name, rank)).or_default().push(Some(place).filter(|_| shown));
        } else if (name == EventName::Receive || name.is_share()) && event.vector != rank && shown {
            let begins = if name.is_share() { name } else { EventName::Publish } as u32;
            let begun = self.begun.get(&(event.step, begins, rank)).map_or(0, Vec::len);
            // A reception before any exchange is skipped, because the beginning of its exchange was not recorded.
            if let Some(exchange) = begun.checked_sub(1) {
                self.received.push(((event.step, begins, event.vector), exchange, rank, place));
            }
        }
    }

    /// The pairs in a fixed order. If two ranks began different numbers of exchanges (an event was not recorded), the
    /// pairs are unknown and no arrow is drawn.
    fn pairs(self) -> Vec<(Place, Place)> {
        let mut pairs = Vec::new();
        for ((step, name, owner), exchange, rank, to) in &self.received {
            let Some(of_owner) = self.begun.get(&(*step, *name, *owner)) else { continue };
            let as_many = self.begun.get(&(*step, *name, *rank)).is_some_and(|own| own.len() == of_owner.len());
            let from = of_owner.get(*exchange).copied().flatten();
            pairs.extend(from.filter(|from| as_many && from.start_ns <= to.end_ns).map(|from| (from, *to)));
        }
        pairs.sort_by_key(|(from, to)| (from.start_ns, from.rank, to.rank, to.start_ns));
        pairs
    }
}
