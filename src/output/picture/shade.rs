//! Colours of a picture: two-sided cloth under a key light, a fill light and a rim light, over a faint ground grid.
//! Computed in linear light, 2x2 samples per pixel.

use super::Coloring;
use super::camera::Camera;
use super::image::{Image, srgb_from_linear};
use super::raster::{EMPTY, Visible, signed_area, weights};
use crate::math::Vec3;
use crate::output::FrameMesh;

/// Samples along each side of a pixel.
pub const SAMPLES: usize = 2;

/// What is the same in all pictures of a sequence.
pub struct Look {
    /// Where it is seen from.
    pub camera: Camera,
    /// What colours mean.
    pub coloring: Coloring,
    /// Lowest and highest height of the sequence, metres.
    pub heights_m: (f32, f32),
}

// Linear reflectances.
const FRONT: Vec3 = Vec3::new(0.60, 0.10, 0.075);
const BACK: Vec3 = Vec3::new(0.10, 0.23, 0.48);
const OBSTACLE: Vec3 = Vec3::new(0.36, 0.36, 0.34);
const SKY_TOP: Vec3 = Vec3::new(0.70, 0.75, 0.82);
const SKY_BOTTOM: Vec3 = Vec3::new(0.92, 0.92, 0.91);

/// The picture of what is visible; triangles from `cloth` on are obstacles.
pub fn shade(mesh: &FrameMesh, cloth: usize, look: &Look, visible: &Visible, width: usize, height: usize) -> Image {
    let normals = vertex_normals(mesh);
    let shader = Shader::new(mesh, cloth, look, visible, &normals, height * SAMPLES);
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

/// Sums of the triangles' normals, weighted by area; not of unit length.
fn vertex_normals(mesh: &FrameMesh) -> Vec<Vec3> {
    let mut normals = vec![Vec3::ZERO; mesh.positions.len()];
    for t in &mesh.triangles {
        let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
        let normal = (b - a).cross(c - a);
        if normal.is_finite() {
            t.iter().for_each(|i| normals[*i as usize] += normal);
        }
    }
    // Unit length here: corners of big and small triangles shall count alike when normals are blended.
    normals.iter_mut().for_each(|n| *n = n.normalize_or_zero());
    normals
}

struct Shader<'a> {
    mesh: &'a FrameMesh,
    cloth: usize,
    look: &'a Look,
    visible: &'a Visible,
    normals: &'a [Vec3],
    size: (f32, f32),
    key: Vec3,
    fill: Vec3,
    grid_m: f32,
}

impl<'a> Shader<'a> {
    fn new(
        mesh: &'a FrameMesh,
        cloth: usize,
        look: &'a Look,
        visible: &'a Visible,
        normals: &'a [Vec3],
        height: usize,
    ) -> Shader<'a> {
        let camera = &look.camera;
        // Lights move with the camera: from the upper left, and a weak one from the right.
        let key = (camera.right * -0.75 + camera.up * 0.65 - camera.forward * 0.45).normalize();
        let fill = (camera.right * 0.9 + camera.up * 0.1 - camera.forward * 0.5).normalize();
        let size = (visible.width as f32, height as f32);
        let grid_m = 10f32.powf((camera.extent_m / 4.0).log10().floor());
        Shader { mesh, cloth, look, visible, normals, size, key, fill, grid_m }
    }

    /// Linear colour of a sample.
    fn sample(&self, x: usize, y: usize) -> Vec3 {
        let (sx, sy) = (x as f32 + 0.5, y as f32 + 0.5);
        let ray = self.look.camera.ray(2.0 * sx / self.size.0 - 1.0, 2.0 * sy / self.size.1 - 1.0);
        let t = self.visible.triangle[y * self.visible.width + x];
        if t == EMPTY {
            return self.background(ray, sy / self.size.1);
        }
        let vertices = self.mesh.triangles[t as usize];
        let corners = vertices.map(|i| self.visible.screen[i as usize]);
        let w = weights(corners, sx, sy);
        let blend = |value: &dyn Fn(usize) -> Vec3| -> Vec3 { (0..3).map(|c| value(c) * w[c]).sum() };
        // Counter-clockwise triangles turn clockwise area negative where y points down: then the front is seen.
        let front = signed_area(corners) < 0.0;
        let normal = blend(&|c| self.normals[vertices[c] as usize]).normalize_or(self.look.camera.world_up);
        let normal = if front { normal } else { -normal };
        let view = -ray.normalize();
        if self.look.coloring == Coloring::Normal && (t as usize) < self.cloth {
            let camera = &self.look.camera;
            let seen = Vec3::new(normal.dot(camera.right), normal.dot(camera.up), -normal.dot(camera.forward));
            return (seen * 0.5 + 0.5).powf(2.2);
        }
        let albedo = match self.look.coloring {
            _ if t as usize >= self.cloth => OBSTACLE,
            Coloring::Height => {
                let height = blend(&|c| self.mesh.positions[vertices[c] as usize]).dot(self.look.camera.world_up);
                let (low, high) = self.look.heights_m;
                viridis((height - low) / (high - low).max(1e-9))
            }
            _ if front => FRONT,
            _ => BACK,
        };
        self.lit(albedo, normal, view)
    }

    fn lit(&self, albedo: Vec3, normal: Vec3, view: Vec3) -> Vec3 {
        let sky = 0.5 + 0.5 * normal.dot(self.look.camera.world_up);
        // Half of the key light reaches round the edge: folds stay readable where it does not shine directly.
        let key = normal.dot(self.key);
        let key = 0.55 * key.max(0.0) + 0.50 * (0.5 + 0.5 * key).powi(2);
        let diffuse = 0.05 + 0.12 * sky + key + 0.16 * normal.dot(self.fill).max(0.0);
        let half = (self.key + view).normalize();
        let gloss = 0.07 * normal.dot(half).max(0.0).powi(18);
        let rim = 0.10 * (1.0 - normal.dot(view).abs()).powi(4);
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
        let line_m = 4.0 * distance * camera.half.x / self.size.0;
        let crowded = line_m / self.grid_m * (distance / above).max(1.0);
        let fade = (1.0 - 2.0 * crowded).max(0.0);
        let on_line = |x: f32| (x / self.grid_m - (x / self.grid_m).round()).abs() * self.grid_m < 0.5 * line_m;
        let (a, b) = if camera.world_up == Vec3::Z { (point.x, point.y) } else { (point.x, point.z) };
        let strength = if on_line(a) || on_line(b) { 0.25 * fade } else { 0.0 };
        sky * (1.0 - strength)
    }
}

/// Five stops of the viridis scale in linear light; `x` from 0 to 1.
fn viridis(x: f32) -> Vec3 {
    const STOPS: [Vec3; 5] = [
        Vec3::new(0.058, 0.000, 0.089),
        Vec3::new(0.042, 0.084, 0.258),
        Vec3::new(0.015, 0.279, 0.262),
        Vec3::new(0.108, 0.582, 0.122),
        Vec3::new(0.983, 0.799, 0.018),
    ];
    let x = x.clamp(0.0, 1.0) * 4.0;
    let stop = (x as usize).min(3);
    STOPS[stop].lerp(STOPS[stop + 1], x - stop as f32)
}
