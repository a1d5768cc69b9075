//! A run that recorded events, and its steps re-timed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::cli::CliError;
use crate::interconnect::{Crossing, ProductExchange, RecordedStep, Replay, ReplayedStep, crossing, replay};
use crate::output::{Report, RunDirectory, read_trace};
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
        let recorded = RecordedRun::read_any(run)?;
        if !recorded.report.segments.is_empty() {
            return Err(CliError::bad_input(format!(
                "{} is split in time; this takes the steps of a plain run (--segments 1)",
                run.display()
            )));
        }
        Ok(recorded)
    }

    /// As [`RecordedRun::read`], also of a shot that is split in time: its recorded steps are those of its first
    /// segment, in a file of their own.
    pub(crate) fn read_any(run: &Path) -> Result<RecordedRun, CliError> {
        let of_split = run.join("trace_steps.json");
        let trace = if of_split.is_file() { of_split } else { RunDirectory::trace_in(run) };
        let (report, events) = std::thread::scope(|scope| {
            let events = scope.spawn(|| read_trace(&trace));
            (Report::load(&run.join("report.json")), events.join())
        });
        let report = report.map_err(CliError::bad_input)?;
        if !report.segments.is_empty() && !trace.ends_with("trace_steps.json") {
            return Err(CliError::bad_input(format!(
                "{} has no events of its steps (trace_steps.json): split the shot again with --trace-steps",
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
        let first = self.events.keys().next().copied();
        self.events
            .par_iter()
            .map(|(step, events)| {
                let recorded = self.recorded(*step, events)?;
                replay(&recorded, how, Some(*step) == first).map_err(|error| CliError::failed(error.to_string()))
            })
            .collect()
    }

    /// What the recorded steps send between `hosts` (by rank), if there are several.
    pub(crate) fn between(&self, hosts: &[usize], exchange: ProductExchange) -> Result<Option<BetweenHosts>, CliError> {
        if hosts.iter().all(|host| *host == hosts[0]) {
            return Ok(None);
        }
        let each = |(step, events)| Ok(crossing(&self.recorded(step, events)?, hosts, exchange));
        let steps: Vec<_> =
            self.events.iter().map(|(&step, events)| each((step, events))).collect::<Result<_, CliError>>()?;
        let (mut whole, mut products, mut count) = (Crossing::default(), Crossing::default(), 0);
        for (of_step, of_products, number) in &steps {
            (whole, products, count) = (whole.plus(*of_step), products.plus(*of_products), count + number);
        }
        let per_step = whole.over(steps.len());
        Ok(Some(BetweenHosts {
            per_step,
            per_product: products.over(count),
            products: count as f64 / steps.len() as f64,
        }))
    }

    fn recorded(&self, step: u32, events: &[Vec<Event>]) -> Result<RecordedStep, CliError> {
        let fault = |error: &dyn std::fmt::Display| CliError::bad_input(format!("{}: {error}", self.trace.display()));
        if events.len() != self.ranks {
            return Err(fault(&format_args!("step {step} has events of {} ranks of {}", events.len(), self.ranks)));
        }
        RecordedStep::of_events(step, events).map_err(|error| fault(&error))
    }
}

/// What the hosts of a prediction send each other, all directions together.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub(crate) struct BetweenHosts {
    per_step: Crossing,
    per_product: Crossing,
    /// Products of a step.
    products: f64,
}

impl BetweenHosts {
    /// For the user.
    pub(crate) fn sentence(&self) -> String {
        let BetweenHosts { per_step, per_product, products } = self;
        let kb = |bytes: f64| bytes / 1e3;
        format!(
            "{:.1} kB per step in {:.0} messages, {:.1} kB on the wire; each of {products:.0} products {:.2} kB in \
             {:.0} messages, {:.2} kB on the wire",
            kb(per_step.payload_bytes),
            per_step.messages,
            kb(per_step.wire_bytes),
            kb(per_product.payload_bytes),
            per_product.messages,
            kb(per_product.wire_bytes)
        )
    }
}
