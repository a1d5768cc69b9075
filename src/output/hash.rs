//! Hashes of bits: the state of a run (equal for every worker count) and the scene that a checkpoint belongs to.
//!
//! xxh3 finds accidents, not attacks.

use std::fmt::{self, Write};

use bytemuck::Pod;
use xxhash_rust::xxh3::Xxh3;

use crate::math::Vec3;
use crate::scene::{Obstacles, Scene};

/// 16 hexadecimal digits over the bits of positions, then velocities, both in the mesh's original vertex order.
/// `-0.0` and `0.0` differ: equal hashes mean equal bits.
pub fn state_hash(positions: &[Vec3], velocities: &[Vec3]) -> String {
    let mut hasher = Xxh3::new();
    update_words(&mut hasher, positions);
    update_words(&mut hasher, velocities);
    format!("{:016x}", hasher.digest())
}

/// Hash of everything that decides how a state goes on: topology, rest shape, fabrics, pins, motions and settings.
/// The start state is left out (the checkpoint holds its own), and so is the number of frames (a run may be prolonged).
pub fn scene_fingerprint(scene: &Scene) -> u64 {
    let mut hasher = Xxh3::new();
    hasher.update(&(scene.mesh.positions.len() as u64).to_le_bytes());
    hasher.update(&(scene.mesh.triangles.len() as u64).to_le_bytes());
    update_words(&mut hasher, &scene.mesh.triangles);
    update_words(&mut hasher, &scene.mesh.material_uv);
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
    update_words(&mut hasher, positions);
    update_words(&mut hasher, triangles);
    let frictions: Vec<f64> = scene.cloths.iter().map(|cloth| cloth.friction).collect();
    let _ = write!(TextSink(&mut hasher), "{:?} {frictions:?}", obstacles.header());
    hasher.digest()
}

/// Adds values made of 32-bit words, as little-endian bytes.
fn update_words<T: Pod>(hasher: &mut Xxh3, values: &[T]) {
    if cfg!(target_endian = "little") {
        hasher.update(bytemuck::cast_slice(values));
    } else {
        bytemuck::cast_slice::<T, u32>(values).iter().for_each(|word| hasher.update(&word.to_le_bytes()));
    }
}

/// Lets formatted text go into the hash without being stored.
struct TextSink<'a>(&'a mut Xxh3);

impl fmt::Write for TextSink<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.update(text.as_bytes());
        Ok(())
    }
}
