//! CLTHBSR1: a binary file with a matrix of 3x3 blocks in compressed rows and a right-hand side. Little-endian, no
//! padding:
//!
//! ```text
//! offset 0   8 bytes  "CLTHBSR1"
//!        8   u64      n, number of block rows
//!       16   u64      b, number of stored blocks (both triangles)
//!       24   u32      block size, always 3
//!       28   u32      bytes of a value: 4 or 8
//!       32   u64      start of each row, n + 1 of them
//!            u32      column of each block, ascending inside a row
//!            f32|f64  9 b values, block after block, row-major
//!            f32|f64  3 n values of the right-hand side
//! ```

use std::io::Read;

use super::SystemError;
use super::system::{BlockSystem, Values};
use super::validate::validated;
use crate::assembly::sell::BLOCK;
use crate::math::DIM;

/// First bytes of the file.
pub const BLOCK_CSR_MAGIC: &[u8; 8] = b"CLTHBSR1";

const HEADER_BYTES: u64 = 32;
/// Row starts are read and converted to u32 in chunks of this many.
const CHUNK: usize = 1 << 14;

/// Reads a CLTHBSR1 file with its matrix and right-hand side from `input`, which holds `bytes` bytes. `file` names it
/// in errors. Allocations are never larger than `bytes`.
///
/// # Errors
/// The file cannot be read, its size differs from what its header says, or the solver does not accept the matrix.
pub fn parse_block_csr(input: impl Read, bytes: u64, file: &str) -> Result<(BlockSystem, Vec<f64>), SystemError> {
    let mut input = Input { input, offset: 0, file };
    let mut header = [0u8; HEADER_BYTES as usize];
    if bytes < HEADER_BYTES {
        return Err(input.error(0, format!("the file has {bytes} bytes, fewer than its header of {HEADER_BYTES}")));
    }
    input.fill(&mut header)?;
    if header[..8] != *BLOCK_CSR_MAGIC {
        return Err(input.error(0, "expected the letters CLTHBSR1".to_string()));
    }
    let word = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| header[at + i]));
    let half = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| header[at + i]));
    let (rows, blocks, block_size, value_bytes) = (word(8), word(16), half(24), half(28));
    if block_size != DIM as u32 {
        return Err(input.error(24, format!("the block size is {block_size}; only 3 is supported")));
    }
    if value_bytes != 4 && value_bytes != 8 {
        return Err(input.error(28, format!("a value has {value_bytes} bytes; expected 4 or 8")));
    }
    if rows == 0 {
        return Err(input.error(8, "the matrix has no rows".to_string()));
    }
    // Device tables address slots with 32 bits; the limit leaves room for padding.
    let limit = u64::from(u32::MAX) / 2;
    if rows > limit || blocks > limit {
        return Err(input.error(8, format!("{rows} rows and {blocks} blocks; at most {limit} of each are supported")));
    }
    let value_bytes = u64::from(value_bytes);
    let expected =
        HEADER_BYTES + 8 * (rows + 1) + blocks * (4 + BLOCK as u64 * value_bytes) + rows * DIM as u64 * value_bytes;
    if bytes != expected {
        return Err(input.error(
            8,
            format!("{rows} rows and {blocks} blocks need a file of {expected} bytes, this one has {bytes}"),
        ));
    }
    let (rows, blocks) = (rows as usize, blocks as usize);
    let offsets = input.row_starts(rows, blocks)?;
    let columns = input.columns(rows, blocks, &offsets)?;
    let values = match value_bytes {
        4 => Values::F32(input.array(blocks * BLOCK, f32_from_le)?),
        _ => Values::F64(input.array(blocks * BLOCK, f64_from_le)?),
    };
    let rhs_offset = input.offset;
    let rhs: Vec<f64> = match value_bytes {
        4 => input.array(rows * DIM, f32_from_le)?.into_iter().map(f64::from).collect(),
        _ => input.array(rows * DIM, f64_from_le)?,
    };
    if let Some(at) = rhs.iter().position(|v| !v.is_finite()) {
        let what = format!("value {} of the right-hand side is not a finite number", at + 1);
        return Err(input.error(rhs_offset + at as u64 * value_bytes, what));
    }
    let system = validated(rows * DIM, offsets, columns, values)
        .map_err(|what| SystemError::System { file: file.to_string(), what })?;
    Ok((system, rhs))
}

fn f32_from_le(v: f32) -> f32 {
    f32::from_bits(u32::from_le(v.to_bits()))
}

fn f64_from_le(v: f64) -> f64 {
    f64::from_bits(u64::from_le(v.to_bits()))
}

struct Input<'a, R> {
    input: R,
    offset: u64,
    file: &'a str,
}

impl<R: Read> Input<'_, R> {
    fn error(&self, offset: u64, what: String) -> SystemError {
        SystemError::Offset { file: self.file.to_string(), offset, what }
    }

    fn fill(&mut self, out: &mut [u8]) -> Result<(), SystemError> {
        self.input.read_exact(out).map_err(|cause| SystemError::Io { file: self.file.to_string(), cause })?;
        self.offset += out.len() as u64;
        Ok(())
    }

    fn array<T: bytemuck::Pod>(&mut self, len: usize, from_le: impl Fn(T) -> T) -> Result<Vec<T>, SystemError> {
        let mut out = vec![T::zeroed(); len];
        self.fill(bytemuck::cast_slice_mut(&mut out))?;
        if cfg!(target_endian = "big") {
            out.iter_mut().for_each(|v| *v = from_le(*v));
        }
        Ok(out)
    }

    fn row_starts(&mut self, rows: usize, blocks: usize) -> Result<Vec<u32>, SystemError> {
        let mut offsets = Vec::with_capacity(rows + 1);
        let mut last = 0;
        while offsets.len() <= rows {
            let begin = self.offset;
            let part: Vec<u64> = self.array((rows + 1 - offsets.len()).min(CHUNK), u64::from_le)?;
            for (i, start) in part.into_iter().enumerate() {
                let row = offsets.len();
                let wrong_end = (row == 0 && start != 0) || (row == rows && start != blocks as u64);
                if wrong_end || start < last || start > blocks as u64 {
                    let what = format!(
                        "row start {row} is {start}; row starts ascend from 0 to the number of blocks, {blocks}"
                    );
                    return Err(self.error(begin + i as u64 * 8, what));
                }
                last = start;
                offsets.push(start as u32);
            }
        }
        Ok(offsets)
    }

    fn columns(&mut self, rows: usize, blocks: usize, offsets: &[u32]) -> Result<Vec<u32>, SystemError> {
        let begin = self.offset;
        let columns: Vec<u32> = self.array(blocks, u32::from_le)?;
        for (row, ends) in offsets.windows(2).enumerate() {
            let range = ends[0] as usize..ends[1] as usize;
            for k in range.clone() {
                let at = begin + k as u64 * 4;
                if columns[k] as usize >= rows {
                    let what = format!(
                        "block row {row} names column {}; there are {rows} block columns, counted from 0",
                        columns[k]
                    );
                    return Err(self.error(at, what));
                }
                if k > range.start && columns[k] <= columns[k - 1] {
                    let what = format!(
                        "the columns of block row {row} do not ascend: {} follows {}",
                        columns[k],
                        columns[k - 1]
                    );
                    return Err(self.error(at, what));
                }
            }
        }
        Ok(columns)
    }
}
