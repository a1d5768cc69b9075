//! Fields shared by cloths, obstacles and motions of ARCSim scenes: file names and transforms.

use std::path::{Path, PathBuf};

use crate::math::{DQuat, DVec3};

use super::super::error::SceneError;
use super::super::json::Json;
use super::super::placement::Placement;

/// Looks up a file beside the scene, in the folder above (ARCSim runs from there) and in the working directory.
pub(super) fn find(field: &Json) -> Result<PathBuf, SceneError> {
    let name = field.text()?;
    let folder = field.file.parent().unwrap_or(Path::new(""));
    let candidates = [folder.join(name), folder.join("..").join(name), PathBuf::from(name)];
    let found = candidates.into_iter().find(|path| path.is_file());
    found.ok_or_else(|| {
        field.error(format!("no file `{name}` beside the scene, in the folder above or in the working directory"))
    })
}

/// Reads `{translate, rotate: [degrees, axis], scale}`.
pub(super) fn placement(json: &Json) -> Result<Placement, SceneError> {
    Ok(Placement {
        translation_m: json.or("translate", DVec3::ZERO, Json::vector)?,
        rotation: json.or("rotate", DQuat::IDENTITY, Json::rotation)?,
        scale: json.or("scale", 1.0, Json::number)?,
    })
}

/// The identity.
pub(super) const UNMOVED: Placement = Placement { translation_m: DVec3::ZERO, rotation: DQuat::IDENTITY, scale: 1.0 };
