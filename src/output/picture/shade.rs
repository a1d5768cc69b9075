//! Colors of a picture on the processor: two-sided cloth under a main light, the sky and a weak light, over a faint
//! ground grid. Computed in linear light, 2x2 samples per pixel. Twin of `gpu/offscreen.wgsl`, except that a pixel
//! whose samples lie on one smooth surface asks once how much light reaches it.

use super::camera::Camera;
use super::content::Content;
use super::image::{Image, srgb_from_linear};
use super::light::Lights;
use super::look::{Look, SAMPLES, SKY_BOTTOM, SKY_TOP};
use super::raster::{EMPTY, Visible};
use crate::math::Vec3;

/// Samples of a pixel.
const COUNT: usize = SAMPLES * SAMPLES;
/// Largest distance of a pixel's samples, in widths of the pixel there, at which they share their light.
const TOGETHER: f32 = 3.0;

/// The picture of what is visible.
pub(super) fn shade(
    content: &Content,
    look: &Look,
    camera: &Camera,
    lights: &Lights,
    visible: &Visible,
    (width, height): (usize, usize),
) -> Image {
    let size = ((width * SAMPLES) as f32, (height * SAMPLES) as f32);
    let shader = Shader { content, look, camera, lights, visible, size };
    let mut image = Image::new(width, height);
    for y in 0..height {
        for x in 0..width {
            image.set(x, y, srgb_from_linear(shader.pixel(x, y)));
        }
    }
    image
}

struct Shader<'a> {
    content: &'a Content,
    look: &'a Look,
    camera: &'a Camera,
    lights: &'a Lights,
    visible: &'a Visible,
    /// Samples per row and rows of samples.
    size: (f32, f32),
}

/// What a sample shows.
enum Seen {
    /// A color that no light changes.
    Plain(Vec3),
    /// A surface of this color.
    Surface(Vec3),
    /// The ground, in this color in the open.
    Ground(Vec3),
}

/// A sample: what it shows, where, and the directions of the surface and back to the eye.
struct Sample {
    seen: Seen,
    point: Vec3,
    normal: Vec3,
    view: Vec3,
    depth: f32,
}

