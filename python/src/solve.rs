//! Linear systems from the arrays of a SciPy matrix.

use std::io::{Cursor, Read};

use loomtree::linear_system::parse_block_csr;
use loomtree::{Launch, RunOptions, SolveOptions, SolveParams, SolvePlan};
use numpy::{PyArray1, PyReadonlyArray1, PyReadonlyArray3};
use pyo3::prelude::*;

use crate::options::options_of;
use crate::{bad_input, failed};

/// Solves A x = b. The matrix has 3x3 blocks in compressed rows (`offsets`, `columns`, `blocks`: rows of blocks + 1,
/// blocks, and blocks x 3 x 3 values), both triangles. `options`: workers, threads and executor, as JSON. Returns the
/// solution and the figures, as JSON.
#[pyfunction]
#[allow(clippy::too_many_arguments, reason = "arrays of one matrix, as Python holds them")]
pub(crate) fn solve<'py>(
    py: Python<'py>,
    offsets: PyReadonlyArray1<'py, u64>,
    columns: PyReadonlyArray1<'py, u32>,
    blocks: PyReadonlyArray3<'py, f64>,
    rhs: PyReadonlyArray1<'py, f64>,
    relative_tolerance: f64,
    max_iterations: u32,
    options: &str,
) -> PyResult<(Bound<'py, PyArray1<f64>>, String)> {
    if !(relative_tolerance > 0.0 && relative_tolerance < 1.0) {
        return Err(bad_input("rtol: expected a number between 0 and 1"));
    }
    let options: RunOptions = options_of(options)?;
    let (offsets, columns) = (offsets.as_slice()?, columns.as_slice()?);
    let (blocks, rhs) = (blocks.as_slice()?, rhs.as_slice()?);
    let rows = rhs.len() / 3;
    // The reader of the file format has all the checks, so the arrays pass for such a file.
    let mut header = b"CLTHBSR1".to_vec();
    header.extend((rows as u64).to_le_bytes());
    header.extend((columns.len() as u64).to_le_bytes());
    header.extend(3_u32.to_le_bytes());
    header.extend(8_u32.to_le_bytes());
    let parts: [&[u8]; 5] = [
        &header,
        bytemuck::cast_slice(offsets),
        bytemuck::cast_slice(columns),
        bytemuck::cast_slice(blocks),
        bytemuck::cast_slice(rhs),
    ];
    let bytes = parts.iter().map(|part| part.len() as u64).sum();
    let file = parts
        .into_iter()
        .fold(Box::new(std::io::empty()) as Box<dyn Read + Send>, |file, part| Box::new(file.chain(Cursor::new(part))));
    let (x, stats) = py.detach(move || {
        let (system, rhs) = parse_block_csr(file, bytes, "the matrix").map_err(bad_input)?;
        let workers = options.workers;
        let session = options.session();
        let params = SolveParams {
            relative_tolerance,
            max_iterations,
            host_threads: session.threads_of(1, Launch::Threads.machine().as_ref()),
            ..SolveParams::default()
        };
        let solve_options = SolveOptions { workers, params, ..SolveOptions::default() };
        let plan = SolvePlan::new(system, rhs, &solve_options).map_err(bad_input)?;
        let (order, scalar_rows) = (plan.order.clone(), plan.file_rows);
        let (results, executor) = loomtree::solve(plan, &session, &Launch::Threads)
            .map_err(|error| if error.is_bad_input() { bad_input(error) } else { failed(error) })?;
        let ranked: Vec<f64> = results.iter().flat_map(|result| result.x.iter().copied()).collect();
        let mut x = vec![0.0; scalar_rows];
        for (at, value) in ranked.into_iter().enumerate() {
            let row = order.as_ref().map_or(at, |order| order[at / 3] as usize * 3 + at % 3);
            if let Some(slot) = x.get_mut(row) {
                *slot = value;
            }
        }
        let stats = &results[0].stats;
        let figures = serde_json::json!({
            "iterations": stats.iterations,
            "converged": stats.converged,
            "relative_residual": stats.relative_residual,
            "refinements": stats.refinements,
            "preconditioner": stats.preconditioner,
            "seconds": stats.seconds,
            "bytes_exchanged": stats.bytes_exchanged,
            "executor": executor,
        });
        Ok::<_, PyErr>((x, figures.to_string()))
    })?;
    Ok((PyArray1::from_vec(py, x), stats))
}
