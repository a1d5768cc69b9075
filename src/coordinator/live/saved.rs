//! Saves the scene of a run with what was changed so far as a scene file, which then makes the same run.

use std::path::{Path, PathBuf};

use crate::output::{RunDirectory, RunManifest, write_atomically};
use crate::scene::{changes_text, read_changes, with_absolute_files};

/// Writes `file` (beside the files of `run` if it is a name alone) and returns its path.
///
/// # Errors
/// A sentence.
pub(super) fn save(run: &Path, file: &str) -> Result<PathBuf, String> {
    let text = |error: &dyn std::fmt::Display| error.to_string();
    let path = run.join(file);
    if path.exists() {
        return Err(format!("{} is there already; give another name", path.display()));
    }
    let directory = RunDirectory::open(run).map_err(|error| text(&error))?;
    let manifest = RunManifest::load(&directory).map_err(|error| text(&error))?;
    if !manifest.scene_path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml")) {
        return Err("only a scene in TOML can be saved with its changes; --replay run_changes.toml repeats them".into());
    }
    let folder = manifest.scene_path.parent().unwrap_or(Path::new(""));
    let scene = with_absolute_files(&manifest.text_to_read(), folder)?;
    let changes = match std::fs::read_to_string(directory.changes()) {
        Ok(record) => read_changes(&record, &directory.changes()).map_err(|error| text(&error))?,
        Err(_) => Vec::new(),
    };
    let changes = changes_text(changes.iter().filter(|change| !change.edit.is_note()))?;
    let number = |name: &str| manifest.flags.get(name).and_then(toml::Value::as_integer);
    let flags = ["resolution", "frames"].into_iter().filter_map(|name| Some(format!(" --{name} {}", number(name)?)));
    let heading = format!(
        "# A scene and what was changed while it ran. The same run once more:\n# loomtree run {file}{}\n\n",
        flags.collect::<String>()
    );
    let write = |out: &mut dyn std::io::Write| {
        out.write_all(heading.as_bytes())?;
        out.write_all(scene.as_bytes())?;
        out.write_all(b"\n")?;
        out.write_all(changes.as_bytes())
    };
    write_atomically(&path, write).map_err(|error| error.to_string())?;
    Ok(path)
}
