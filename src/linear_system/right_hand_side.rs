//! Right-hand sides and solutions as text: a Matrix Market array of one column, or one number per line.

use std::io::{BufRead, Write};
use std::path::Path;

use super::SystemError;
use super::matrix_market::{Lines, fields, real, shown};
use crate::input::{Input, Streams};

/// Reads a right-hand side of `rows` values. In plain text, blank lines and lines that start with `%` or `#` are
/// skipped.
///
/// # Errors
/// The file cannot be read, is malformed, or does not hold `rows` values.
pub fn read_right_hand_side(path: &Path, rows: usize) -> Result<Vec<f64>, SystemError> {
    let file = path.display().to_string();
    let input = Input::open(path, Streams::Accepted).map_err(|cause| SystemError::Io { file: file.clone(), cause })?;
    parse_right_hand_side(input.reader, rows, &file)
}

/// Like [`read_right_hand_side`], from `input`. `file` names it in errors.
pub fn parse_right_hand_side(input: impl BufRead, rows: usize, file: &str) -> Result<Vec<f64>, SystemError> {
    let mut lines = Lines { input, file, number: 0, line: Vec::new() };
    let mut values = Vec::with_capacity(rows);
    let mut size_expected = false;
    while lines.next()? {
        let text = lines.line.trim_ascii();
        if lines.number == 1 && text.len() >= 14 && text[..14].eq_ignore_ascii_case(b"%%MatrixMarket") {
            size_expected = true;
            let words: Vec<String> = fields(text).iter().map(|f| shown(f).to_ascii_lowercase()).collect();
            let words: Vec<&str> = words.iter().map(String::as_str).collect();
            if !matches!(words[..], [_, "matrix", "array", "real" | "integer", "general"]) {
                return Err(lines.error("expected '%%MatrixMarket matrix array real general'"));
            }
            continue;
        }
        if text.is_empty() || text[0] == b'%' || text[0] == b'#' {
            continue;
        }
        if size_expected {
            size_expected = false;
            let size: Vec<f64> = fields(text).iter().filter_map(|f| real(f)).collect();
            if size != [rows as f64, 1.0] {
                return Err(lines.error(&format!("expected '{rows} 1': as many rows as the matrix, one column")));
            }
            continue;
        }
        let Some(value) = real(text) else {
            let text = shown(text);
            return Err(lines.error(&format!("'{text}' is not one finite number")));
        };
        if values.len() == rows {
            return Err(lines.error(&format!("more values than the {rows} rows of the matrix")));
        }
        values.push(value);
    }
    if values.len() < rows {
        return Err(lines.error(&format!("the file ends after {} values; the matrix has {rows} rows", values.len())));
    }
    Ok(values)
}

/// Writes a solution as a Matrix Market array. Each value has enough digits to be read back unchanged.
pub fn write_solution(out: &mut dyn Write, x: &[f64]) -> std::io::Result<()> {
    writeln!(out, "%%MatrixMarket matrix array real general\n{} 1", x.len())?;
    for value in x {
        writeln!(out, "{value:e}")?;
    }
    Ok(())
}
