//! Where the camera stands: a view that shows much of the cloth, from as near as the whole sequence allows.

use crate::math::{Vec2, Vec3};
use crate::output::FrameMesh;

/// Share of the picture that the sequence may fill.
const FILL: f32 = 0.88;

/// Height of the sensor that lenses are given for, millimeters.
const SENSOR_MM: f32 = 24.0;

/// A perspective camera without roll.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Camera {
    /// Position of the eye, meters.
    pub eye: Vec3,
    /// Unit vector to the right.
    pub right: Vec3,
    /// Unit vector to the top of the picture.
    pub up: Vec3,
    /// Unit vector into the picture.
    pub forward: Vec3,
    /// Unit vector of the scene's up axis.
    pub world_up: Vec3,
    /// Half the width and height of the picture at distance 1.
    pub half: Vec2,
    /// Diameter of what is looked at, meters.
    pub extent_m: f32,
}

impl Camera {
    /// A camera at `eye` that looks at `target`, with `top` up in the picture. `extent_m`: diameter of what it looks
    /// at.
    pub(super) fn looking(
        [eye, target, top]: [Vec3; 3],
        world_up: Vec3,
        aspect: f32,
        lens_mm: f32,
        extent_m: f32,
    ) -> Camera {
        let forward = (target - eye).normalize_or(Vec3::X);
        let right = forward.cross(top).normalize_or(forward.any_orthonormal_vector());
        let half = half_of(aspect, lens_mm);
        Camera { eye, right, up: right.cross(forward), forward, world_up, half, extent_m }
    }

    /// The same with everything `zoom` times as large in the picture.
    pub(super) fn zoomed(self, zoom: f32) -> Camera {
        Camera { half: self.half / zoom, ..self }
    }

    /// Focal length for a sensor 24 mm high, millimeters.
    pub(super) fn lens_mm(&self) -> f32 {
        0.5 * SENSOR_MM / self.half.y
    }

    /// Right, down and depth of a point. Within the picture right and down are at most the depth, in meters, which is
    /// their unit too.
    pub(super) fn see(&self, point: Vec3) -> Vec3 {
        let p = point - self.eye;
        Vec3::new(p.dot(self.right) / self.half.x, -p.dot(self.up) / self.half.y, p.dot(self.forward))
    }

    /// Depth where surfaces begin, meters; all cloth lies beyond it ([`Fit::camera`] keeps a distance).
    pub(super) fn near_m(&self) -> f32 {
        0.002 * self.extent_m
    }

    /// Direction (depth 1) of the ray through a point of the picture.
    pub(super) fn ray(&self, x: f32, y: f32) -> Vec3 {
        self.forward + self.right * (x * self.half.x) - self.up * (y * self.half.y)
    }
}

/// Half of a picture's width and height at distance 1.
fn half_of(aspect: f32, lens_mm: f32) -> Vec2 {
    let vertical = 0.5 * SENSOR_MM / lens_mm;
    Vec2::new(vertical * aspect, vertical)
}

/// Collects which way the cloth faces and chooses a direction to look from.
pub(super) struct View {
    up: Vec3,
    /// Two horizontal unit vectors, at a right angle.
    axes: (Vec3, Vec3),
    /// Sums of area * products of normal components: xx, xy, yy over the horizontal axes, and vertical.
    sums: [f64; 4],
    /// Sums of area * normal component over the horizontal axes.
    facing: [f64; 2],
}

impl View {
    pub(super) fn new(up: Vec3) -> View {
        View { up, axes: horizontal(up), sums: [0.0; 4], facing: [0.0; 2] }
    }

    /// Adds the normals and extent of a frame's mesh.
    pub(super) fn add(&mut self, mesh: &FrameMesh) {
        for t in &mesh.triangles {
            let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
            let normal = (b - a).cross(c - a);
            let length = normal.length();
            if length.is_finite() && length > 0.0 {
                let along = |axis: Vec3| f64::from(normal.dot(axis));
                let (x, y, z, area) = (along(self.axes.0), along(self.axes.1), along(self.up), f64::from(length));
                self.sums[0] += x * x / area;
                self.sums[1] += x * y / area;
                self.sums[2] += y * y / area;
                self.sums[3] += z * z / area;
                self.facing[0] += x;
                self.facing[1] += y;
            }
        }
    }

