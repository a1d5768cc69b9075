//! Replaces this process by the `loomtree` program in the same folder. The process id stays, so whoever started this
//! program watches and signals the real one.

use std::io::Write;
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode};

/// Becomes `loomtree NAME ARGUMENTS`; returns only if that program cannot be started.
pub(crate) fn become_command(name: &str) -> ExitCode {
    let program = match std::env::current_exe() {
        Ok(path) => path.with_file_name("loomtree"),
        Err(error) => {
            complain(format_args!("cannot find the folder of this program: {error}"));
            return ExitCode::FAILURE;
        }
    };
    let error = Command::new(&program).arg(name).args(std::env::args_os().skip(1)).exec();
    complain(format_args!("cannot start {}, which must lie beside this program: {error}", program.display()));
    ExitCode::FAILURE
}

/// Writes an error to stderr; the macro of the standard library panics if stderr is closed or full.
fn complain(error: std::fmt::Arguments) {
    let _ = writeln!(std::io::stderr(), "error: {error}");
}
