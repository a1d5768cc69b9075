//! `loomtree completions`: completion of the command line for a shell.

use clap::Args;
use clap_complete::{Shell, generate};

use super::{CliError, print};

/// Print a script that completes the command line: `loomtree completions bash >
/// ~/.local/share/bash-completion/completions/loomtree`.
#[derive(Args, Clone, Debug)]
pub struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    pub shell: Shell,
}

/// Runs the command. `command`: the whole command line.
///
/// # Errors
/// The script cannot be printed.
pub fn run(args: CompletionsArgs, mut command: clap::Command) -> Result<(), CliError> {
    let mut script = Vec::new();
    generate(args.shell, &mut command, "loomtree", &mut script);
    print(&String::from_utf8_lossy(&script))
}
