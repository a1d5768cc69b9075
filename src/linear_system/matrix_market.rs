//! Matrix Market matrices [Boisvert et al. 1996]: `coordinate real|integer symmetric|general`. Scalar rows are grouped
//! by three into blocks. The last block row is padded.
//!
//! Duplicate entries are added in the order of the file. A matrix declared general must have symmetric values.

use std::io::BufRead;

use super::SystemError;
use super::system::{BlockSystem, Values};
use super::validate::validated;
use crate::assembly::sell::BLOCK;
use crate::math::DIM;

/// Shortest line of an entry, "1 1 1" without a line end after the last one. It bounds the entries that a header can
/// claim.
const ENTRY_BYTES: u64 = 6;
/// Most entries for which memory is reserved before they are read, because only an upper bound of the size of a zipped
/// file is known.
const RESERVED_MOST: u64 = 1 << 24;

/// Reads a Matrix Market file from `input`, which holds at most `bytes` bytes; `file` names it in errors.
///
/// # Errors
/// The file cannot be read, is malformed, is of an unsupported kind, or holds a matrix that the solver does not accept.
pub fn parse_matrix_market(input: impl BufRead, bytes: u64, file: &str) -> Result<BlockSystem, SystemError> {
    let mut lines = Lines { input, file, number: 0, line: Vec::new() };
    let symmetric = lines.banner()?;
    let size_line = lines.require_data("the line 'rows columns entries'")?;
    let [rows, columns, entries] = &size_line[..] else {
        return Err(lines.error("expected three numbers: rows columns entries"));
    };
    let count = |text: &[u8], what: &str| {
        unsigned(text).ok_or_else(|| lines.error(&format!("'{}' is not a number of {what}", shown(text))))
    };
    let (rows, columns, entries) = (count(rows, "rows")?, count(columns, "columns")?, count(entries, "entries")?);
    if rows != columns {
        return Err(lines.error(&format!("the matrix has {rows} rows and {columns} columns; it must be square")));
    }
    if rows == 0 {
        return Err(lines.error("the matrix has no rows"));
    }
    if entries > (bytes + 1) / ENTRY_BYTES {
        return Err(lines.error(&format!("{entries} entries cannot fit into a file of {bytes} bytes")));
    }
    if entries < rows {
        return Err(lines.error(&format!(
            "{entries} entries are too few: each of the {rows} rows needs a positive diagonal value"
        )));
    }
    if rows > u64::from(u32::MAX) / 2 {
        return Err(lines.error(&format!("{rows} rows; at most {} are supported", u32::MAX / 2)));
    }
    let mut triplets = Vec::with_capacity(entries.min(RESERVED_MOST) as usize);
    for done in 0..entries {
        let Some(fields) = lines.data()? else {
            return Err(lines.error(&format!("the file ends after {done} of {entries} entries")));
        };
        let [row, column, value] = fields[..] else {
            return Err(lines.error("expected an entry: row column value"));
        };
        let index = |text: &[u8]| unsigned(text).filter(|&i| (1..=rows).contains(&i));
        let parsed = (index(row), index(column), real(value));
        let (Some(row), Some(column), Some(value)) = parsed else {
            let message = match parsed {
                (None, _, _) => format!("'{}' is not a row between 1 and {rows}", shown(row)),
                (_, None, _) => format!("'{}' is not a column between 1 and {rows}", shown(column)),
                _ => format!("'{}' is not a finite number", shown(value)),
            };
            return Err(lines.error(&message));
        };
        if symmetric && row < column {
            return Err(lines.error("a symmetric matrix lists only entries on and below the diagonal (row >= column)"));
        }
        triplets.push(Triplet { row: row as u32 - 1, column: column as u32 - 1, value });
    }
    if lines.data()?.is_some() {
        return Err(lines.error(&format!("more than the {entries} entries that line 2 announces")));
    }
    let (offsets, columns, values) = blocks(rows as usize, triplets, symmetric);
    validated(rows as usize, offsets, columns, Values::F64(values))
        .map_err(|what| SystemError::System { file: file.to_string(), what })
}

/// One entry; row and column count from 0.
struct Triplet {
    row: u32,
    column: u32,
    value: f64,
}

/// A value to be added to a block row: block column, place in the block, value.
#[derive(Clone, Copy, Default)]
struct Placed {
    column: u32,
    component: u32,
    value: f64,
}

/// Builds block rows from entries. Duplicate entries are added in the order of the file, mirrored ones too, so a
/// symmetric file gives an exactly symmetric matrix.
fn blocks(rows: usize, triplets: Vec<Triplet>, symmetric: bool) -> (Vec<u32>, Vec<u32>, Vec<f64>) {
    let block_rows = rows.div_ceil(DIM);
    let padding = rows as u32..(block_rows * DIM) as u32;
    let mut starts = vec![0usize; block_rows + 1];
    let each = |add: &mut dyn FnMut(u32, u32, f64)| {
        for t in &triplets {
            add(t.row, t.column, t.value);
            if symmetric && t.row != t.column {
                add(t.column, t.row, t.value);
            }
        }
        // Reserves the slot; `validated` sets the value.
        padding.clone().for_each(|row| add(row, row, 1.0));
    };
    each(&mut |row, _, _| starts[row as usize / DIM + 1] += 1);
    for r in 0..block_rows {
        starts[r + 1] += starts[r];
    }
    let mut placed = vec![Placed::default(); starts[block_rows]];
    let mut next = starts.clone();
    each(&mut |row, column, value| {
        let (d, at) = (DIM as u32, &mut next[(row / DIM as u32) as usize]);
        placed[*at] = Placed { column: column / d, component: row % d * d + column % d, value };
        *at += 1;
    });
    drop(triplets);
    let (mut offsets, mut columns, mut values) = (vec![0u32], Vec::new(), Vec::new());
    for r in 0..block_rows {
        let row = &mut placed[starts[r]..starts[r + 1]];
        row.sort_by_key(|p| p.column);
        for group in row.chunk_by(|a, b| a.column == b.column) {
            let mut block = [0.0; BLOCK];
            group.iter().for_each(|p| block[p.component as usize] += p.value);
            columns.push(group[0].column);
            values.extend_from_slice(&block);
        }
        offsets.push(columns.len() as u32);
    }
    (offsets, columns, values)
}

