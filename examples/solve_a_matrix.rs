//! Solves a Matrix Market system on 2 ranks (threads of this process); the right-hand side is A times ones.
//!
//! `cargo run --release --example solve_a_matrix -- [MATRIX.mtx]`

use std::error::Error;
use std::path::Path;

use loomtree::{Launch, SessionOptions, SolveOptions, SolvePlan, parse_matrix_market, read_system, solve};

/// -1 2 -1 on three rows: symmetric, lower triangle stored.
const SMALL: &str = "%%MatrixMarket matrix coordinate real symmetric\n3 3 5\n1 1 2\n2 2 2\n3 3 2\n2 1 -1\n3 2 -1\n";

fn main() -> Result<(), Box<dyn Error>> {
    let system = match std::env::args().nth(1) {
        Some(file) => read_system(Path::new(&file))?.0,
        None => parse_matrix_market(SMALL.as_bytes(), SMALL.len() as u64, "small.mtx")?,
    };
    let workers = system.block_rows().min(2);
    let rhs = system.times_ones();
    let plan = SolvePlan::new(system, rhs, &SolveOptions { workers, ..SolveOptions::default() })?;
    let options = SessionOptions { workers, ..SessionOptions::default() };
    let (results, executor) = solve(plan, &options, &Launch::Threads)?;
    let stats = &results[0].stats;
    println!("{executor}: {} iterations, |b - A x| / |b| = {:.1e}", stats.iterations, stats.relative_residual);
    Ok(())
}
