//! Which light reaches a point: soft shadows of the main light and of the sky, from depth maps of many directions.
//!
//! The sky is a dome of evenly spread directions above the horizon, the main light a cone of directions. For each of
//! them a map holds how far up the nearest surface is. A direction reaches a point if nothing in its map lies more
//! than a texel above it. Gaps smaller than a texel (1/256 of what is lit) therefore cast no shadow. The maps depend
//! on the triangles only, so every executor and any number of threads draws with the same ones.

use super::content::Content;
use crate::gpu::{LIGHT_SIDE, LIGHTS, LIGHTS_OF_KEY};
use crate::math::{Vec3, Vec4};

/// Tangent of half the angle that the main light covers.
const KEY_RADIUS: f32 = 0.09;
/// Angle between successive points of a sunflower, radians.
const GOLDEN_ANGLE: f32 = 2.399_963_2;

/// Directions of the lights: those of the main light come first.
pub(super) fn directions(key: Vec3, up: Vec3) -> [Vec3; LIGHTS] {
    let (side, over) = key.any_orthonormal_pair();
    let (x, y) = up.any_orthonormal_pair();
    let sky = (LIGHTS - LIGHTS_OF_KEY) as f32;
    std::array::from_fn(|i| {
        let (sin, cos) = (GOLDEN_ANGLE * i as f32).sin_cos();
        if i < LIGHTS_OF_KEY {
            let radius = KEY_RADIUS * ((i as f32 + 0.5) / LIGHTS_OF_KEY as f32).sqrt();
            return (key + (side * cos + over * sin) * radius).normalize();
        }
        // Equal areas of a sphere are equal heights.
        let height = 1.0 - (i as f32 - LIGHTS_OF_KEY as f32 + 0.5) / sky;
        let level = (1.0 - height * height).max(0.0).sqrt();
        up * height + (x * cos + y * sin) * level
    })
}

/// The light of one picture.
pub(super) struct Lights {
    /// Unit vectors towards the lights.
    pub toward: [Vec3; LIGHTS],
    /// For each light three rows: a point's column and row in the map, texels, and its height towards the light.
    pub rows: [[Vec4; 3]; LIGHTS],
    /// Side of a texel, meters.
    pub texel_m: f32,
    /// Height of the nearest surface towards the light, light by light, row by row; none where there are no shadows.
    pub heights: Vec<f32>,
}

impl Lights {
    /// Lights without shadows.
    pub(super) fn plain(toward: &[Vec3; LIGHTS]) -> Lights {
        Lights { toward: *toward, rows: [[Vec4::ZERO; 3]; LIGHTS], texel_m: 1.0, heights: Vec::new() }
    }

    /// Lights whose shadows reach `radius_m` around `center`; what lies farther away is fully lit.
    pub(super) fn with_shadows(toward: &[Vec3; LIGHTS], content: &Content, center: Vec3, radius_m: f32) -> Lights {
        let side = LIGHT_SIDE as f32;
        let texel_m = 2.0 * radius_m / side;
        let rows = toward.map(|toward| {
            let (across, along) = toward.any_orthonormal_pair();
            let place = |axis: Vec3| (axis / texel_m).extend(0.5 * side - center.dot(axis) / texel_m);
            [place(across), place(along), toward.extend(-center.dot(toward))]
        });
        let mut heights = vec![f32::NEG_INFINITY; LIGHTS * LIGHT_SIDE * LIGHT_SIDE];
        let mut seen = Vec::with_capacity(content.positions.len());
        for (rows, map) in rows.iter().zip(heights.chunks_exact_mut(LIGHT_SIDE * LIGHT_SIDE)) {
            seen.clear();
            seen.extend(content.positions.iter().map(|p| at(rows, *p)));
            for triangle in &content.triangles {
                fill(triangle.map(|v| seen[v as usize]), map);
            }
        }
        Lights { toward: *toward, rows, texel_m, heights }
    }

    /// Light that reaches a point of a surface: of the sky (1 = all that a level surface gets in the open) and of the
    /// main light (the mean cosine of those directions that reach it).
    pub(super) fn reaching(&self, point: Vec3, normal: Vec3) -> [f32; 2] {
        // A surface must not shade itself.
        let from = point + normal * self.texel_m;
        let (mut sky, mut key) = (0.0, 0.0);
        for light in 0..LIGHTS {
            let cosine = normal.dot(self.toward[light]);
            if cosine > 0.0 {
                let share = cosine * self.open(light, from);
                if light < LIGHTS_OF_KEY { key += share } else { sky += share }
            }
        }
        [2.0 * sky / (LIGHTS - LIGHTS_OF_KEY) as f32, key / LIGHTS_OF_KEY as f32]
    }

