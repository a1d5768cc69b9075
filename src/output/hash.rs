//! Hash of the scene that a state belongs to. xxh3 finds accidents, not attacks.

use std::fmt::{self, Write};

use xxhash_rust::xxh3::Xxh3;

use crate::model::hash_words;
use crate::scene::{Obstacles, Scene};

/// Hash of everything that decides how a state goes on: topology, rest shape, fabrics, pins, motions and settings.
/// The start state is left out (the checkpoint holds its own), and so is the number of frames (a run may be prolonged).
pub fn scene_fingerprint(scene: &Scene) -> u64 {
    let mut hasher = Xxh3::new();
    hasher.update(&(scene.mesh.positions.len() as u64).to_le_bytes());
    hasher.update(&(scene.mesh.triangles.len() as u64).to_le_bytes());
    hash_words(&mut hasher, &scene.mesh.triangles);
    hash_words(&mut hasher, &scene.mesh.material_uv);
    for fabric in &scene.fabric_of_triangle {
        hasher.update(&fabric.to_le_bytes());
    }
    let mut settings = scene.settings.clone();
    settings.frames = 0;
    // Debug prints the shortest digits that read back to the same bits, and covers fields added later.
    // The sink never fails, so neither does formatting into it.
    let _ = write!(TextSink(&mut hasher), "{:?} {:?} {:?} {settings:?}", scene.fabrics, scene.pins, scene.motions);
    let obstacles = Obstacles::new(&scene.obstacles);
    let (positions, triangles) = obstacles.arrays();
    hash_words(&mut hasher, positions);
    hash_words(&mut hasher, triangles);
    let frictions: Vec<f64> = scene.cloths.iter().map(|cloth| cloth.friction).collect();
    let _ = write!(TextSink(&mut hasher), "{:?} {frictions:?}", obstacles.header());
    hasher.digest()
}

/// Lets formatted text go into the hash without being stored.
struct TextSink<'a>(&'a mut Xxh3);

impl fmt::Write for TextSink<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.update(text.as_bytes());
        Ok(())
    }
}
