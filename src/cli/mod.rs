//! Command line: one file per command; `bin/` only calls in here.

pub mod render;
pub mod schedule;

/// A command that ended without its result: what to print to stderr and how to exit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CliError {
    /// 1 for a run that failed, 2 for bad usage or bad input.
    pub exit_code: u8,
    /// One sentence for the user.
    pub message: String,
}

impl CliError {
    /// Bad usage or bad input: exit code 2.
    pub fn bad_input(message: impl std::fmt::Display) -> CliError {
        CliError { exit_code: 2, message: message.to_string() }
    }

    /// The command was well asked for and failed: exit code 1.
    pub fn failed(message: impl std::fmt::Display) -> CliError {
        CliError { exit_code: 1, message: message.to_string() }
    }
}

impl std::fmt::Display for CliError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for CliError {}