    /// Share of a light that reaches a point: blended over the four texels around it.
    fn open(&self, light: usize, point: Vec3) -> f32 {
        if self.heights.is_empty() {
            return 1.0;
        }
        let seen = at(&self.rows[light], point);
        let (column, row) = (seen.x - 0.5, seen.y - 0.5);
        let last = (LIGHT_SIDE - 1) as f32;
        if !(column >= 0.0 && row >= 0.0 && column < last && row < last) {
            return 1.0;
        }
        let (left, top) = (column.floor(), row.floor());
        let (right_share, low_share) = (column - left, row - top);
        let first = (light * LIGHT_SIDE + top as usize) * LIGHT_SIDE + left as usize;
        let height = seen.z + 0.5 * self.texel_m;
        let open = |texel: usize| (1.0 + (height - self.heights[texel]) / self.texel_m).clamp(0.0, 1.0);
        let top = open(first) * (1.0 - right_share) + open(first + 1) * right_share;
        let low = open(first + LIGHT_SIDE) * (1.0 - right_share) + open(first + LIGHT_SIDE + 1) * right_share;
        top * (1.0 - low_share) + low * low_share
    }
}

/// Column, row and height of a point in a map.
fn at(rows: &[Vec4; 3], point: Vec3) -> Vec3 {
    let point = point.extend(1.0);
    Vec3::new(rows[0].dot(point), rows[1].dot(point), rows[2].dot(point))
}

/// Puts the heights of a triangle into a map, where they are larger than what is there.
fn fill([a, b, c]: [Vec3; 3], map: &mut [f32]) {
    let side = LIGHT_SIDE as f32;
    let first = |v: f32| (v - 0.5).ceil().clamp(0.0, side) as usize;
    let end = |v: f32| (v + 0.5).floor().clamp(0.0, side) as usize;
    let (x0, x1) = (first(a.x.min(b.x).min(c.x)), end(a.x.max(b.x).max(c.x)));
    let (y0, y1) = (first(a.y.min(b.y).min(c.y)), end(a.y.max(b.y).max(c.y)));
    let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    if x0 >= x1 || y0 >= y1 || area == 0.0 {
        return;
    }
    let edge = |p: Vec3, q: Vec3, x: f32, y: f32| ((q.x - p.x) * (y - p.y) - (q.y - p.y) * (x - p.x)) / area;
    for y in y0..y1 {
        let row = &mut map[y * LIGHT_SIDE..][..LIGHT_SIDE];
        for (x, height) in row.iter_mut().enumerate().take(x1).skip(x0) {
            let (sx, sy) = (x as f32 + 0.5, y as f32 + 0.5);
            let shares = [edge(b, c, sx, sy), edge(c, a, sx, sy), edge(a, b, sx, sy)];
            if shares.iter().all(|share| *share >= 0.0) {
                *height = height.max(shares[0] * a.z + shares[1] * b.z + shares[2] * c.z);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A level square of half side `half` at height `z`, as an occluder.
    fn square(half: f32, z: f32) -> Content {
        let corner = |x: f32, y: f32| Vec3::new(x * half, y * half, z);
        Content {
            positions: vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Content::default()
        }
    }

    #[test]
    fn a_roof_takes_the_light_below_it_and_none_above() {
        let toward = directions(Vec3::new(0.3, 0.0, 1.0).normalize(), Vec3::Z);
        let lights = Lights::with_shadows(&toward, &square(1.0, 0.0), Vec3::ZERO, 3.0);
        let [sky, key] = lights.reaching(Vec3::new(0.0, 0.0, 0.2), Vec3::Z);
        assert!((sky - 1.0).abs() < 0.02 && (key - toward[0].z).abs() < 0.02, "{sky} {key}");
        // Just below its middle, and in the open beside it.
        let [under_sky, under_key] = lights.reaching(Vec3::new(0.0, 0.0, -0.1), Vec3::Z);
        assert!(under_sky < 0.05 && under_key < 0.01, "{under_sky} {under_key}");
        let [beside, _] = lights.reaching(Vec3::new(2.9, 0.0, -0.1), Vec3::Z);
        assert!(beside > 0.9 && beside <= sky, "{beside}");
        // The square does not shade itself, and without maps nothing is in shadow.
        let [own, own_key] = lights.reaching(Vec3::ZERO, Vec3::Z);
        assert!((own - sky).abs() < 0.02 && (own_key - key).abs() < 0.02, "{own} {own_key}");
        assert_eq!(Lights::plain(&toward).reaching(Vec3::new(0.0, 0.0, -0.1), Vec3::Z), [sky, key]);
    }

    #[test]
    fn a_wall_sees_half_of_the_sky() {
        let lights = Lights::plain(&directions(Vec3::Z, Vec3::Z));
        let [sky, key] = lights.reaching(Vec3::ZERO, Vec3::X);
        assert!((sky - 0.5).abs() < 0.03 && key < 0.06, "{sky} {key}");
        assert_eq!(lights.reaching(Vec3::ZERO, Vec3::NEG_Z), [0.0, 0.0]);
    }
}
