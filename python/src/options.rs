//! Scenes and options as Python gives them.

use std::path::PathBuf;

use loomtree::scene::set_fields;
use loomtree::{RunOptions, RunPlan};
use pyo3::prelude::*;

use crate::bad_input;

/// A scene given as JSON, as the text of a scene file.
///
/// # Errors
/// `ValueError`: something that a scene file cannot hold.
#[pyfunction]
pub(crate) fn scene_to_toml(json: &str) -> PyResult<String> {
    let scene: toml::Table = serde_json::from_str(json).map_err(|error| bad_input(format!("the scene: {error}")))?;
    toml::to_string(&scene).map_err(|error| bad_input(format!("the scene: {error}")))
}

/// Options given as a JSON object, over the defaults. Names and values are those of run.toml.
pub(crate) fn options_of(json: &str) -> PyResult<RunOptions> {
    serde_json::from_str(json).map_err(|error| bad_input(format!("the options: {error}")))
}

/// Where a scene is from.
pub(crate) enum SceneSource {
    /// A file.
    File(PathBuf),
    /// A text, and the file whose neighbors its paths name.
    Text(String, PathBuf),
}

impl SceneSource {
    /// A text as if it stood in the folder `base`, or a file.
    pub(crate) fn new(text: Option<String>, path: PathBuf) -> SceneSource {
        match text {
            Some(text) => SceneSource::Text(text, path),
            None => SceneSource::File(path),
        }
    }

    /// # Errors
    /// A sentence about the scene or an option.
    pub(crate) fn plan(&self, options: &RunOptions) -> Result<RunPlan, String> {
        let planned = match self {
            SceneSource::File(path) => RunPlan::new(path, options),
            SceneSource::Text(text, path) => {
                let text = set_fields(text, &options.set).map_err(|what| format!("{}: {what}", path.display()))?;
                RunPlan::of_text(&text, path, options)
            }
        };
        planned.map_err(|error| error.to_string())
    }
}
