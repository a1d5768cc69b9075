//! Output of `loomtree solve`: the solution in a file, the report as JSON on stdout, and the header of a trace's
//! report.

use std::path::PathBuf;

use serde::Serialize;

use super::solve_trace::TraceFolder;
use super::{CliError, print};
use crate::interconnect::ScheduleKind;
use crate::linear_system::{SolveEnd, SolveResult, write_solution};
use crate::math::DIM;
use crate::os::console::note;
use crate::output::{ReportHeader, write_atomically};
use crate::solver::ExchangeMode;

/// Data for the report besides the results.
pub(super) struct SolveFacts {
    pub(super) rows: usize,
    pub(super) block_rows: usize,
    pub(super) workers: usize,
    pub(super) exchange: ExchangeMode,
    pub(super) schedule: ScheduleKind,
    pub(super) rtol: f64,
    pub(super) solution: Option<PathBuf>,
    pub(super) order: Option<Vec<u32>>,
    pub(super) matrix: PathBuf,
    pub(super) topology: String,
    pub(super) trace: Option<TraceFolder>,
}

impl SolveFacts {
    /// The header of the trace's report.
    pub(super) fn header(&self) -> ReportHeader {
        ReportHeader {
            scene: self.matrix.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
            exchange: format!("{:?}", self.exchange).to_lowercase(),
            schedule: self.schedule.name().to_string(),
            topology: self.topology.clone(),
            vertices: self.block_rows,
            ..ReportHeader::now()
        }
    }
}

/// The JSON on stdout. The first six names are a stable interface.
#[derive(Debug, Serialize)]
pub(super) struct SolveReport {
    /// Rows of the matrix in the file.
    pub rows: usize,
    /// PCG iterations.
    pub iterations: u32,
    /// True if the residual met the tolerance.
    pub converged: bool,
    /// |b - A x| / |b| in double precision.
    pub relative_residual: f64,
    /// Seconds of the solve, including the set-up of the preconditioner (median if repeated).
    pub seconds: f64,
    /// Bytes that all workers received from each other in one solve.
    pub bytes_exchanged: u64,
    workers: usize,
    executor: String,
    exchange: ExchangeMode,
    schedule: &'static str,
    preconditioner: &'static str,
    block_rows: usize,
    blocks: u64,
    /// Ratio of block slots (including padding) to stored blocks.
    padding_ratio: f64,
    /// Matrix-vector products.
    products: u32,
    /// Corrections solved after the first PCG.
    refinements: u32,
    /// The part of the iterations in double precision.
    double_precision_iterations: u32,
    /// Bytes received by all workers per product.
    bytes_per_product: f64,
    milliseconds_per_iteration: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    seconds_best: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    milliseconds_per_iteration_best: Option<f64>,
    /// Milliseconds of one product (best time).
    #[serde(skip_serializing_if = "Option::is_none")]
    spmv_ms: Option<f64>,
    /// Bytes that the kernels of all workers move in a product, divided by its time.
    #[serde(skip_serializing_if = "Option::is_none")]
    spmv_gb_s: Option<f64>,
}

/// Writes the solution if requested and prints the report.
///
/// # Errors
/// The solution cannot be written, or the solve did not converge.
pub(super) fn report(facts: &SolveFacts, executor: &str, results: &[SolveResult]) -> Result<(), CliError> {
    if let Some(path) = &facts.solution {
        let mut x: Vec<f64> = results.iter().flat_map(|result| result.x.iter().copied()).collect();
        debug_assert_eq!(x.len(), facts.block_rows * DIM);
        if let Some(order) = &facts.order {
            let mut in_file = vec![0.0; x.len()];
            for (from, &to) in x.as_chunks::<DIM>().0.iter().zip(order) {
                in_file[to as usize * DIM..][..DIM].copy_from_slice(from);
            }
            x = in_file;
        }
        x.truncate(facts.rows);
        write_atomically(path, |out| write_solution(out, &x)).map_err(CliError::bad_input)?;
    }
    let report = SolveReport::new(facts, executor, results);
    let json = serde_json::to_string_pretty(&report);
    let json = json.map_err(|error| CliError::failed(format!("cannot print the report: {error}")))?;
    print(&(json + "\n"))?;
    if report.double_precision_iterations > 0 {
        note(format_args!(
            "{}: single precision cannot solve this system; {} of {} iterations were in double precision",
            facts.matrix.display(),
            report.double_precision_iterations,
            report.iterations
        ));
    }
    if report.converged {
        return Ok(());
    }
    Err(CliError::failed(format!(
        "{}: not converged: relative residual {:.3e} after {} iterations, above {:e}; {}",
        facts.matrix.display(),
        report.relative_residual,
        report.iterations,
        facts.rtol,
        why(results[0].stats.end)
    )))
}

/// Why a solve did not converge, and what to do about it.
fn why(end: SolveEnd) -> String {
    match end {
        SolveEnd::Converged | SolveEnd::Limit => "--max-iterations allows more".into(),
        SolveEnd::NotPositiveDefinite { curvature } => {
            format!("the matrix is not positive definite: p'Ap = {curvature:.3e}")
        }
        SolveEnd::Singular => {
            "the matrix is singular within double precision, and the right-hand side has no solution".into()
        }
        SolveEnd::SinglePrecision => "the matrix is too ill-conditioned for the single precision of this device; \
             --executor cpu goes on in double precision"
            .into(),
        SolveEnd::DoublePrecision => "the matrix is too ill-conditioned for double precision".into(),
    }
}

impl SolveReport {
    fn new(facts: &SolveFacts, executor: &str, results: &[SolveResult]) -> SolveReport {
        let stats = &results[0].stats;
        let mut seconds = stats.seconds.clone();
        seconds.sort_by(f64::total_cmp);
        let (median, best) = (seconds[seconds.len() / 2], seconds[0]);
        let per_iteration = |seconds: f64| seconds * 1e3 / stats.iterations.max(1) as f64;
        let repeated = |value: f64| (seconds.len() > 1).then_some(value);
        SolveReport {
            rows: facts.rows,
            iterations: stats.iterations,
            converged: stats.converged,
            relative_residual: stats.relative_residual,
            seconds: median,
            bytes_exchanged: stats.bytes_exchanged,
            workers: facts.workers,
            executor: executor.to_string(),
            exchange: facts.exchange,
            schedule: facts.schedule.name(),
            preconditioner: stats.preconditioner.name(),
            block_rows: facts.block_rows,
            blocks: stats.blocks,
            padding_ratio: stats.slots as f64 / stats.blocks as f64,
            products: stats.products,
            refinements: stats.refinements,
            double_precision_iterations: stats.double_iterations,
            bytes_per_product: stats.product_bytes as f64 / stats.products.max(1) as f64,
            milliseconds_per_iteration: per_iteration(median),
            seconds_best: repeated(best),
            milliseconds_per_iteration_best: repeated(per_iteration(best)),
            spmv_ms: stats.product.map(|(seconds, _)| seconds * 1e3),
            spmv_gb_s: stats.product.map(|(seconds, bytes)| bytes as f64 / seconds * 1e-9),
        }
    }
}