/// Reads a Matrix Market file line by line.
pub(super) struct Lines<'a, R> {
    pub(super) input: R,
    pub(super) file: &'a str,
    /// Number of the current line, from 1.
    pub(super) number: u64,
    pub(super) line: Vec<u8>,
}

impl<R: BufRead> Lines<'_, R> {
    pub(super) fn error(&self, what: &str) -> SystemError {
        SystemError::Line { file: self.file.to_string(), line: self.number.max(1), what: what.to_string() }
    }

    /// Reads the next line; false at the end of the file.
    pub(super) fn next(&mut self) -> Result<bool, SystemError> {
        /// Longest line that is accepted. It bounds the memory that a file without line ends takes.
        const LINE_MAX: u64 = 1 << 16;
        self.line.clear();
        let mut limited = std::io::Read::take(&mut self.input, LINE_MAX);
        let read = limited.read_until(b'\n', &mut self.line);
        let read = read.map_err(|cause| SystemError::Io { file: self.file.to_string(), cause })?;
        self.number += u64::from(read > 0);
        if read as u64 == LINE_MAX {
            return Err(self.error("the line is longer than 65536 characters"));
        }
        Ok(read > 0)
    }

    /// Fields of the next line that is neither blank nor a comment.
    pub(super) fn data(&mut self) -> Result<Option<Vec<&[u8]>>, SystemError> {
        loop {
            if !self.next()? {
                return Ok(None);
            }
            let text = self.line.trim_ascii();
            if !text.is_empty() && text[0] != b'%' {
                break;
            }
        }
        Ok(Some(fields(&self.line)))
    }

    fn require_data(&mut self, what: &str) -> Result<Vec<Vec<u8>>, SystemError> {
        match self.data()? {
            Some(fields) => Ok(fields.into_iter().map(<[u8]>::to_vec).collect()),
            None => Err(self.error(&format!("the file ends before {what}"))),
        }
    }

    /// Reads the first line of a matrix; true if only the lower triangle is stored.
    fn banner(&mut self) -> Result<bool, SystemError> {
        self.next()?;
        let words: Vec<String> = fields(&self.line).iter().map(|f| shown(f).to_ascii_lowercase()).collect();
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let ["%%matrixmarket", "matrix", layout, kind, symmetry] = words[..] else {
            return Err(self.error("expected '%%MatrixMarket matrix coordinate real symmetric' (or a CLTHBSR1 file)"));
        };
        match layout {
            "coordinate" => {}
            "array" => return Err(self.error("a dense matrix (array); only sparse ones (coordinate) are supported")),
            other => return Err(self.error(&format!("'{other}' is not a layout; expected coordinate"))),
        }
        if kind != "real" && kind != "integer" {
            return Err(self.error(&format!("{kind} values; only real and integer are supported")));
        }
        match symmetry {
            "symmetric" => Ok(true),
            "general" => Ok(false),
            other => {
                Err(self
                    .error(&format!("a matrix that is {other}; expected symmetric, or general with symmetric values")))
            }
        }
    }
}

pub(super) fn fields(line: &[u8]) -> Vec<&[u8]> {
    line.split(u8::is_ascii_whitespace).filter(|f| !f.is_empty()).collect()
}

fn unsigned(text: &[u8]) -> Option<u64> {
    std::str::from_utf8(text).ok()?.parse().ok()
}

/// Parses a finite number. Fortran exponents are accepted: `1.5D+00`, `1.5d0`, `1.5-100` (for E-100).
pub(super) fn real(text: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(text).ok()?;
    let fortran = || -> Option<f64> {
        let exponent = text.find(['d', 'D']).or_else(|| Some(1 + text.get(1..)?.find(['+', '-'])?))?;
        let (mantissa, exponent) = text.split_at(exponent);
        format!("{mantissa}e{}", exponent.strip_prefix(['d', 'D']).unwrap_or(exponent)).parse().ok()
    };
    text.parse().ok().or_else(fortran).filter(|v: &f64| v.is_finite())
}

/// The first 60 bytes of a text, for a message. Bytes that are not UTF-8 are replaced.
pub(super) fn shown(text: &[u8]) -> String {
    String::from_utf8_lossy(&text[..text.len().min(60)]).into_owned()
}

#[cfg(test)]
mod tests {
    use super::real;

    #[test]
    fn numbers_as_c_and_as_fortran_write_them() {
        for (text, value) in
            [("1.5", 1.5), ("-2e3", -2e3), ("1.5D+00", 1.5), ("-2.5d-1", -0.25), ("1.5-100", 1.5e-100), ("3D2", 300.0)]
        {
            assert_eq!(real(text.as_bytes()), Some(value), "{text}");
        }
        for text in
            ["", "D", "1D", "1DD1", "1d1d1", "nan", "inf", "1e999", "1D999", "+", "1-", "1.5 2", "--1", "\u{e9}-1"]
        {
            assert_eq!(real(text.as_bytes()), None, "{text}");
        }
    }
}
