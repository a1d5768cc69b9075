//! Command line: one file per command; `bin/` only calls in here.

pub mod doctor;

/// Why a command ends without having done its work: one sentence for the user and the exit code.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct CliError {
    /// 1 = the work failed, 2 = bad usage or bad input.
    pub exit_code: u8,
    /// What went wrong, where, and what would be right.
    pub message: String,
}

impl CliError {
    /// The user's input is at fault.
    pub fn bad_input(message: impl Into<String>) -> CliError {
        CliError { exit_code: 2, message: message.into() }
    }

    /// The work was begun and failed.
    pub fn failed(message: impl Into<String>) -> CliError {
        CliError { exit_code: 1, message: message.into() }
    }
}
