//! `loomtree view`: the page of a run.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clap::Args;
use serde_json::json;

use super::{CliError, answer};
use crate::os::console::note;
use crate::output::{DirectoryError, RunDirectory};
use crate::view::{Answers, Server, Watched};

/// Show a run in the browser, while it goes on or afterwards; two runs side by side.
///
/// The page is served on 127.0.0.1 to whoever has the address that is printed, until Ctrl-C. It reads the run
/// directory; a run with --live can be steered from it.
#[derive(Args, Clone, Debug)]
pub struct ViewArgs {
    /// Run directory, or two of them to compare [default: the run in out/ that was written last]
    #[arg(value_name = "RUN", num_args = 0..=2)]
    pub runs: Vec<PathBuf>,
    /// Where the page is served.
    #[command(flatten)]
    pub page: PageArgs,
}

/// Where a page is served.
#[derive(Args, Clone, Debug, Default)]
pub struct PageArgs {
    /// Port on 127.0.0.1; 0: any free one
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub port: u16,
    /// Open the page in the browser
    #[arg(long)]
    pub open: bool,
}

/// Runs the command, until a signal ends the process.
///
/// # Errors
/// There is no run, or the port cannot be used.
pub fn run(args: ViewArgs) -> Result<(), CliError> {
    let runs = if args.runs.is_empty() { vec![newest(Path::new("out"))?] } else { args.runs };
    for run in &runs {
        RunDirectory::open(run).map_err(|error| match error {
            DirectoryError::NotARun(_) if !run.exists() => {
                CliError::bad_input(format!("{} is not there; give the run directory of `loomtree run`", run.display()))
            }
            other => CliError::bad_input(other),
        })?;
    }
    serve(&runs, &args.page)?;
    loop {
        std::thread::park();
    }
}

/// Starts to serve the page of `runs`, which need not be there yet, and prints its address.
pub(super) fn serve(runs: &[PathBuf], page: &PageArgs) -> Result<(), CliError> {
    let answers = Answers::new(runs.iter().map(|run| Watched::new(run)).collect());
    let server = Server::bind(page.port, answers).map_err(CliError::bad_input)?;
    let address = server.address();
    server.start().map_err(|error| CliError::failed(format!("cannot start to serve the page: {error}")))?;
    answer(&format!("{address}\n"), || json!({ "address": address }))?;
    if page.open {
        let opener = Command::new("xdg-open").arg(&address).stdin(Stdio::null()).stdout(Stdio::null()).spawn();
        if let Err(error) = opener {
            note(format_args!("warning: xdg-open cannot be started ({error}); open {address} yourself"));
        }
    }
    Ok(())
}

/// The run directory in `folder` whose report was written last.
fn newest(folder: &Path) -> Result<PathBuf, CliError> {
    let runs = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let written = |run: &PathBuf| std::fs::metadata(run.join("report.json")).and_then(|meta| meta.modified()).ok();
    let newest = runs.filter_map(|run| Some((written(&run)?, run))).max();
    let none =
        || CliError::bad_input(format!("there is no run in {}/; say which: loomtree view RUN", folder.display()));
    newest.map(|(_, run)| run).ok_or_else(none)
}
