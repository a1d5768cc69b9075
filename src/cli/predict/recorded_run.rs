//! A run that recorded events, and its steps re-timed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::cli::CliError;
use crate::interconnect::{ProductExchange, RecordedStep, Replay, ReplayedStep, replay};
use crate::output::{Report, read_trace};
use crate::telemetry::Event;

/// Report and trace of a run.
pub(crate) struct RecordedRun {
    trace: PathBuf,
    /// Its report.
    pub report: Report,
    /// Ranks that recorded events.
    pub ranks: usize,
    /// Of every recorded step and rank.
    events: BTreeMap<u32, Vec<Vec<Event>>>,
}

impl RecordedRun {
    /// Reads the files of the run directory `run`.
    pub(crate) fn read(run: &Path) -> Result<RecordedRun, CliError> {
        let trace = run.join("trace.json");
        let (report, events) = std::thread::scope(|scope| {
            let events = scope.spawn(|| read_trace(&trace));
            (Report::load(&run.join("report.json")), events.join())
        });
        let report = report.map_err(CliError::bad_input)?;
        if !report.segments.is_empty() {
            return Err(CliError::bad_input(format!(
                "{} is split in time; this re-times the steps of a plain run (--segments 1), and `loomtree bench time` \
                 plays splits, with --ranks in space and time",
                run.display()
            )));
        }
        let events = events.map_err(|_| CliError::failed("reading the trace failed"))?.map_err(CliError::bad_input)?;
        let ranks = events.values().map(Vec::len).max().unwrap_or(0);
        Ok(RecordedRun { trace, report, ranks, events })
    }

    /// Rows of the whole vector.
    ///
    /// # Errors
    /// The report names fewer vertices than the trace has ranks.
    pub(crate) fn rows(&self) -> Result<usize, CliError> {
        let (rows, ranks) = (self.report.header.vertices, self.ranks);
        if rows < ranks {
            let path = self.trace.with_file_name("report.json");
            let message = format!("{}: vertices must be at least {ranks}, got {rows}", path.display());
            return Err(CliError::bad_input(message));
        }
        Ok(rows)
    }

    /// Exchange mode of its products.
    pub(crate) fn exchange(&self) -> ProductExchange {
        match self.report.header.exchange.as_str() {
            "full" => ProductExchange::Full,
            _ => ProductExchange::Halo,
        }
    }

    /// All recorded steps on another machine, ascending; the first one with its tasks.
    pub(crate) fn replay(&self, how: &Replay<'_>) -> Result<Vec<ReplayedStep>, CliError> {
        let (first, ranks) = (self.events.keys().next().copied(), self.ranks);
        let fault = |error: &dyn std::fmt::Display| CliError::bad_input(format!("{}: {error}", self.trace.display()));
        self.events
            .par_iter()
            .map(|(step, events)| {
                if events.len() != ranks {
                    return Err(fault(&format_args!("step {step} has events of {} ranks of {ranks}", events.len())));
                }
                let recorded = RecordedStep::of_events(*step, events).map_err(|error| fault(&error))?;
                replay(&recorded, how, Some(*step) == first).map_err(|error| CliError::failed(error.to_string()))
            })
            .collect()
    }
}