impl Shader<'_> {
    /// Linear color of a pixel.
    fn pixel(&self, x: usize, y: usize) -> Vec3 {
        let samples: [Sample; COUNT] =
            std::array::from_fn(|i| self.sample(x * SAMPLES + i % SAMPLES, y * SAMPLES + i / SAMPLES));
        let shared = self.is_smooth(&samples).then(|| {
            let share = 1.0 / COUNT as f32;
            let point = samples.iter().map(|sample| sample.point * share).sum();
            let normal = samples.iter().map(|sample| sample.normal).sum::<Vec3>().normalize();
            self.lights.reaching(point, normal)
        });
        let light = |sample: &Sample| shared.unwrap_or_else(|| self.lights.reaching(sample.point, sample.normal));
        let color = |sample: &Sample| match sample.seen {
            Seen::Plain(color) => color,
            Seen::Surface(albedo) => self.lit(albedo, sample.normal, sample.view, light(sample)),
            Seen::Ground(color) => color * self.ground_light(light(sample)),
        };
        samples.iter().map(color).sum::<Vec3>() / COUNT as f32
    }

    /// Whether the samples of a pixel lie on one smooth surface.
    fn is_smooth(&self, samples: &[Sample; COUNT]) -> bool {
        let first = &samples[0];
        let wide = TOGETHER * 2.0 * first.depth * self.camera.half.x * SAMPLES as f32 / self.size.0;
        samples.iter().all(|sample| {
            let alike = match (&first.seen, &sample.seen) {
                (Seen::Surface(_), Seen::Surface(_)) => sample.normal.dot(first.normal) > 0.97,
                (Seen::Ground(_), Seen::Ground(_)) => true,
                _ => false,
            };
            alike && sample.point.distance(first.point) < wide
        })
    }

    fn sample(&self, x: usize, y: usize) -> Sample {
        let camera = self.camera;
        let (sx, sy) = (x as f32 + 0.5, y as f32 + 0.5);
        let ray = camera.ray(2.0 * sx / self.size.0 - 1.0, 2.0 * sy / self.size.1 - 1.0);
        let t = self.visible.triangle[y * self.visible.width + x];
        let view = -ray.normalize();
        if t == EMPTY {
            return self.background(ray, view, sy / self.size.1);
        }
        let vertices = self.content.triangles[t as usize];
        let (w, front) = self.visible.weights(self.content, camera, t, sx, sy);
        let blend = |value: &dyn Fn(usize) -> Vec3| -> Vec3 { (0..3).map(|c| value(c) * w[c]).sum() };
        let normal = blend(&|c| self.content.normals[vertices[c] as usize]).normalize_or(camera.world_up);
        let normal = if front { normal } else { -normal };
        let point = blend(&|c| self.content.positions[vertices[c] as usize]);
        let seen = if self.look.directions && (t as usize) < self.content.cloth {
            Seen::Plain(seen_direction(normal, camera))
        } else {
            let side = usize::from(!front);
            Seen::Surface(blend(&|c| self.content.colors[vertices[c] as usize][side]))
        };
        Sample { seen, point, normal, view, depth: (point - camera.eye).dot(camera.forward) }
    }

    /// Color of a surface under the light that reaches it ([`Lights::reaching`]).
    fn lit(&self, albedo: Vec3, normal: Vec3, view: Vec3, [sky, key]: [f32; 2]) -> Vec3 {
        let level = normal.dot(self.look.world_up);
        let toward = normal.dot(self.look.key);
        // Part of the main light reaches round the edge: folds stay readable where it does not shine directly.
        let around = 0.5 + 0.5 * toward;
        let open_sky = 0.25 + 0.75 * (sky / (0.5 + 0.5 * level).max(0.05)).min(1.0);
        let fill = 0.14 * normal.dot(self.look.fill).max(0.0);
        let bounced = 0.10 * (0.5 - 0.5 * level);
        let diffuse = 0.04 + 0.31 * sky + 0.66 * key + (0.26 * around * around + fill + bounced) * open_sky;
        let reached = (key / toward.max(0.05)).min(1.0);
        let half = (self.look.key + view).normalize();
        let gloss = 0.06 * normal.dot(half).max(0.0).powi(18) * reached;
        let rim = 0.10 * (1.0 - normal.dot(view).abs().min(1.0)).powi(4) * open_sky;
        albedo * diffuse + Vec3::splat(gloss) + (albedo * 0.5 + 0.5) * rim
    }

    /// Brightness of the ground where this light reaches it, of the brightness in the open.
    fn ground_light(&self, [sky, key]: [f32; 2]) -> f32 {
        let open_key = (key / self.look.world_up.dot(self.look.key).max(0.05)).min(1.0);
        0.30 + 0.42 * sky.min(1.0) + 0.28 * open_key
    }

    /// A light gradient, and below the horizon a grid on the ground that fades into the distance.
    fn background(&self, ray: Vec3, view: Vec3, down: f32) -> Sample {
        let camera = self.camera;
        let sky = SKY_TOP.lerp(SKY_BOTTOM, down);
        let fall = ray.dot(camera.world_up);
        let above = self.look.ground_m.map_or(0.0, |ground_m| camera.eye.dot(camera.world_up) - ground_m);
        if fall >= -1e-4 || above <= 0.0 {
            return Sample { seen: Seen::Plain(sky), point: Vec3::ZERO, normal: camera.world_up, view, depth: 0.0 };
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
        let seen = Seen::Ground(sky * (1.0 - strength));
        Sample { seen, point, normal: camera.world_up, view, depth: distance }
    }
}

/// A direction as a color: to the right red, to the top green, to the viewer blue.
fn seen_direction(normal: Vec3, camera: &Camera) -> Vec3 {
    let seen = Vec3::new(normal.dot(camera.right), normal.dot(camera.up), -normal.dot(camera.forward));
    (seen * 0.5 + 0.5).max(Vec3::ZERO).powf(2.2)
}
