//! What is needed to change the scene of a run while it goes on.

use super::live::merged;
use crate::scene::{Change, Edit, Handles, Overrides, ParsedScene, Scene, SceneError};

/// Names of a scene that changes use, changes that are known before, and whether others may be asked for.
#[derive(Clone, Debug, Default)]
pub struct Steering {
    /// Pins, cloths and edges by name.
    pub handles: Handles,
    /// Changes of the scene file (`[[change]]`).
    pub of_scene: Vec<Change>,
    /// Changes of a record: those to make again, and those that a run that goes on has made.
    pub recorded: Vec<Change>,
    /// Whether clients may change the run through its socket.
    pub live: bool,
    /// Whether it stands still before its first step.
    pub paused: bool,
}

impl Steering {
    /// For a scene at a resolution, without changes but its own.
    ///
    /// # Errors
    /// Those of [`ParsedScene::at`].
    pub fn new(parsed: &ParsedScene, overrides: &Overrides) -> Result<Steering, SceneError> {
        let (handles, of_scene) = (parsed.handles(overrides)?, parsed.changes().to_vec());
        Ok(Steering { handles, of_scene, ..Steering::default() })
    }

    /// Checks what can be checked of the changes before the run: names and values, not meshes of later.
    ///
    /// # Errors
    /// A sentence.
    pub fn check(&self, scene: &Scene) -> Result<(), String> {
        let changes = merged(&self.of_scene, &self.recorded);
        if changes.is_empty() {
            return Ok(());
        }
        let (mut scene, mut handles) = (scene.clone(), self.handles.clone());
        for change in &changes {
            let checked = match &change.edit {
                Edit::Sew(seam) => handles.check_seam(seam),
                // What is sewn follows from the state.
                Edit::Unsew { .. } | Edit::Refine { .. } => Ok(()),
                edit if edit.is_note() => Ok(()),
                edit => scene.edit(&mut handles, edit).map(|_| ()),
            };
            let what = change.table.get("do").and_then(toml::Value::as_str).unwrap_or_default();
            checked.map_err(|why| format!("the change `{what}` of step {} cannot be made: {why}", change.step))?;
        }
        Ok(())
    }

    /// Whether a change that is known before makes another mesh.
    pub fn changes_mesh(&self) -> bool {
        let is_of_mesh = |change: &Change| matches!(change.edit, Edit::Sew(_) | Edit::Refine { .. });
        self.of_scene.iter().chain(&self.recorded).any(is_of_mesh)
    }
}
