//! `loomtree init` and `loomtree schema`: a scene to start from, and what editors know of scenes.

use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::json;

use super::{CliError, answer, print};
use crate::os::console::is_json;
use crate::output::write_atomically;
use crate::scene::SCHEMA;

/// Write a commented scene to start from.
#[derive(Args, Clone, Debug)]
pub struct InitArgs {
    /// The file
    #[arg(default_value = "scene.toml")]
    pub scene: PathBuf,
    /// Replace a file that is there
    #[arg(long)]
    pub overwrite: bool,
}

/// Print a JSON Schema of scene files, for editors that complete and check TOML.
#[derive(Args, Clone, Debug)]
pub struct SchemaArgs {
    /// Write it to a file instead
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

const SCENE: &str = include_str!("init_scene.toml");

/// Runs `init`.
///
/// # Errors
/// The file is there, is not named as a scene, or cannot be written.
pub fn init(args: InitArgs) -> Result<(), CliError> {
    let place = args.scene.display();
    if args.scene.extension().is_none_or(|extension| extension != "toml") {
        return Err(CliError::bad_input(format!("{place}: the name of a scene ends in .toml")));
    }
    if args.scene.exists() && !args.overwrite {
        return Err(CliError::bad_input(format!("{place} is there already; --overwrite replaces it")));
    }
    write(&args.scene, SCENE)?;
    answer(&format!("{place}; next: loomtree run {place} --view\n"), || json!({ "file": args.scene }))
}

/// Runs `schema`.
///
/// # Errors
/// The file cannot be written.
pub fn schema(args: SchemaArgs) -> Result<(), CliError> {
    match args.out {
        None => print(SCHEMA),
        Some(path) => {
            write(&path, SCHEMA)?;
            if is_json() { answer("", || json!({ "file": path })) } else { Ok(()) }
        }
    }
}

fn write(path: &Path, text: &str) -> Result<(), CliError> {
    write_atomically(path, |out| out.write_all(text.as_bytes())).map_err(CliError::bad_input)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Overrides, parse};

    #[test]
    fn the_scene_to_start_from_is_valid() {
        let scene = parse(SCENE, Path::new("scene.toml"), &Overrides::default()).unwrap();
        assert_eq!((scene.obstacles.len(), scene.warnings.len(), scene.settings.frames), (2, 0, 50));
    }
}
