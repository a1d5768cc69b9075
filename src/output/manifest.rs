//! `run.toml`: everything needed to repeat a run: the scene's text (in a file beside it), the original path of the
//! scene, the files that the scene names, and the flags with all defaults filled in.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use thiserror::Error;
use xxhash_rust::xxh3::xxh3_64;

use super::RunDirectory;
use super::atomic::{WriteError, write_atomically};
use crate::scene::set_fields;

/// The content of `run.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunManifest {
    /// Version of the program.
    pub version: String,
    /// Absolute path that the scene was read from. Relative paths in its text start from this file's folder.
    pub scene_path: PathBuf,
    /// Name of the file in the run directory with the scene's text. [`RunManifest::save`] fills it in.
    #[serde(default)]
    pub scene_file: String,
    /// The scene's unchanged text.
    #[serde(skip)]
    pub scene_text: String,
    /// What a sheet without `mesh` is: `irregular`. None in files from the time when every sheet was a grid.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sheets: Option<String>,
    /// Other files that were read (meshes, fabrics, topology).
    #[serde(default)]
    pub inputs: Vec<Input>,
    /// Name of the file in the run directory with what was changed while the run went on; none if nothing could be.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub changes_file: Option<String>,
    /// Flags of the command line with their defaults filled in. [`RunManifest::flags`] decodes them.
    #[serde(default)]
    pub flags: toml::Table,
}

/// A file that the run has read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Input {
    /// Absolute path.
    pub path: PathBuf,
    /// xxh3 of its bytes, 16 hexadecimal digits.
    pub hash: String,
}

/// Why a manifest cannot be written or read.
#[derive(Debug, Error)]
pub enum ManifestError {
    /// The operating system refused to write.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The file is not TOML of the form that a run writes.
    #[error("{}, line {line}: {message}", path.display())]
    Toml {
        /// `run.toml`.
        path: PathBuf,
        /// Line from 1.
        line: usize,
        /// Description of the error.
        message: String,
    },
    /// A flag has a value that TOML cannot represent.
    #[error("the flags of this run cannot be written as TOML: {0}")]
    Flags(String),
    /// `scene_file` points outside of the run directory.
    #[error("{}: scene_file = {name:?} must be the name of a file in the run directory", path.display())]
    SceneFile {
        /// `run.toml`.
        path: PathBuf,
        /// The value of `scene_file`.
        name: String,
    },
}

impl RunManifest {
    /// A manifest for a scene read from `scene_path` with the text `scene_text`.
    pub fn new<F: Serialize>(scene_path: &Path, scene_text: &str, flags: &F) -> Result<RunManifest, ManifestError> {
        Ok(RunManifest {
            version: env!("CARGO_PKG_VERSION").to_string(),
            scene_path: absolute(scene_path),
            scene_file: String::new(),
            scene_text: scene_text.to_string(),
            sheets: Some("irregular".to_string()),
            inputs: Vec::new(),
            changes_file: None,
            flags: toml::Table::try_from(flags).map_err(|e| ManifestError::Flags(e.to_string()))?,
        })
    }

    /// Replaces the flags, when a run continues with others.
    ///
    /// # Errors
    /// A value that TOML cannot represent.
    pub fn set_flags<F: Serialize>(&mut self, flags: &F) -> Result<(), ManifestError> {
        self.flags = toml::Table::try_from(flags).map_err(|e| ManifestError::Flags(e.to_string()))?;
        Ok(())
    }

    /// Records a file that the run reads, with its hash.
    pub fn add_input(&mut self, path: &Path) -> Result<(), ManifestError> {
        let path = absolute(path);
        let hash = hash_file(&path).map_err(|source| ManifestError::Read { path: path.clone(), source })?;
        self.inputs.push(Input { path, hash });
        Ok(())
    }

    /// One sentence for every recorded file whose content has changed.
    pub fn changed_inputs(&self) -> Vec<String> {
        let mut sentences = Vec::new();
        for input in &self.inputs {
            match hash_file(&input.path) {
                Ok(hash) if hash == input.hash => {}
                Ok(_) => sentences.push(format!("{} has changed since the run was started", input.path.display())),
                Err(e) => sentences.push(format!("{} can no longer be read: {e}", input.path.display())),
            }
        }
        sentences
    }

