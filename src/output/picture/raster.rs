//! Which triangle every sample of a picture shows.
//!
//! Triangles near the picture are filled from the screen positions of their corners. Those that reach behind the camera
//! or far beyond the picture (only large obstacles do) are cut to what can be seen first.

use super::camera::Camera;
use super::content::Content;
use crate::math::{DVec3, Vec3};

/// Marks a sample without a triangle.
pub(super) const EMPTY: u32 = u32::MAX;
/// Largest distance from the middle, in halves of the picture, at which screen positions are exact enough to fill from.
const REACH: f32 = 4.0;

/// The visible triangle of every sample.
pub(super) struct Visible {
    /// Triangle per sample, row by row from the top.
    pub triangle: Vec<u32>,
    /// Samples in a row of the picture.
    pub width: usize,
    height: usize,
    /// Every vertex in samples: right, down, and 1 / depth (0 = behind the camera or out of reach).
    screen: Vec<Vec3>,
}

/// Draws all triangles into a depth buffer of `size` samples.
pub(super) fn rasterize(content: &Content, camera: &Camera, size: (usize, usize)) -> Visible {
    let near = camera.near_m();
    let place = |seen: Vec3| {
        let (x, y) = (seen.x / seen.z, seen.y / seen.z);
        Vec3::new((x + 1.0) * 0.5 * size.0 as f32, (y + 1.0) * 0.5 * size.1 as f32, 1.0 / seen.z)
    };
    let in_reach = |seen: Vec3| seen.z >= near && seen.x.abs().max(seen.y.abs()) <= REACH * seen.z;
    let on_screen = |p: &Vec3| {
        let seen = camera.see(*p);
        if in_reach(seen) { place(seen) } else { Vec3::ZERO }
    };
    let screen: Vec<Vec3> = content.positions.iter().map(on_screen).collect();
    let mut triangle = vec![EMPTY; size.0 * size.1];
    let mut nearness = vec![0.0f32; size.0 * size.1];
    for (t, vertices) in content.triangles.iter().enumerate() {
        let corners = vertices.map(|i| screen[i as usize]);
        if corners.iter().all(|c| c.z > 0.0) {
            fill(corners, t as u32, &mut triangle, &mut nearness, size);
            continue;
        }
        let part = cut(vertices.map(|i| camera.see(content.positions[i as usize])), near);
        for i in 2..part.len() {
            let corners = [part[0], part[i - 1], part[i]].map(place);
            fill(corners, t as u32, &mut triangle, &mut nearness, size);
        }
    }
    Visible { triangle, width: size.0, height: size.1, screen }
}

/// The part of a triangle (as [`Camera::see`] gives its corners) within the picture and beyond depth `near`: a convex
/// polygon, or nothing.
fn cut(corners: [Vec3; 3], near: f32) -> Vec<Vec3> {
    let sides: [&dyn Fn(Vec3) -> f32; 5] =
        [&|p| p.z - near, &|p| p.z + p.x, &|p| p.z - p.x, &|p| p.z + p.y, &|p| p.z - p.y];
    let mut polygon = corners.to_vec();
    for inside in sides {
        let mut kept = Vec::with_capacity(polygon.len() + 1);
        for i in 0..polygon.len() {
            let (p, q) = (polygon[i], polygon[(i + 1) % polygon.len()]);
            let (at_p, at_q) = (inside(p), inside(q));
            if at_p >= 0.0 {
                kept.push(p);
            }
            if (at_p >= 0.0) != (at_q >= 0.0) {
                kept.push(p.lerp(q, at_p / (at_p - at_q)));
            }
        }
        polygon = kept;
    }
    // Roundings: what was cut at the near plane may lie a little in front of it.
    polygon.iter_mut().for_each(|p| p.z = p.z.max(near));
    polygon
}

impl Visible {
    /// Shares of the corners of triangle `t` in a sample, corrected for perspective, and whether its front is seen.
    pub(super) fn weights(&self, content: &Content, camera: &Camera, t: u32, x: f32, y: f32) -> ([f32; 3], bool) {
        let vertices = content.triangles[t as usize];
        let corners = vertices.map(|i| self.screen[i as usize]);
        if corners.iter().all(|c| c.z > 0.0) {
            // Counter-clockwise triangles turn clockwise area negative where y points down: then the front is seen.
            return (weights(corners, x, y), signed_area(corners) < 0.0);
        }
        let [a, b, c] = vertices.map(|i| camera.see(content.positions[i as usize]).as_dvec3());
        let at = |v: f32, size: usize| f64::from(2.0 * v / size as f32 - 1.0);
        let ray = DVec3::new(at(x, self.width), at(y, self.height), 1.0);
        let volumes = [b.cross(c), c.cross(a), a.cross(b)].map(|side| ray.dot(side));
        let sum: f64 = volumes.iter().sum();
        let shares = if sum == 0.0 { [1.0 / 3.0; 3] } else { volumes.map(|v| (v / sum) as f32) };
        (shares, a.dot(b.cross(c)) < 0.0)
    }
}

/// Weights of the corners at a point, not yet divided by the area.
fn edges([a, b, c]: [Vec3; 3], x: f32, y: f32) -> [f32; 3] {
    let edge = |p: Vec3, q: Vec3| (q.x - p.x) * (y - p.y) - (q.y - p.y) * (x - p.x);
    [edge(b, c), edge(c, a), edge(a, b)]
}

/// Twice the signed area; positive = clockwise on the screen (y down).
fn signed_area([a, b, c]: [Vec3; 3]) -> f32 {
    (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)
}

/// Shares of the corners in a sample, corrected for perspective.
fn weights(corners: [Vec3; 3], x: f32, y: f32) -> [f32; 3] {
    let mut w = edges(corners, x, y);
    for i in 0..3 {
        w[i] *= corners[i].z;
    }
    let sum = w[0] + w[1] + w[2];
    if sum == 0.0 { [1.0 / 3.0; 3] } else { w.map(|w| w / sum) }
}

fn fill(corners: [Vec3; 3], t: u32, triangle: &mut [u32], nearness: &mut [f32], (width, height): (usize, usize)) {
    let area = signed_area(corners);
    if area == 0.0 {
        return;
    }
    let [a, b, c] = corners;
    // Samples lie at half-integers.
    let first = |v: f32| (v - 0.5).ceil().max(0.0) as usize;
    let end = |v: f32, size: usize| ((v + 0.5).floor().max(0.0) as usize).min(size);
    let (x0, x1) = (first(a.x.min(b.x).min(c.x)), end(a.x.max(b.x).max(c.x), width));
    let (y0, y1) = (first(a.y.min(b.y).min(c.y)), end(a.y.max(b.y).max(c.y), height));
    if x0 >= x1 {
        return;
    }
    let scale = 1.0 / area;
    let step = [b.y - c.y, c.y - a.y, a.y - b.y].map(|dy| dy * scale);
    for y in y0..y1 {
        let start = edges(corners, x0 as f32 + 0.5, y as f32 + 0.5).map(|e| e * scale);
        let row = y * width;
        for x in x0..x1 {
            let d = (x - x0) as f32;
            let w = [start[0] + d * step[0], start[1] + d * step[1], start[2] + d * step[2]];
            // Shared edges may be drawn twice; the depth decides, and no gap is left.
            if w[0] >= 0.0 && w[1] >= 0.0 && w[2] >= 0.0 {
                let near = w[0] * a.z + w[1] * b.z + w[2] * c.z;
                if near > nearness[row + x] {
                    nearness[row + x] = near;
                    triangle[row + x] = t;
                }
            }
        }
    }
}
