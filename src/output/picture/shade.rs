//! Colors of a picture on the processor: two-sided cloth under a key light, a fill light and a rim light, over a faint
//! ground grid. Computed in linear light, 2x2 samples per pixel. Twin of `gpu/offscreen.wgsl`.

use super::camera::Camera;
use super::content::{Content, OBSTACLE};
use super::image::{Image, srgb_from_linear};
use super::look::{FRONTS, Look, SAMPLES, SKY_BOTTOM, SKY_TOP, VIRIDIS};
use super::options::Coloring;
use super::raster::{EMPTY, Visible};
use crate::math::Vec3;

/// The picture of what is visible.
pub(super) fn shade(content: &Content, look: &Look, visible: &Visible, width: usize, height: usize) -> Image {
    let size = ((width * SAMPLES) as f32, (height * SAMPLES) as f32);
    let shader = Shader { content, look, visible, size };
    let mut image = Image::new(width, height);
    for y in 0..height {
        for x in 0..width {
            let mut sum = Vec3::ZERO;
            for sample in 0..SAMPLES * SAMPLES {
                sum += shader.sample(x * SAMPLES + sample % SAMPLES, y * SAMPLES + sample / SAMPLES);
            }
            image.set(x, y, srgb_from_linear(sum / (SAMPLES * SAMPLES) as f32));
        }
    }
    image
}

struct Shader<'a> {
    content: &'a Content,
    look: &'a Look,
    visible: &'a Visible,
    /// Samples per row and rows of samples.
    size: (f32, f32),
}

impl Shader<'_> {
    /// Linear color of a sample.
    fn sample(&self, x: usize, y: usize) -> Vec3 {
        let (sx, sy) = (x as f32 + 0.5, y as f32 + 0.5);
        let ray = self.look.camera.ray(2.0 * sx / self.size.0 - 1.0, 2.0 * sy / self.size.1 - 1.0);
        let t = self.visible.triangle[y * self.visible.width + x];
        if t == EMPTY {
            return self.background(ray, sy / self.size.1);
        }
        let vertices = self.content.triangles[t as usize];
        let (w, front) = self.visible.weights(self.content, &self.look.camera, t, sx, sy);
        let blend = |value: &dyn Fn(usize) -> Vec3| -> Vec3 { (0..3).map(|c| value(c) * w[c]).sum() };
        let camera = &self.look.camera;
        let normal = blend(&|c| self.content.normals[vertices[c] as usize]).normalize_or(camera.world_up);
        let normal = if front { normal } else { -normal };
        let view = -ray.normalize();
        let swatch = self.content.swatches[vertices[0] as usize];
        let albedo = match self.look.coloring {
            Coloring::Normal if swatch < OBSTACLE => return seen_direction(normal, camera),
            Coloring::Height if swatch < OBSTACLE => {
                let height = blend(&|c| self.content.positions[vertices[c] as usize]).dot(camera.world_up);
                let (low, high) = self.look.heights_m;
                viridis((height - low) / (high - low).max(1e-9))
            }
            _ if front => FRONTS[swatch as usize],
            _ => self.look.backs[swatch as usize],
        };
        self.lit(albedo, normal, view)
    }

    fn lit(&self, albedo: Vec3, normal: Vec3, view: Vec3) -> Vec3 {
        let sky = 0.5 + 0.5 * normal.dot(self.look.camera.world_up);
        // Half of the key light reaches round the edge: folds stay readable where it does not shine directly.
        let key = normal.dot(self.look.key);
        let key = 0.55 * key.max(0.0) + 0.50 * (0.5 + 0.5 * key).powi(2);
        let diffuse = 0.05 + 0.12 * sky + key + 0.16 * normal.dot(self.look.fill).max(0.0);
        let half = (self.look.key + view).normalize();
        let gloss = 0.07 * normal.dot(half).max(0.0).powi(18);
        let rim = 0.10 * (1.0 - normal.dot(view).abs().min(1.0)).powi(4);
        albedo * diffuse + Vec3::splat(gloss) + (albedo * 0.5 + 0.5) * rim
    }

    /// A light gradient, and below the horizon a grid on the ground that fades into the distance.
    fn background(&self, ray: Vec3, down: f32) -> Vec3 {
        let camera = &self.look.camera;
        let sky = SKY_TOP.lerp(SKY_BOTTOM, down);
        let fall = ray.dot(camera.world_up);
        let above = camera.eye.dot(camera.world_up) - camera.ground_m;
        if fall >= -1e-4 || above <= 0.0 {
            return sky;
        }
        let distance = -above / fall;
        let point = camera.eye + ray * distance;
        // A line is as wide as two samples, so that it does not break up; it fades where lines would run together.
        let grid_m = self.look.grid_m;
        let line_m = 4.0 * distance * camera.half.x / self.size.0;
        let crowded = line_m / grid_m * (distance / above).max(1.0);
        let fade = (1.0 - 2.0 * crowded).max(0.0);
        let on_line = |x: f32| (x / grid_m - (x / grid_m).round()).abs() * grid_m < 0.5 * line_m;
        let (a, b) = if camera.world_up == Vec3::Z { (point.x, point.y) } else { (point.x, point.z) };
        let strength = if on_line(a) || on_line(b) { 0.25 * fade } else { 0.0 };
        sky * (1.0 - strength)
    }
}

/// A direction as a color: to the right red, to the top green, to the viewer blue.
fn seen_direction(normal: Vec3, camera: &Camera) -> Vec3 {
    let seen = Vec3::new(normal.dot(camera.right), normal.dot(camera.up), -normal.dot(camera.forward));
    (seen * 0.5 + 0.5).max(Vec3::ZERO).powf(2.2)
}

/// The viridis scale; `x` from 0 to 1.
fn viridis(x: f32) -> Vec3 {
    let x = x.clamp(0.0, 1.0) * 4.0;
    let stop = (x as usize).min(3);
    VIRIDIS[stop].lerp(VIRIDIS[stop + 1], x - stop as f32)
}
