//! A scene with one obstacle from a file, for the tests of bodies and caches.

use std::path::Path;

use loomtree::scene::{Obstacles, Overrides, Scene, parse};

const SHEET: &str = "[simulation]\ncollisions = false\n[[cloth]]\nsheet = { size_m = [1, 1], triangles = 8 }\n";

/// A sheet with one obstacle, the fields of which are `obstacle`; files are searched in `folder`.
pub(crate) fn read(folder: &Path, obstacle: &str) -> Result<Scene, String> {
    let text = format!("{SHEET}[[obstacle]]\n{obstacle}\n");
    parse(&text, &folder.join("x.toml"), &Overrides::default()).map_err(|error| error.to_string())
}

/// Positions of all obstacle vertices at a time, xyz.
pub(crate) fn positions(scene: &Scene, time_s: f64) -> Vec<f32> {
    let mut values = Vec::new();
    Obstacles::new(&scene.obstacles).positions_at(time_s, &mut values);
    values
}
