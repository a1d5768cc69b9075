//! `loomtree man`: manual pages of every command.

use std::path::PathBuf;

use clap::Args;

use super::CliError;
use crate::os::console::note;

/// Write manual pages, one for every command: `loomtree man ~/.local/share/man/man1`, then `man loomtree-run`.
#[derive(Args, Clone, Debug)]
pub struct ManArgs {
    /// Folder to write them into; it is made if it is not there
    pub folder: PathBuf,
}

/// Runs the command. `command`: the whole command line.
///
/// # Errors
/// The folder cannot be written (exit code 2).
pub fn run(args: &ManArgs, command: clap::Command) -> Result<(), CliError> {
    let folder = &args.folder;
    let wrong = |error: std::io::Error| CliError::bad_input(format!("{}: {error}", folder.display()));
    std::fs::create_dir_all(folder).map_err(wrong)?;
    clap_mangen::generate_to(command.name("loomtree"), folder).map_err(wrong)?;
    note(format_args!("manual pages in {}; next: man -l {}", folder.display(), folder.join("loomtree.1").display()));
    Ok(())
}
