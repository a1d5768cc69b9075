//! Hash of the scene that a state belongs to. xxh3 detects accidental changes, not deliberate ones.

use std::fmt::{self, Write};

use xxhash_rust::xxh3::Xxh3;

use crate::math::DVec3;
use crate::model::hash_words;
use crate::scene::{Obstacles, Scene};

/// Hash of everything that determines how a state evolves: topology, rest shape, fabrics, pins, motions and settings.
/// The start state is excluded, because the checkpoint holds its own. The number of frames is excluded, so that a run
/// can be extended.
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
    // Debug output has the shortest digits that read back to the same bits, and includes fields that are added later.
    // Formatting cannot fail, because the sink never fails.
    // A field that later versions have added is left out at its default, so that older checkpoints still fit.
    let settings = format!("{settings:?}").replace(", substeps: Auto", "");
    let absent = [", plasticity: None", ", strain_limit: None", ", yield_strain: inf"];
    let fabrics = absent.iter().fold(format!("{:?}", scene.fabrics), |text, absent| text.replace(absent, ""));
    let pins = format!("{:?}", scene.pins).replace(", stiffness_n_m: None, on_touch: false", "");
    let _ = write!(TextSink(&mut hasher), "{fabrics} {pins} {:?} {settings}", scene.motions);
    if !scene.followed.is_empty() {
        let _ = write!(TextSink(&mut hasher), "{:?}", scene.followed);
    }
    let obstacles = Obstacles::new(&scene.obstacles);
    let (positions, triangles) = obstacles.arrays();
    hash_words(&mut hasher, positions);
    hash_words(&mut hasher, triangles);
    let frictions: Vec<f64> = scene.cloths.iter().map(|cloth| cloth.friction).collect();
    let _ = write!(TextSink(&mut hasher), "{:?} {frictions:?}", obstacles.header());
    // Left out where no cloth has any, so that checkpoints of earlier versions still fit.
    if scene.cloths.iter().any(|cloth| cloth.pressure_pa != 0.0) {
        let pressures: Vec<f64> = scene.cloths.iter().map(|cloth| cloth.pressure_pa).collect();
        let _ = write!(TextSink(&mut hasher), "{pressures:?}");
    }
    for (name, list) in [
        ("density", &scene.maps.density),
        ("stiffness", &scene.maps.stiffness),
        ("friction", &scene.maps.friction),
        ("thickness", &scene.maps.thickness),
    ] {
        if !list.is_empty() {
            hasher.update(name.as_bytes());
            hash_words(&mut hasher, list);
        }
    }
    if !scene.folds.is_empty() {
        let _ = write!(TextSink(&mut hasher), "{:?}", scene.folds);
    }
    // Zero near the world's origin; left out there, so that checkpoints of earlier versions still fit.
    if scene.origin_m != DVec3::ZERO {
        hash_words(
            &mut hasher,
            &scene.origin_m.to_array().map(f64::to_bits).map(|bits| [bits as u32, (bits >> 32) as u32]),
        );
    }
    if let Some(sewing) = &scene.sewing {
        hash_words(&mut hasher, &sewing.pairs);
        let closing = format!("{:?}", sewing.closing).replace("start_s: 0.0, ", "");
        let _ = write!(TextSink(&mut hasher), "{closing} {} {}", sewing.weld_m, sewing.refine);
        if sewing.angles.iter().any(|&angle| angle != 0.0) {
            hash_words(&mut hasher, &sewing.angles);
            hash_words(&mut hasher, &sewing.seam_of_pair);
        }
        if let Some(first_m) = &sewing.first_m {
            hash_words(&mut hasher, first_m);
        }
    }
    hasher.digest()
}

/// Feeds formatted text into the hash without storing it.
struct TextSink<'a>(&'a mut Xxh3);

impl fmt::Write for TextSink<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.update(text.as_bytes());
        Ok(())
    }
}
