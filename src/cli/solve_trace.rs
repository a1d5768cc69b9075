//! Output of `loomtree solve --trace`: a folder with `report.json` and `trace.json`, in which every solve is a step.
//! `loomtree predict` accepts it like a run directory.

use std::path::{Path, PathBuf};

use super::CliError;
use crate::linear_system::SolveResult;
use crate::output::{RankEvents, ReportHeader, ReportWriter, Status, StepRecord, TraceWriter, WriteError};
use crate::step::StageSeconds;

/// Limit of the solves whose events are kept, the same as for the steps of a run.
pub(super) const SOLVES_MOST: u32 = 20;

/// A writable folder that holds no run.
#[derive(Clone, Debug)]
pub(super) struct TraceFolder {
    path: PathBuf,
}

impl TraceFolder {
    /// Creates the folder. Existing files are not replaced.
    ///
    /// # Errors
    /// The path is a file, the folder holds a run or a trace, or it cannot be written to.
    pub(super) fn new(path: &Path) -> Result<TraceFolder, CliError> {
        let refused = |what: &str| CliError::bad_input(format!("--trace {}: {what}", path.display()));
        if path.exists() && !path.is_dir() {
            return Err(refused("is a file; name a folder"));
        }
        if ["report.json", "trace.json"].iter().any(|name| path.join(name).exists()) {
            return Err(refused("already holds a report or a trace; choose another folder"));
        }
        let made = std::fs::create_dir_all(path).and_then(|()| tempfile::tempfile_in(path));
        made.map_err(|error| refused(&format!("cannot be written to: {error}")))?;
        Ok(TraceFolder { path: path.to_path_buf() })
    }

    /// Writes both files. `header` gives scene, exchange, schedule, topology and sizes of the solve; the other fields
    /// are filled in here.
    ///
    /// # Errors
    /// A file cannot be written.
    pub(super) fn write(&self, header: ReportHeader, executor: &str, results: &[SolveResult]) -> Result<(), CliError> {
        let written = self.write_report(header, executor, results).and_then(|()| self.write_trace(results));
        written.map_err(|error| CliError::bad_input(format!("--trace: {error}")))
    }

    fn write_report(&self, header: ReportHeader, executor: &str, results: &[SolveResult]) -> Result<(), WriteError> {
        let stats = &results[0].stats;
        let header = ReportHeader {
            workers: results.len(),
            executor: executor.to_string(),
            devices: results.iter().map(|result| result.record.device.clone()).collect(),
            preconditioner: stats.preconditioner.name().into(),
            ..header
        };
        let mut writer = ReportWriter::create(&self.path.join("report.json"), header)?;
        for (step, &seconds) in (1..).zip(&stats.seconds) {
            writer.step(StepRecord {
                step,
                iterations: stats.iterations,
                residual: stats.relative_residual,
                converged: stats.converged,
                stage_seconds: StageSeconds { solve: seconds, total: seconds, ..StageSeconds::default() },
                bytes_moved: stats.bytes_exchanged,
                bytes_per_spmv: stats.product_bytes / u64::from(stats.products.max(1)),
                memory_bytes_per_rank: results.iter().map(|result| result.record.memory_bytes).collect(),
                ..StepRecord::default()
            });
        }
        writer.finish(Status::Done).map(|_| ())
    }

    fn write_trace(&self, results: &[SolveResult]) -> Result<(), WriteError> {
        let records = || results.iter().map(|result| &result.record);
        let devices: Vec<String> = records().map(|record| record.device.clone()).collect();
        let base = records().map(|record| record.epoch_unix_ns).min().unwrap_or(0);
        let ranks: Vec<RankEvents<'_>> = records()
            .enumerate()
            .map(|(rank, record)| RankEvents { rank, epoch_unix_ns: record.epoch_unix_ns, events: &record.events })
            .collect();
        TraceWriter::create(&self.path.join("trace.json"), &devices, base)?.append(&ranks)
    }
}
