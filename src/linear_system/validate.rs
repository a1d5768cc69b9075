//! Checks of every matrix before a solve: finite values, symmetry, a positive diagonal within the range of single
//! precision, and no diagonal block with a negative eigenvalue. The solve itself detects other indefinite matrices.

use super::precondition::{Pivots, pivots};
use super::system::{BlockSystem, Values};
use crate::assembly::sell::BLOCK;
use crate::math::DIM;

/// Smallest diagonal value relative to the largest. Below it the f32 copy of the matrix would underflow.
const SMALLEST_DIAGONAL: f64 = 1e-24;

/// Checks and completes a matrix; `values` are those of the file. The diagonal of padding rows (rows past
/// `scalar_rows`) is set to the largest diagonal value, so that padding does not widen the range of values. Their
/// solution is 0.
///
/// # Errors
/// A sentence about the first fault, with rows and columns counted from 1.
pub(super) fn validated(
    scalar_rows: usize,
    offsets: Vec<u32>,
    columns: Vec<u32>,
    values: Values,
) -> Result<BlockSystem, String> {
    let mut system = BlockSystem { scalar_rows, offsets, columns, values, largest_diagonal: 0.0 };
    finite(&system)?;
    let diagonal = diagonal_blocks(&system)?;
    let mut largest = (0.0f64, 0);
    let mut smallest = (f64::INFINITY, 0);
    for row in 0..scalar_rows {
        let value = system.values.get(diagonal[row / DIM] as usize * BLOCK + row % DIM * 4);
        if value <= 0.0 {
            let found = if value == 0.0 { "missing or zero".to_string() } else { format!("{value:e}") };
            return Err(format!(
                "row {0}, column {0}: the diagonal value is {found}; it must be positive, as in every symmetric positive definite matrix",
                row + 1
            ));
        }
        if value > largest.0 {
            largest = (value, row);
        }
        if value < smallest.0 {
            smallest = (value, row);
        }
    }
    if smallest.0 < largest.0 * SMALLEST_DIAGONAL {
        return Err(format!(
            "the diagonal spans from {:e} (row {}) to {:e} (row {}); the solver takes at most a factor of 1e24: scale rows and columns",
            smallest.0,
            smallest.1 + 1,
            largest.0,
            largest.1 + 1
        ));
    }
    system.largest_diagonal = largest.0;
    let padding = scalar_rows..system.block_rows() * DIM;
    for row in padding {
        let at = diagonal[row / DIM] as usize * BLOCK + row % DIM * 4;
        match &mut system.values {
            Values::F32(values) => values[at] = largest.0 as f32,
            Values::F64(values) => values[at] = largest.0,
        }
    }
    for (row, &k) in diagonal.iter().enumerate() {
        let block: [f64; BLOCK] = std::array::from_fn(|c| system.values.get(k as usize * BLOCK + c));
        if pivots(&block) == Pivots::Negative {
            let first = row * DIM + 1;
            let last = (first + 2).min(scalar_rows);
            return Err(format!(
                "rows {first} to {last}: their diagonal block is not positive definite, so the matrix is not"
            ));
        }
    }
    symmetric(&system, &diagonal)?;
    if annihilates_ones(&system) {
        return Err("the matrix is singular: its product with the vector of ones is zero within rounding, so a \
                    solution is not unique; fix the value of at least one unknown"
            .into());
    }
    Ok(system)
}

/// True if the sum of every row is zero within the rounding of its terms, as for a Laplacian without fixed values.
/// Solves themselves detect other singular matrices, except where the right-hand side hides them.
fn annihilates_ones(system: &BlockSystem) -> bool {
    let epsilon = match system.values {
        Values::F32(_) => f64::from(f32::EPSILON),
        Values::F64(_) => f64::EPSILON,
    };
    (0..system.scalar_rows).all(|row| {
        let blocks = system.offsets[row / DIM] as usize..system.offsets[row / DIM + 1] as usize;
        let values = blocks.flat_map(|k| (0..DIM).map(move |c| k * BLOCK + row % DIM * DIM + c));
        let (mut sum, mut size) = (0.0, 0.0);
        for value in values.map(|at| system.values.get(at)) {
            sum += value;
            size += value.abs();
        }
        sum.abs() <= 4.0 * epsilon * size
    })
}

