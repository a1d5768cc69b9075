//! Stretch of triangles: principal stretches against the shape at rest.

use crate::math::{DVec2, Vec2, Vec3};

/// Largest and smallest stretch (length / length at rest) of a triangle in any direction. `uv`: its shape at rest.
pub fn principal_stretches(corners: [Vec3; 3], uv: [Vec2; 3]) -> [f64; 2] {
    let [p, q, r] = corners.map(Vec3::as_dvec3);
    let [a, b, c] = uv.map(Vec2::as_dvec2);
    let (e1, e2) = (b - a, c - a);
    let det = e1.perp_dot(e2);
    // Gradients of the barycentric coordinates of the second and third corner.
    let (w1, w2) = (DVec2::new(e2.y, -e2.x) / det, DVec2::new(-e1.y, e1.x) / det);
    let (u, v) = ((q - p) * w1.x + (r - p) * w2.x, (q - p) * w1.y + (r - p) * w2.y);
    let (mean, half) = (0.5 * (u.dot(u) + v.dot(v)), 0.5 * (u.dot(u) - v.dot(v)));
    let radius = half.hypot(u.dot(v));
    [(mean + radius).sqrt(), (mean - radius).max(0.0).sqrt()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stretches_do_not_depend_on_directions() {
        let uv = [Vec2::new(1.0, 2.0), Vec2::new(1.3, 2.1), Vec2::new(0.9, 2.4)];
        for (turn, along) in [(0.0f32, 0.0f32), (0.7, 0.3), (2.0, -1.1)] {
            // Stretched by 1.2 along a direction and 0.9 across it, then turned in space.
            let (d, n) = (Vec2::from_angle(along), Vec2::from_angle(along).perp());
            let in_space = uv.map(|p| {
                let (x, y) = (1.2 * p.dot(d), 0.9 * p.dot(n));
                Vec3::new(x * turn.cos(), y, x * turn.sin())
            });
            let [largest, smallest] = principal_stretches(in_space, uv);
            assert!((largest - 1.2).abs() < 1e-5 && (smallest - 0.9).abs() < 1e-5, "{largest} {smallest}");
        }
    }
}
