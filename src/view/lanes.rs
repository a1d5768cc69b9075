//! The trace of a step as lanes for the timeline, and the bytes between ranks.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::json;

use crate::output::read_trace;
use crate::telemetry::{Activity, Event, EventName};

/// Events of every step and rank.
pub(super) struct Lanes {
    steps: BTreeMap<u32, Vec<Vec<Event>>>,
}

impl Lanes {
    pub(super) fn load(path: &Path) -> Result<Lanes, String> {
        Ok(Lanes { steps: read_trace(path).map_err(|error| error.to_string())? })
    }

    /// Bytes that each rank received from each other one over all traced steps, and the number of these steps.
    pub(super) fn links(&self) -> serde_json::Value {
        let ranks = self.steps.values().map(Vec::len).max().unwrap_or(0);
        let mut bytes = vec![vec![0_u64; ranks]; ranks];
        let received = |rank: usize, event: &&Event| {
            event.activity == Activity::Transfer as u32 && event.source as usize != rank && event.bytes > 0
        };
        for step in self.steps.values() {
            for (rank, events) in step.iter().enumerate() {
                for event in events.iter().filter(|event| received(rank, event)) {
                    if let Some(link) = bytes.get_mut(event.source as usize) {
                        link[rank] += event.bytes;
                    }
                }
            }
        }
        let traced: Vec<u32> = self.steps.keys().copied().collect();
        json!({ "steps": traced, "bytes_from_to": bytes })
    }

    /// Slices of a step: of every rank a flat list of start, length (microseconds from the first event of the step),
    /// activity (0 computed, 1 transferred, 2 waited), name (index into `names`), transfer stage, source.
    pub(super) fn step(&self, step: u32) -> Option<serde_json::Value> {
        let ranks = self.steps.get(&step)?;
        let slices = |events: &[Event]| -> Vec<Event> {
            events.iter().filter(|event| event.name != EventName::Step as u32).copied().collect()
        };
        let ranks: Vec<Vec<Event>> = ranks.iter().map(|events| slices(events)).collect();
        let begin_ns = ranks.iter().flatten().map(|event| event.start_ns).min()?;
        let end_ns = ranks.iter().flatten().map(|event| event.end_ns).max()?;
        let micros = |ns: u64| (ns.saturating_sub(begin_ns)) as f64 / 1e3;
        let mut names: Vec<&str> = Vec::new();
        let mut lanes = Vec::new();
        for events in &ranks {
            let mut flat = Vec::with_capacity(6 * events.len());
            for event in events {
                let text = EventName::from_number(event.name).map_or("unknown", EventName::text);
                let name = names.iter().position(|known| *known == text).unwrap_or_else(|| {
                    names.push(text);
                    names.len() - 1
                });
                let length = (event.end_ns - event.start_ns) as f64 / 1e3;
                flat.extend([micros(event.start_ns), length, f64::from(event.activity), name as f64]);
                flat.extend([f64::from(event.stage), f64::from(event.source)]);
            }
            lanes.push(flat);
        }
        Some(json!({ "step": step, "length_us": micros(end_ns), "names": names, "lanes": lanes }))
    }
}
