//! Camera, lights and colors, the same in all pictures of a sequence and for both ways of drawing.

use super::camera::Camera;
use super::content::OBSTACLE;
use super::options::Coloring;
use crate::gpu::{DrawLook, SWATCHES};
use crate::math::Vec3;

/// Samples along each side of a pixel.
pub(super) const SAMPLES: usize = 2;

// Linear colors.
pub(super) const SKY_TOP: Vec3 = Vec3::new(0.70, 0.75, 0.82);
pub(super) const SKY_BOTTOM: Vec3 = Vec3::new(0.92, 0.92, 0.91);

/// Fronts by swatch: cloth in one piece, seven pieces, obstacles.
pub(super) const FRONTS: [Vec3; SWATCHES] = [
    Vec3::new(0.60, 0.10, 0.075),
    Vec3::new(0.60, 0.10, 0.075),
    Vec3::new(0.07, 0.22, 0.55),
    Vec3::new(0.66, 0.38, 0.04),
    Vec3::new(0.06, 0.34, 0.13),
    Vec3::new(0.33, 0.10, 0.46),
    Vec3::new(0.03, 0.40, 0.42),
    Vec3::new(0.62, 0.20, 0.34),
    Vec3::new(0.36, 0.36, 0.34),
];

/// Backs by swatch: of one piece blue, of several a paler tint of the front, so that a color names a piece.
pub(super) fn backs() -> [Vec3; SWATCHES] {
    std::array::from_fn(|i| match i {
        0 => Vec3::new(0.10, 0.23, 0.48),
        _ if i as u32 == OBSTACLE => FRONTS[i],
        _ => FRONTS[i].lerp(Vec3::splat(0.42), 0.5),
    })
}

/// Five stops of the viridis scale.
pub(super) const VIRIDIS: [Vec3; 5] = [
    Vec3::new(0.058, 0.000, 0.089),
    Vec3::new(0.042, 0.084, 0.258),
    Vec3::new(0.015, 0.279, 0.262),
    Vec3::new(0.108, 0.582, 0.122),
    Vec3::new(0.983, 0.799, 0.018),
];

/// Camera, lights and colors.
pub(super) struct Look {
    /// The camera of the sequence.
    pub camera: Camera,
    /// Meaning of the cloth's colors.
    pub coloring: Coloring,
    /// Lowest and highest height of the cloth over the sequence, meters.
    pub heights_m: (f32, f32),
    /// Unit vector towards the main light.
    pub key: Vec3,
    /// Unit vector towards the weak light.
    pub fill: Vec3,
    /// Distance of the lines on the ground, meters.
    pub grid_m: f32,
    /// Colors of backs, by swatch.
    pub backs: [Vec3; SWATCHES],
}

impl Look {
    pub(super) fn new(camera: Camera, coloring: Coloring, heights_m: (f32, f32)) -> Look {
        // Lights move with the camera: from the upper left, and a weak one from the right.
        let key = (camera.right * -0.75 + camera.up * 0.65 - camera.forward * 0.45).normalize();
        let fill = (camera.right * 0.9 + camera.up * 0.1 - camera.forward * 0.5).normalize();
        let grid_m = 10f32.powf((camera.extent_m / 4.0).log10().floor());
        Look { camera, coloring, heights_m, key, fill, grid_m, backs: backs() }
    }

    /// The same for the device, for pictures of `width` x `height` pixels.
    pub(super) fn for_device(&self, width: usize, height: usize) -> DrawLook {
        let vector = |v: Vec3| v.extend(0.0).to_array();
        let camera = &self.camera;
        let samples = [width, height].map(|pixels| (pixels * SAMPLES) as f32);
        let mode = match self.coloring {
            Coloring::Shaded => 0,
            Coloring::Height => 1,
            Coloring::Normal => 2,
        };
        DrawLook {
            eye: vector(camera.eye),
            right: vector(camera.right),
            up: vector(camera.up),
            forward: vector(camera.forward),
            world_up: vector(camera.world_up),
            key_light: vector(self.key),
            fill_light: vector(self.fill),
            sky_top: vector(SKY_TOP),
            sky_bottom: vector(SKY_BOTTOM),
            half_and_samples: [camera.half.x, camera.half.y, samples[0], samples[1]],
            heights: [self.heights_m.0, self.heights_m.1, camera.ground_m, self.grid_m],
            near: [camera.near_m(), 0.0, 0.0, 0.0],
            coloring: [mode, OBSTACLE, 0, 0],
            fronts: FRONTS.map(vector),
            backs: self.backs.map(vector),
            scale: VIRIDIS.map(vector),
        }
    }
}
