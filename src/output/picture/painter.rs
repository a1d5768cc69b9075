//! Draws a frame on the device of an executor, or on the processor where the executor is native.

use std::sync::{Mutex, PoisonError};

use super::content::Content;
use super::image::Image;
use super::look::{Look, SAMPLES};
use super::{raster, shade};
use crate::gpu::{DrawLook, DrawVertex, Executor, GpuError, Offscreen};

/// Draws pictures of one size and look, from any thread.
pub(super) struct Painter<'a> {
    look: &'a Look,
    width: usize,
    height: usize,
    device: Option<Device<'a>>,
}

/// One picture at a time is on the device; threads prepare and write the others meanwhile.
struct Device<'a> {
    place: Mutex<Offscreen<'a>>,
    look: DrawLook,
}

impl<'a> Painter<'a> {
    pub(super) fn new(
        executor: &'a Executor,
        look: &'a Look,
        width: u32,
        height: u32,
    ) -> Result<Painter<'a>, GpuError> {
        let place = Offscreen::new(executor, width, height)?;
        let (width, height) = (width as usize, height as usize);
        let device = place.map(|place| Device { place: Mutex::new(place), look: look.for_device(width, height) });
        Ok(Painter { look, width, height, device })
    }

    pub(super) fn draw(&self, content: &Content) -> Result<Image, GpuError> {
        let Some(device) = &self.device else {
            let samples = (self.width * SAMPLES, self.height * SAMPLES);
            let visible = raster::rasterize(content, &self.look.camera, samples);
            return Ok(shade::shade(content, self.look, &visible, self.width, self.height));
        };
        let vertices = device_vertices(content);
        let mut place = device.place.lock().unwrap_or_else(PoisonError::into_inner);
        let rgba = place.draw(&vertices, &content.triangles, &device.look)?;
        Ok(Image::from_rgba(self.width, self.height, &rgba))
    }
}

fn device_vertices(content: &Content) -> Vec<DrawVertex> {
    let vertex = |i: usize| {
        // No triangle has a broken corner, so what stands in for its position is never seen.
        let position = if content.positions[i].is_finite() { content.positions[i].to_array() } else { [0.0; 3] };
        DrawVertex { position, normal: content.normals[i].to_array(), swatch: content.swatches[i] }
    };
    (0..content.positions.len()).map(vertex).collect()
}
