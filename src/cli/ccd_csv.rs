//! Parts shared by both forms of `loomtree ccd`: lines and columns of CSV files with their error messages, and the
//! report.

use std::io::Write;
use std::path::Path;

use clap::ValueEnum;
use serde::Serialize;

use super::{CliError, print_to};

/// Kind of the queries of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum CcdKind {
    /// Vertex against face
    Vf,
    /// Edge against edge
    Ee,
}

/// An error in a line of a CSV file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {what}")]
pub struct CsvFault {
    /// Line counting from 1.
    pub line: usize,
    /// The error and the correct form.
    pub what: String,
}

/// The bytes of a file.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, CliError> {
    std::fs::read(path).map_err(|error| CliError::bad_input(format!("{}: cannot be read: {error}", path.display())))
}

/// Turns an error in a file into an error of the command.
pub(super) fn in_file(path: &Path, fault: &CsvFault) -> CliError {
    CliError::bad_input(format!("{}, {fault}", path.display()))
}

/// Lines that are not blank, with their numbers from 1.
pub(super) fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    bytes
        .split(|&b| b == b'\n')
        .map(<[u8]>::trim_ascii)
        .zip(1..)
        .filter(|(text, _)| !text.is_empty())
        .map(|(t, n)| (n, t))
}

/// The columns of a line.
pub(super) fn columns(text: &[u8]) -> Result<Vec<&str>, String> {
    let text = std::str::from_utf8(text).map_err(|_| "not text; a row is numbers with commas between".to_string())?;
    Ok(text.split(',').map(str::trim).collect())
}

/// Parses the truth of a query or pair.
pub(super) fn parse_flag(text: &str) -> Result<bool, String> {
    match text {
        "0" => Ok(false),
        "1" => Ok(true),
        _ => Err(format!("{} is no truth; write 0 or 1", shown(text))),
    }
}

/// The first few characters of a field, for an error message.
pub(super) fn shown(text: &str) -> String {
    let start: String = text.chars().take(24).collect();
    format!("{start:?}")
}

/// Parses a time of contact, from 0 to 1 over the step.
pub(super) fn parse_time(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(time) if (0.0..=1.0).contains(&time) => Ok(time),
        _ => Err(format!("{} is no time; write a number from 0 to 1", shown(text))),
    }
}

/// Prints a report as JSON. A closed pipe is not an error.
pub(super) fn write_json(report: &impl Serialize, out: &mut impl Write) -> Result<(), CliError> {
    let text = serde_json::to_string_pretty(report).map_err(CliError::failed)?;
    print_to(out, &(text + "\n"))
}
