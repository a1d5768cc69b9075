//! Command line: one file per command; `bin/` only calls in here.

pub mod check;

/// Why a command ends without success.
#[derive(Debug)]
pub struct CliError {
    /// 1 a run that failed, 2 bad usage or bad input.
    pub exit_code: u8,
    /// One sentence for the user.
    pub message: String,
}

impl CliError {
    /// Bad usage or bad input.
    pub fn bad_input(message: impl std::fmt::Display) -> CliError {
        CliError { exit_code: 2, message: message.to_string() }
    }

    /// A run that failed.
    pub fn failed(message: impl std::fmt::Display) -> CliError {
        CliError { exit_code: 1, message: message.to_string() }
    }
}
