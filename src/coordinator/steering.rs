//! What is needed to change the scene of a run while it goes on.

use crate::scene::{Change, Edit, Handles, Overrides, ParsedScene, SceneError};

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

    /// Whether a change that is known before makes another mesh.
    pub fn changes_mesh(&self) -> bool {
        let is_of_mesh = |change: &Change| matches!(change.edit, Edit::Sew(_) | Edit::Refine { .. });
        self.of_scene.iter().chain(&self.recorded).any(is_of_mesh)
    }
}
