//! Reads a scene file into a validated [`Scene`]: meshes, fabrics, pins, obstacles, wind and solver settings. It holds
//! no simulation state.

mod alembic;
mod arcsim;
mod body_file;
mod cache;
mod cache_file;
mod change;
mod cloth_file;
mod cloth_source;
mod crossings;
mod edit;
mod error;
mod fabric;
mod fields;
mod file;
mod files;
mod force_field;
mod force_file;
mod gltf;
mod grip;
mod handles;
mod json;
mod keyframes;
mod live_seam;
mod map_file;
mod map_values;
mod maps;
mod model;
mod motion;
mod obstacle;
mod obstacle_file;
mod over_time;
mod parsed;
mod pattern;
mod pieces;
mod person;
mod pin_file;
mod pins;
mod placement;
mod playback;
mod preconditioner;
mod rig;
mod rig_track;
mod sampled;
mod schema;
mod seam;
mod seam_chords;
mod seam_fault;
mod seam_file;
mod sequence;
mod set_blame;
mod set_fields;
mod settings_file;
mod sewing;
mod sheet;
mod start;
mod substeps;
mod time_table;
mod usd;
mod wrap;

use std::path::Path;

pub use body_file::{MovingMeshes, read_moving_meshes};
pub use cache::Cache;
pub use change::{Change, Edit, FabricEdit, Of, SeamEdit, SeamEditShape, SideEdit, changes_text, read_changes};
pub use crossings::{BestState, Crossings, Doubled, Untangling};
pub use error::SceneError;
pub use fabric::{Fabric, Plasticity, StrainLimit, load_fabric, parse_fabric};
pub use force_field::{FieldShape, ForceField};
pub use gltf::{BodyFile, Clip, read_body};
pub use grip::{Grip, Hold};
pub use handles::{Handles, PinGroup};
pub use live_seam::AddedSeam;
pub use maps::Maps;
pub use model::{Cloth, DEFAULT_THICKNESS_M, Fold, Overrides, Pin, RESOLUTIONS, Scene, Settings, SettingsOverTime};
pub use motion::{Keyframe, Motion};
pub use obstacle::{Movement, Obstacle, ObstacleHeader, Obstacles};
pub use over_time::{Between, OverTime};
pub use parsed::ParsedScene;
pub use pieces::size_warning;
pub use playback::Playback;
pub use preconditioner::PreconditionerKind;
pub use rig::Rig;
pub use schema::SCHEMA;
pub use seam::SeamEnd;
pub use set_blame::blame;
pub use set_fields::{fields_of_fps, runs_of_fields, set_fields, with_absolute_files};
pub use sewing::{Closing, Sewing};
pub use sheet::{Sheet, sheet_cells};
pub use start::GivenStart;
pub use substeps::Substeps;
pub use time_table::{PartitionRule, Recovery, SeamRule, TimeTable};

/// Reads and checks a scene file: `.toml` in the format of `docs/scene.md` or `.json` in ARCSim's format.
/// [`ParsedScene::at`] then builds scenes from it.
pub fn read(path: &Path) -> Result<ParsedScene, SceneError> {
    let parser = parser_of(path)?;
    parser(&files::read_text(path)?, path)
}

/// Like [`read`], with the text given. Relative file names are looked up as if the text were the file `path`.
pub fn read_str(text: &str, path: &Path) -> Result<ParsedScene, SceneError> {
    parser_of(path)?(text, path)
}

/// Reads a scene file and builds the scene at one resolution.
pub fn load(path: &Path, overrides: &Overrides) -> Result<Scene, SceneError> {
    read(path)?.at(overrides)
}

/// Reads a scene file and builds the scene at one resolution; untangles its start state if needed. See
/// [`ParsedScene::untangled_at`].
pub fn load_untangled(path: &Path, overrides: &Overrides) -> Result<(Scene, Option<Untangling>), SceneError> {
    read(path)?.untangled_at(overrides)
}

/// Like [`load`], with the text given.
pub fn parse(text: &str, path: &Path, overrides: &Overrides) -> Result<Scene, SceneError> {
    read_str(text, path)?.at(overrides)
}

/// What a scene of this text says of splitting its shot in time. Nothing, if the text cannot be read: [`read_str`] says
/// why.
///
/// # Errors
/// A field of `[time]` is wrong.
pub fn read_time_table(text: &str, path: &Path) -> Result<TimeTable, SceneError> {
    let is_toml = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml"));
    if is_toml { file::read_time_table(text, path) } else { Ok(TimeTable::default()) }
}

type Parser = fn(&str, &Path) -> Result<ParsedScene, SceneError>;

fn parser_of(path: &Path) -> Result<Parser, SceneError> {
    match path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase().as_str() {
        "toml" => Ok(file::parse),
        "json" => Ok(arcsim::parse),
        _ => Err(SceneError::File {
            path: path.into(),
            what: "its name says no format: a scene ends in .toml (ARCSim's in .json), a mesh in .obj or .ply".into(),
        }),
    }
}
