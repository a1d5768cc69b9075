//! Which triangle every sample of a picture shows.

use super::camera::Camera;
use crate::math::Vec3;
use crate::output::FrameMesh;

/// Marks a sample without a triangle.
pub const EMPTY: u32 = u32::MAX;

/// What is visible where.
pub struct Visible {
    /// Triangle per sample, row by row from the top.
    pub triangle: Vec<u32>,
    /// Every vertex in samples: right, down, and 1 / depth (0 = behind the camera or not finite).
    pub screen: Vec<Vec3>,
    /// Samples per row.
    pub width: usize,
}

/// Draws all triangles into a depth buffer of `size` samples.
pub fn rasterize(mesh: &FrameMesh, camera: &Camera, size: (usize, usize)) -> Visible {
    let (width, height) = size;
    let near = 1e-6 * camera.extent_m;
    let screen: Vec<Vec3> = mesh
        .positions
        .iter()
        .map(|p| {
            let (x, y, depth) = camera.project(*p);
            // The camera stands outside the sequence: only broken positions are behind it, and their triangles are left out.
            if depth > near && p.is_finite() {
                Vec3::new((x + 1.0) * 0.5 * width as f32, (y + 1.0) * 0.5 * height as f32, 1.0 / depth)
            } else {
                Vec3::ZERO
            }
        })
        .collect();
    let mut triangle = vec![EMPTY; width * height];
    let mut nearness = vec![0.0f32; width * height];
    for (t, corners) in mesh.triangles.iter().enumerate() {
        let [a, b, c] = corners.map(|i| screen[i as usize]);
        if a.z > 0.0 && b.z > 0.0 && c.z > 0.0 {
            fill([a, b, c], t as u32, &mut triangle, &mut nearness, size);
        }
    }
    Visible { triangle, screen, width }
}

/// Weights of the corners at a point, not yet divided by the area.
fn edges([a, b, c]: [Vec3; 3], x: f32, y: f32) -> [f32; 3] {
    let edge = |p: Vec3, q: Vec3| (q.x - p.x) * (y - p.y) - (q.y - p.y) * (x - p.x);
    [edge(b, c), edge(c, a), edge(a, b)]
}

/// Twice the signed area; positive = clockwise on the screen (y down).
pub fn signed_area([a, b, c]: [Vec3; 3]) -> f32 {
    (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)
}

/// Shares of the corners in a sample, corrected for perspective.
pub fn weights(corners: [Vec3; 3], x: f32, y: f32) -> [f32; 3] {
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
