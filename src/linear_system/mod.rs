//! Linear systems from any source: readers of matrix and right-hand-side files, block storage, the split over ranks,
//! and a distributed solve whose residual is checked in double precision.
//!
//! Rows are reordered for locality where that helps the preconditioner (see `order`), else they keep the order of the
//! file.

mod block_csr_file;
mod double;
mod matrix_market;
mod order;
mod precondition;
mod rank_system;
mod residual;
mod right_hand_side;
mod solve;
mod system;
#[cfg(test)]
mod tests;
mod validate;

pub use block_csr_file::{BLOCK_CSR_MAGIC, parse_block_csr};
pub use matrix_market::parse_matrix_market;
pub use order::{locality_order, share_between_chunks};
pub use rank_system::{RankSystem, RankSystemArrays, RankSystemError};
pub use right_hand_side::{parse_right_hand_side, read_right_hand_side, write_solution};
pub use solve::{SolveEnd, SolveError, SolveParams, SolveRecord, SolveResult, SolveStats, solve_rank};
pub use system::{BlockSystem, Values};

use std::io::Read;
use std::path::Path;

use thiserror::Error;

use crate::input::{Input, Streams};

/// Why a file does not hold a system that can be solved. Every message names the file and the place in it.
#[derive(Debug, Error)]
pub enum SystemError {
    /// The file cannot be read.
    #[error("{file}: {cause}")]
    Io {
        /// The file.
        file: String,
        /// The error of the operating system.
        cause: std::io::Error,
    },
    /// A text file is malformed.
    #[error("{file}:{line}: {what}")]
    Line {
        /// The file.
        file: String,
        /// Line, from 1.
        line: u64,
        /// The error and the correct form.
        what: String,
    },
    /// A binary file is malformed.
    #[error("{file}, byte {offset}: {what}")]
    Offset {
        /// The file.
        file: String,
        /// Byte, from 0.
        offset: u64,
        /// The error and the correct form.
        what: String,
    },
    /// The file is well-formed, but this solver does not accept the system.
    #[error("{file}: {what}")]
    System {
        /// The file.
        file: String,
        /// The error and the correct form.
        what: String,
    },
}

/// Reads a system from a file or a pipe. The format is CLTHBSR1 if the data begins with those letters, else Matrix
/// Market. Either may be compressed (.gz). The second value is the right-hand side stored in the file (CLTHBSR1 only).
///
/// # Errors
/// The file is unreadable, malformed, or not symmetric with a positive diagonal.
pub fn read_system(path: &Path) -> Result<(BlockSystem, Option<Vec<f64>>), SystemError> {
    let file = path.display().to_string();
    let io = |cause| SystemError::Io { file: file.clone(), cause };
    let Input { mut reader, mut bytes, exact } = Input::open(path, Streams::Accepted).map_err(io)?;
    let mut start = Vec::new();
    reader.by_ref().take(BLOCK_CSR_MAGIC.len() as u64).read_to_end(&mut start).map_err(io)?;
    let is_block_csr = start == BLOCK_CSR_MAGIC;
    let mut reader = std::io::Cursor::new(start).chain(reader);
    if !is_block_csr {
        return Ok((parse_matrix_market(reader, bytes, &file)?, None));
    }
    // The reader checks the header against the exact size.
    let mut all = Vec::new();
    if !exact {
        reader.read_to_end(&mut all).map_err(io)?;
        bytes = all.len() as u64;
    }
    let (system, rhs) = parse_block_csr(std::io::Cursor::new(all).chain(reader), bytes, &file)?;
    Ok((system, Some(rhs)))
}
