//! [`SceneError`], and [`Place`], the position of a field in a scene file.

use std::path::PathBuf;

use crate::mesh::MeshReadError;

use super::crossings::Crossings;

/// Why a scene is refused: one sentence with the file and, where known, line and field.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file is missing, cannot be read or is not a scene.
    #[error("{}: {what}", path.display())]
    File { path: PathBuf, what: String },
    /// The text is not TOML or JSON.
    #[error("{}{}: {what}", path.display(), line_suffix(*line))]
    Syntax { path: PathBuf, line: Option<usize>, what: String },
    /// A field has an invalid value.
    #[error("{}{}: field `{field}`: {what}", path.display(), line_suffix(*line))]
    Field { path: PathBuf, line: Option<usize>, field: String, what: String },
    /// The start state crosses itself or an obstacle.
    #[error("{}{}: field `{field}`: {crossings}", path.display(), line_suffix(*line))]
    Crossing { path: PathBuf, line: Option<usize>, field: String, crossings: Box<Crossings> },
    /// A mesh that the scene names is refused.
    #[error(transparent)]
    Mesh(#[from] MeshReadError),
}

impl SceneError {
    /// The sentence without file and line, for fields that were not read from a file.
    pub(super) fn without_place(&self) -> String {
        match self {
            SceneError::Field { field, what, .. } => format!("field `{field}`: {what}"),
            other => other.what(),
        }
    }

    /// What is wrong, without the place.
    pub(super) fn what(&self) -> String {
        match self {
            SceneError::File { what, .. } | SceneError::Syntax { what, .. } | SceneError::Field { what, .. } => {
                what.clone()
            }
            other => other.to_string(),
        }
    }
}

fn line_suffix(line: Option<usize>) -> String {
    line.map(|line| format!(", line {line}")).unwrap_or_default()
}

/// Position of a field, for error messages.
#[derive(Clone, Debug)]
pub(super) struct Place {
    pub path: PathBuf,
    /// Line number from 1; none for formats without lines.
    pub line: Option<usize>,
    /// Full name of the field, including the tables that contain it.
    pub field: String,
}

impl Place {
    /// Error about this field.
    pub(super) fn error(&self, what: impl Into<String>) -> SceneError {
        SceneError::Field { path: self.path.clone(), line: self.line, field: self.field.clone(), what: what.into() }
    }

    /// Error about cloth at this field whose start state crosses.
    pub(super) fn crossing(&self, crossings: Box<Crossings>) -> SceneError {
        SceneError::Crossing { path: self.path.clone(), line: self.line, field: self.field.clone(), crossings }
    }
}