fn finite(system: &BlockSystem) -> Result<(), String> {
    let bad = match &system.values {
        Values::F32(values) => values.iter().position(|v| !v.is_finite()),
        Values::F64(values) => values.iter().position(|v| !v.is_finite()),
    };
    let Some(at) = bad else { return Ok(()) };
    let block = at / BLOCK;
    let row = system.offsets.partition_point(|&start| start as usize <= block) - 1;
    let (i, j) = (row * DIM + at % BLOCK / DIM + 1, system.columns[block] as usize * DIM + at % DIM + 1);
    Err(format!("row {i}, column {j}: the value is not a finite number"))
}

/// Index of the diagonal block of every block row.
fn diagonal_blocks(system: &BlockSystem) -> Result<Vec<u32>, String> {
    let row_of = |row: usize| {
        let range = system.offsets[row] as usize..system.offsets[row + 1] as usize;
        match system.columns[range.clone()].binary_search(&(row as u32)) {
            Ok(k) => Ok((range.start + k) as u32),
            Err(_) => Err(format!(
                "row {0}, column {0}: the diagonal value is missing or zero; it must be positive, as in every symmetric positive definite matrix",
                row * DIM + 1
            )),
        }
    };
    (0..system.block_rows()).map(row_of).collect()
}

/// Compares every block with its transposed counterpart. A missing counterpart counts as zero. One cursor per row
/// suffices, because the rows that refer to row j come in ascending order, as do the columns of row j.
fn symmetric(system: &BlockSystem, diagonal: &[u32]) -> Result<(), String> {
    // Allows for the rounding of a matrix whose two triangles were summed in different orders.
    let tolerance = match system.values {
        Values::F32(_) => 1e-5,
        Values::F64(_) => 1e-10,
    };
    let size = |row: usize| system.values.get(diagonal[row / DIM] as usize * BLOCK + row % DIM * 4);
    let compare = |i: usize, j: usize, upper: Option<usize>, lower: Option<usize>| -> Result<(), String> {
        for c in 0..BLOCK {
            let (row, column) = (i * DIM + c / DIM, j * DIM + c % DIM);
            let above = upper.map_or(0.0, |k| system.values.get(k * BLOCK + c));
            let below = lower.map_or(0.0, |k| system.values.get(k * BLOCK + c % DIM * DIM + c / DIM));
            if above != below && (above - below).abs() > tolerance * (size(row) * size(column)).sqrt() {
                return Err(format!(
                    "the matrix is not symmetric: row {}, column {} is {above:e} and the value across the diagonal is {below:e}",
                    row + 1,
                    column + 1
                ));
            }
        }
        Ok(())
    };
    let rows = system.block_rows();
    let mut cursor: Vec<u32> = system.offsets[..rows].to_vec();
    for i in 0..rows {
        compare(i, i, Some(diagonal[i] as usize), Some(diagonal[i] as usize))?;
        for k in diagonal[i] as usize + 1..system.offsets[i + 1] as usize {
            let j = system.columns[k] as usize;
            let mut lower = None;
            while lower.is_none() && cursor[j] < diagonal[j] && system.columns[cursor[j] as usize] as usize <= i {
                let (at, column) = (cursor[j] as usize, system.columns[cursor[j] as usize] as usize);
                cursor[j] += 1;
                if column == i {
                    lower = Some(at);
                } else {
                    compare(column, j, None, Some(at))?;
                }
            }
            compare(i, j, Some(k), lower)?;
        }
    }
    for j in 0..rows {
        for at in cursor[j]..diagonal[j] {
            compare(system.columns[at as usize] as usize, j, None, Some(at as usize))?;
        }
    }
    Ok(())
}
