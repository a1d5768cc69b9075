//! Command line: one file per command; `bin/` only calls in here.

use thiserror::Error;

pub mod render;

/// Why a command ends without success: the sentence for the user and the exit code.
#[derive(Debug, Error)]
#[error("{message}")]
pub struct CliError {
    /// 1 = failed, 2 = bad input.
    pub exit_code: u8,
    /// One sentence.
    pub message: String,
}

impl CliError {
    /// The user can fix it: exit code 2.
    pub fn bad_input(message: impl Into<String>) -> CliError {
        CliError { exit_code: 2, message: message.into() }
    }

    /// It went wrong while running: exit code 1.
    pub fn failed(message: impl Into<String>) -> CliError {
        CliError { exit_code: 1, message: message.into() }
    }
}
