//! Lights and background, the same in all pictures of a sequence and for both ways of drawing.

use super::camera::Camera;
use super::light::{Lights, directions};
use crate::gpu::{DrawLook, LIGHTS};
use crate::math::{Vec3, Vec4};

/// Samples along each side of a pixel.
pub(super) const SAMPLES: usize = 2;

// Linear colors.
pub(super) const SKY_TOP: Vec3 = Vec3::new(0.66, 0.71, 0.79);
pub(super) const SKY_BOTTOM: Vec3 = Vec3::new(0.90, 0.90, 0.89);

/// Lights and background.
pub(super) struct Look {
    /// Whether cloth shows its direction instead of its color.
    pub directions: bool,
    /// Whether surfaces and the ground are in shadow where light does not reach them.
    pub shadows: bool,
    /// Unit vector of the scene's up axis.
    pub world_up: Vec3,
    /// Height of the ground, meters, if there is one.
    pub ground_m: Option<f32>,
    /// Unit vector towards the main light.
    pub key: Vec3,
    /// Unit vector towards the weak light.
    pub fill: Vec3,
    /// Distance of the lines on the ground, meters.
    pub grid_m: f32,
    /// Unit vectors towards all directions of the main light and of the sky.
    pub toward: [Vec3; LIGHTS],
}

impl Look {
    /// Lights for the first camera of a sequence; they stay where they are when it moves.
    pub(super) fn new(camera: &Camera, ground_m: Option<f32>) -> Look {
        // From the upper left, and a weak one from the right.
        let up = camera.world_up;
        let level = |v: Vec3| (v - up * v.dot(up)).normalize_or(v);
        let (right, forward) = (level(camera.right), level(camera.forward));
        let key = (right * -0.62 + up * 0.80 - forward * 0.42).normalize();
        let fill = (right * 0.9 + up * 0.15 - forward * 0.5).normalize();
        let grid_m = 10f32.powf((camera.extent_m / 4.0).log10().floor());
        let toward = directions(key, up);
        Look { directions: false, shadows: true, world_up: up, ground_m, key, fill, grid_m, toward }
    }

    /// The same for the device, for pictures of `width` x `height` pixels.
    pub(super) fn for_device(&self, camera: &Camera, lights: &Lights, width: usize, height: usize) -> DrawLook {
        let vector = |v: Vec3| v.extend(0.0).to_array();
        let samples = [width, height].map(|pixels| (pixels * SAMPLES) as f32);
        let flag = |on: bool| f32::from(u8::from(on));
        let rows = |row: usize| lights.rows.each_ref().map(|rows| Vec4::to_array(&rows[row]));
        let heights = std::array::from_fn(|i| lights.toward[i].extend(lights.rows[i][2].w).to_array());
        DrawLook {
            eye: vector(camera.eye),
            right: vector(camera.right),
            up: vector(camera.up),
            forward: vector(camera.forward),
            world_up: vector(self.world_up),
            key_light: vector(self.key),
            fill_light: vector(self.fill),
            sky_top: vector(SKY_TOP),
            sky_bottom: vector(SKY_BOTTOM),
            half_and_samples: [camera.half.x, camera.half.y, samples[0], samples[1]],
            ground: [self.ground_m.unwrap_or(0.0), self.grid_m, flag(self.ground_m.is_some()), flag(self.directions)],
            near: [camera.near_m(), lights.texel_m, flag(!lights.heights.is_empty()), 0.0],
            light_columns: rows(0),
            light_rows: rows(1),
            light_heights: heights,
        }
    }
}