    /// The scene's text as this version has to read it: sheets of a run from the time of grids say that they are grids.
    /// Fields that the run was given (`--set`) are set.
    pub fn text_to_read(&self) -> String {
        let given = self.flags.get("set").and_then(toml::Value::as_array);
        let given: Vec<String> = given.into_iter().flatten().filter_map(|f| f.as_str().map(str::to_string)).collect();
        let text = self.grids_to_read();
        // The run has set them, so they can be set.
        set_fields(&text, &given).unwrap_or(text)
    }

    fn grids_to_read(&self) -> String {
        let old = self.sheets.is_none().then(|| self.scene_text.parse::<toml::Table>());
        // What is no TOML has no sheets.
        let Some(Ok(mut scene)) = old else { return self.scene_text.clone() };
        let cloths = scene.get_mut("cloth").and_then(toml::Value::as_array_mut);
        for sheet in cloths.into_iter().flatten().filter_map(|cloth| cloth.get_mut("sheet")?.as_table_mut()) {
            sheet.entry("mesh").or_insert_with(|| "grid".into());
        }
        toml::to_string(&scene).unwrap_or_else(|_| self.scene_text.clone())
    }

    /// Decodes the flags into the type that they were made from.
    pub fn flags<F: DeserializeOwned>(&self) -> Result<F, ManifestError> {
        self.flags.clone().try_into().map_err(|e: toml::de::Error| ManifestError::Flags(e.message().to_string()))
    }

    /// Writes the scene's text and `run.toml`.
    pub fn save(&mut self, directory: &RunDirectory) -> Result<(), ManifestError> {
        let json = self.scene_path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
        self.scene_file = if json { "run_scene.json" } else { "run_scene.toml" }.to_string();
        let text = toml::to_string_pretty(self).map_err(|e| ManifestError::Flags(e.to_string()))?;
        write_atomically(&directory.path().join(&self.scene_file), |out| out.write_all(self.scene_text.as_bytes()))?;
        write_atomically(&directory.manifest(), |out| out.write_all(text.as_bytes()))?;
        Ok(())
    }

    /// Reads `run.toml` and the scene's text.
    pub fn load(directory: &RunDirectory) -> Result<RunManifest, ManifestError> {
        let path = directory.manifest();
        let read = |path: &Path| {
            fs::read_to_string(path).map_err(|source| ManifestError::Read { path: path.to_path_buf(), source })
        };
        let text = read(&path)?;
        let mut manifest: RunManifest = toml::from_str(&text).map_err(|e| {
            let before = e.span().map_or(0, |span| span.start.min(text.len()));
            let line = 1 + text.as_bytes()[..before].iter().filter(|b| **b == b'\n').count();
            ManifestError::Toml { path: path.clone(), line, message: e.message().to_string() }
        })?;
        let name = Path::new(&manifest.scene_file);
        if name.file_name() != Some(name.as_os_str()) {
            return Err(ManifestError::SceneFile { path, name: manifest.scene_file });
        }
        manifest.scene_text = read(&directory.path().join(name))?;
        Ok(manifest)
    }
}

fn absolute(path: &Path) -> PathBuf {
    fs::canonicalize(path).or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.to_path_buf())
}

fn hash_file(path: &Path) -> io::Result<String> {
    Ok(format!("{:016x}", xxh3_64(&fs::read(path)?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sheets_of_old_runs_are_grids() {
        let text = "[[cloth]]\nsheet = { size_m = [1, 1] }\n[[cloth]]\nmesh = \"a.obj\"\n";
        let mut manifest = RunManifest::new(Path::new("/a.toml"), text, &toml::Table::new()).unwrap();
        assert_eq!(manifest.text_to_read(), text);
        manifest.sheets = None;
        let read: toml::Table = manifest.text_to_read().parse().unwrap();
        assert_eq!(read["cloth"][0]["sheet"]["mesh"].as_str(), Some("grid"));
        assert_eq!(read["cloth"][1].get("sheet"), None);
        manifest.scene_text = "{ \"json\": 5 }".into();
        assert_eq!(manifest.text_to_read(), manifest.scene_text);
    }
}
