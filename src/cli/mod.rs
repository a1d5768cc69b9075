//! Command line: one file per command. The programs in `bin/` only call this module.

pub mod bench;
pub mod check;
pub mod compare;
pub mod convert;
pub mod ccd;
pub mod completions;
mod ccd_csv;
mod ccd_frames;
pub mod doctor;
mod far;
pub mod init;
pub mod join;
pub mod launcher;
pub mod live;
pub mod man;
pub mod new_scene;
pub mod predict;
pub mod render;
mod render_subjects;
pub mod report;
pub mod run;
mod run_lines;
mod run_split;
pub mod schedule;
pub mod solve;
mod solve_report;
mod solve_trace;
mod start_state;
mod sweep;
pub mod topology;
mod topology_hosts;
pub mod view;
pub mod worker;

pub(crate) use crate::coordinator::options::count;
use crate::os::console;
use crate::os::{limits, signals};
use crate::transport::MachineError;

/// A command that failed: message for stderr and exit code.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CliError {
    /// 1 for a failed run, 2 for bad usage or bad input, 128 + signal for a run that a signal stopped.
    pub exit_code: u8,
    /// One sentence for the user.
    pub message: String,
}

impl CliError {
    /// Bad usage or bad input: exit code 2.
    pub fn bad_input(message: impl std::fmt::Display) -> CliError {
        CliError { exit_code: 2, message: message.to_string() }
    }

    /// Failure of a valid command: exit code 1.
    pub fn failed(message: impl std::fmt::Display) -> CliError {
        CliError { exit_code: 1, message: message.to_string() }
    }
}

/// Writes a result to stdout. A closed pipe (`| head`) is not an error.
///
/// # Errors
/// Writing to stdout failed: exit code 1.
fn print(text: &str) -> Result<(), CliError> {
    printed(console::print(text))
}

/// Writes a result: `text` to stdout, or with `--json` one line of JSON, and `text` to stderr.
///
/// # Errors
/// Writing to stdout failed: exit code 1.
fn answer(text: &str, json: impl FnOnce() -> serde_json::Value) -> Result<(), CliError> {
    answer_to(&mut std::io::stdout().lock(), text, json)
}

/// Like [`answer`], to any stream.
fn answer_to(
    out: &mut dyn std::io::Write,
    text: &str,
    json: impl FnOnce() -> serde_json::Value,
) -> Result<(), CliError> {
    if !console::is_json() {
        return print_to(out, text);
    }
    console::note(text.trim_end());
    print_to(out, &format!("{}\n", json()))
}

/// Like [`print`], to any stream.
fn print_to(out: &mut dyn std::io::Write, text: &str) -> Result<(), CliError> {
    printed(console::print_to(out, text))
}

fn printed(result: std::io::Result<()>) -> Result<(), CliError> {
    result.map_err(|error| CliError::failed(format!("cannot write the result to stdout: {error}")))
}

impl std::fmt::Display for CliError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl From<MachineError> for CliError {
    fn from(error: MachineError) -> CliError {
        match error {
            MachineError::TooSmall(text) => CliError::bad_input(text),
            MachineError::Unreadable(text) => CliError::failed(text),
        }
    }
}

impl std::error::Error for CliError {}

/// Prints the message of an error and returns the exit code.
pub fn exit_code(result: Result<(), CliError>) -> std::process::ExitCode {
    match result {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            if !error.message.is_empty() {
                console::complain(format_args!("error: {error}"));
            }
            std::process::ExitCode::from(error.exit_code)
        }
    }
}

/// How much a command says besides its results and errors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Verbosity {
    /// Nothing.
    Quiet,
    /// Progress, advice and warnings.
    #[default]
    Usual,
    /// Also what the log knows in detail, of workers, too.
    Verbose,
}

/// From now on results are JSON (`--json`).
pub fn answer_in_json() {
    console::be_json();
}

/// Initializes the log; programs call it first. Log lines go to stderr, and `LOOMTREE_LOG` sets their level (default:
/// warnings; errors where `verbosity` is quiet, everything where it is verbose). It also sets a missing
/// `XDG_RUNTIME_DIR`, because Vulkan loaders complain about it on stderr.
pub fn start_log(verbosity: Verbosity) {
    match verbosity {
        Verbosity::Quiet => console::be_quiet(),
        Verbosity::Usual => {}
        // Workers inherit it.
        // SAFETY: called first in `main`, before any other thread exists.
        Verbosity::Verbose => unsafe { std::env::set_var("LOOMTREE_LOG", "loomtree=debug") },
    }
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: called first in `main`, before any other thread exists.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    signals::survive_file_size_limit();
    limits::raise_descriptor_limit();
    let usual = if verbosity == Verbosity::Quiet { "loomtree=error" } else { "loomtree=warn" };
    let filter = tracing_subscriber::EnvFilter::try_from_env("LOOMTREE_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(usual));
    // Errors of the log itself would go to the stream that has just failed, through a macro that then panics.
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).log_internal_errors(false);
    // A second call (in tests) keeps the first log.
    let _ = log.without_time().try_init();
}
