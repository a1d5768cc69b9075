//! Shared parts of the benchmarks: options, parsers of their values, medians, the machine of modeled figures.

use std::path::{Path, PathBuf};

use crate::cli::CliError;
use crate::gpu::Executor;
use crate::interconnect::Topology;
use crate::protocol::{BindCores, ExecutorChoice, WorkerSetup};

/// Options that all benchmarks share.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct Common {
    /// What runs the kernels
    #[arg(long, value_enum, default_value = "cpu")]
    pub executor: ExecutorChoice,
    /// Threads of each worker on the cpu executor
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: u16,
    /// Also write the table as JSON and CSV (and as SVG where it is a curve) into this folder
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

impl Common {
    /// The executor that the options name, for one rank.
    pub(super) fn executor(&self) -> Result<Executor, CliError> {
        let setup = WorkerSetup {
            executor: self.executor,
            adapter: None,
            threads: self.threads as usize,
            bind_cores: BindCores::Auto,
            ranks: 1,
            place: 0,
            places: 1,
            epoch: 0,
            max_message_values: 0,
            patience_s: 0.0,
            links: None,
        };
        crate::worker::make_executor(&setup, 0).map_err(CliError::bad_input)
    }
}

/// The middle value; the upper one of two; NaN without values. Sorts them.
pub(super) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// The machine of modeled figures: that of a topology file, or a balanced tree for `gpus` ranks.
pub(super) fn machine(file: Option<&Path>, gpus: usize) -> Result<Topology, CliError> {
    let made = || Topology::default_for(gpus).map_err(CliError::bad_input);
    file.map_or_else(made, |file| Topology::read(file).map_err(CliError::bad_input))
}

/// Parses a number above 0 and below a million.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value < 1e6 => Ok(value),
        _ => Err("expected a positive number".to_string()),
    }
}

/// Parses a number of workers.
pub(super) fn worker_counts(text: &str) -> Result<usize, String> {
    match text.parse::<usize>() {
        Ok(n) if (1..=crate::transport::RANKS_MAX).contains(&n) => Ok(n),
        _ => Err(format!("expected numbers of workers from 1 to {}, separated by commas", crate::transport::RANKS_MAX)),
    }
}