    /// Azimuth and elevation in degrees. Upright cloth is seen 30 degrees from the side that it shows most of; cloth
    /// that lies is seen from higher up.
    pub(super) fn direction(&self) -> (f32, f32) {
        let [xx, xy, yy, zz] = self.sums;
        let lying = zz > xx + yy;
        let elevation = if lying { 35.0 } else { 15.0 };
        if xx + yy < 1e-3 * zz || xx + yy == 0.0 {
            return (-60.0, elevation);
        }
        // Direction of the largest variance; of its two signs the one that shows fronts, or the viewer's usual side.
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let fronts = self.facing[0] * angle.cos() + self.facing[1] * angle.sin();
        let turned = if fronts.abs() > 0.2 * (xx + yy + zz) { fronts < 0.0 } else { angle.sin() > 0.0 };
        let angle = angle.to_degrees() as f32 + if turned { 180.0 } else { 0.0 };
        (angle + 30.0, elevation)
    }
}

/// Two axes that make a right-handed system with `up`; the viewer's usual side is against the second.
fn horizontal(up: Vec3) -> (Vec3, Vec3) {
    if up == Vec3::Z { (Vec3::X, Vec3::Y) } else { (Vec3::X, Vec3::NEG_Z) }
}

/// Collects how far a sequence reaches towards each side of the picture.
#[derive(Clone, Debug)]
pub(super) struct Fit {
    up: Vec3,
    camera_up: Vec3,
    right: Vec3,
    forward: Vec3,
    half: Vec2,
    /// Largest excess over each plane of the view, as seen from the origin: right, left, up, down.
    reach: [f32; 4],
    low: Vec3,
    high: Vec3,
}

impl Fit {
    /// A camera in `direction` (azimuth and elevation in degrees) for pictures of width / height = `aspect`.
    pub(super) fn new(up: Vec3, direction: (f32, f32), aspect: f32, lens_mm: f32) -> Fit {
        let (azimuth, elevation) = (direction.0.to_radians(), direction.1.clamp(-89.0, 89.0).to_radians());
        let (x, y) = horizontal(up);
        let outward = (x * azimuth.cos() + y * azimuth.sin()) * elevation.cos() + up * elevation.sin();
        let forward = -outward;
        let right = forward.cross(up).normalize();
        let (low, high) = (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY));
        let (half, reach) = (half_of(aspect, lens_mm), [f32::NEG_INFINITY; 4]);
        Fit { up, camera_up: right.cross(forward), right, forward, half, reach, low, high }
    }

    /// Adds points; those that are not finite are left out.
    pub(super) fn add(&mut self, positions: &[Vec3]) {
        let half = self.half * FILL;
        for p in positions.iter().filter(|p| p.is_finite()) {
            let (x, y, depth) = (p.dot(self.right), p.dot(self.camera_up), p.dot(self.forward));
            let sides = [x - half.x * depth, -x - half.x * depth, y - half.y * depth, -y - half.y * depth];
            for side in 0..4 {
                self.reach[side] = self.reach[side].max(sides[side]);
            }
            self.low = self.low.min(*p);
            self.high = self.high.max(*p);
        }
    }

    /// Adds what another fit with the same direction has seen.
    pub(super) fn merge(&mut self, other: &Fit) {
        for side in 0..4 {
            self.reach[side] = self.reach[side].max(other.reach[side]);
        }
        self.low = self.low.min(other.low);
        self.high = self.high.max(other.high);
    }

    /// Lowest and highest corner of what was seen.
    pub(super) fn bounds(&self) -> [Vec3; 2] {
        [self.low, self.high]
    }

    /// Middle of what was seen.
    pub(super) fn middle(&self) -> Vec3 {
        0.5 * (self.low + self.high)
    }

    /// Lowest and highest height seen, meters.
    pub(super) fn heights_m(&self) -> (f32, f32) {
        (self.low.dot(self.up), self.high.dot(self.up))
    }

    /// The nearest camera that keeps everything within the picture; none if nothing was added.
    pub(super) fn camera(&self) -> Option<Camera> {
        let extent_m = (self.high - self.low).length().max(1e-6);
        if !extent_m.is_finite() {
            return None;
        }
        let half = self.half * FILL;
        let [right, left, top, bottom] = self.reach;
        // The planes right and left of all points meet at this depth; likewise those above and below.
        let depth = (-(right + left) / (2.0 * half.x)).min(-(top + bottom) / (2.0 * half.y)) - 0.05 * extent_m;
        let (x, y) = (0.5 * (right - left), 0.5 * (top - bottom));
        Some(Camera {
            eye: self.right * x + self.camera_up * y + self.forward * depth,
            right: self.right,
            up: self.camera_up,
            forward: self.forward,
            world_up: self.up,
            half: self.half,
            extent_m,
        })
    }

    /// A camera in the same direction that looks at `point` from where all that was seen would fit around it.
    pub(super) fn camera_at(&self, point: Vec3) -> Option<Camera> {
        let camera = self.camera()?;
        let distance = 0.5 * camera.extent_m / (self.half.min_element() * FILL);
        Some(Camera { eye: point - self.forward * distance, ..camera })
    }
}
