//! Draws a frame on the device of an executor, or on the processor where the executor is native.

use std::sync::{Mutex, PoisonError};

use super::camera::Camera;
use super::content::Content;
use super::image::Image;
use super::light::Lights;
use super::look::{Look, SAMPLES};
use super::{raster, shade};
use crate::gpu::{DrawVertex, Executor, GpuError, Offscreen};

/// Radius of what casts shadows, in diameters of the cloth.
const SHADOWS: f32 = 0.75;

/// Draws pictures of one size, from any thread.
pub(super) struct Painter<'a> {
    width: usize,
    height: usize,
    /// One picture at a time is on the device; threads prepare and write the others meanwhile.
    device: Option<Mutex<Offscreen<'a>>>,
}

impl<'a> Painter<'a> {
    pub(super) fn new(executor: &'a Executor, width: u32, height: u32) -> Result<Painter<'a>, GpuError> {
        let device = Offscreen::new(executor, width, height)?.map(Mutex::new);
        Ok(Painter { width: width as usize, height: height as usize, device })
    }

    pub(super) fn draw(&self, look: &Look, content: &Content, camera: &Camera) -> Result<Image, GpuError> {
        let [low, high] = content.bounds();
        let radius_m = SHADOWS * (high - low).length();
        let lights = if look.shadows && radius_m.is_finite() && radius_m > 0.0 {
            Lights::with_shadows(&look.toward, content, 0.5 * (low + high), radius_m)
        } else {
            Lights::plain(&look.toward)
        };
        let Some(device) = &self.device else {
            let samples = (self.width * SAMPLES, self.height * SAMPLES);
            let visible = raster::rasterize(content, camera, samples);
            return Ok(shade::shade(content, look, camera, &lights, &visible, (self.width, self.height)));
        };
        let vertices = device_vertices(content);
        let device_look = look.for_device(camera, &lights, self.width, self.height);
        let mut place = device.lock().unwrap_or_else(PoisonError::into_inner);
        let rgba = place.draw(&vertices, &content.triangles, &device_look, &lights.heights)?;
        Ok(Image::from_rgba(self.width, self.height, &rgba))
    }
}

fn device_vertices(content: &Content) -> Vec<DrawVertex> {
    let cloth = content.triangles[..content.cloth].iter().flatten().max().map_or(0, |v| *v as usize + 1);
    let vertex = |i: usize| {
        // No triangle has a broken corner, so what stands in for its position is never seen.
        let position = if content.positions[i].is_finite() { content.positions[i].to_array() } else { [0.0; 3] };
        let [front, back] = content.colors[i].map(|color| color.to_array());
        DrawVertex { position, normal: content.normals[i].to_array(), front, back, cloth: u32::from(i < cloth) }
    };
    (0..content.positions.len()).map(vertex).collect()
}
