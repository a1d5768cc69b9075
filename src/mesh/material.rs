//! Material (rest) coordinates from a 3D rest shape: every triangle laid flat without stretching it.
//!
//! Neighbouring triangles need not agree on where they lie in the plane; forces read edge differences only.

use crate::math::{DVec2, DVec3, Vec2, Vec3};

/// Lays a triangle flat isometrically. Warp (material x) is the world's x axis projected into the triangle, or y where
/// the triangle faces along x, so that a flat mesh keeps one warp direction; the first edge would turn with every triangle.
/// A triangle without area yields coordinates without area.
pub fn flatten_triangle(corners: [Vec3; 3]) -> [Vec2; 3] {
    let [a, b, c] = corners.map(|p| p.as_dvec3());
    let normal = (b - a).cross(c - a).normalize_or_zero();
    // Below this the projection of x is shorter than that of y for every direction of the normal.
    const FACES_ALONG_X: f64 = 0.8;
    let reference = if normal.x.abs() < FACES_ALONG_X { DVec3::X } else { DVec3::Y };
    let warp = (reference - normal * normal.dot(reference)).normalize_or_zero();
    let weft = normal.cross(warp);
    [a, b, c].map(|p| DVec2::new((p - a).dot(warp), (p - a).dot(weft)).as_vec2())
}

/// [`flatten_triangle`] of every triangle. Indices must be in range.
pub fn flatten_triangles(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<[Vec2; 3]> {
    triangles.iter().map(|t| flatten_triangle(t.map(|v| positions[v as usize]))).collect()
}

/// Mirrors every material triangle that is wound against its triangle in space: the same lengths and the same warp axis,
/// but an area that is positive for everyone who computes with it.
pub(super) fn mirror_clockwise(material_uv: &mut [[Vec2; 3]]) {
    for uv in material_uv.iter_mut().filter(|uv| doubled_area(uv) < 0.0) {
        uv.iter_mut().for_each(|p| p.x = -p.x);
    }
}

/// Twice the signed area of a material triangle, m^2.
pub(super) fn doubled_area(uv: &[Vec2; 3]) -> f64 {
    let [a, b, c] = uv.map(|p| p.as_dvec2());
    (b - a).perp_dot(c - a)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flat_mesh_keeps_its_coordinates_up_to_a_shift() {
        let corners = [Vec3::new(1.0, 2.0, 5.0), Vec3::new(3.0, 2.0, 5.0), Vec3::new(1.0, 6.0, 5.0)];
        assert_eq!(flatten_triangle(corners), [Vec2::ZERO, Vec2::new(2.0, 0.0), Vec2::new(0.0, 4.0)]);
    }

    #[test]
    fn edge_lengths_and_orientation_survive_in_any_direction() {
        for axis in [Vec3::X, Vec3::Y, Vec3::Z, Vec3::new(1.0, -2.0, 0.5)] {
            let rotation = crate::math::Quat::from_axis_angle(axis.normalize(), 1.1);
            let corners =
                [Vec3::new(0.3, 0.1, 0.0), Vec3::new(1.0, -2.0, 0.7), Vec3::new(-0.4, 0.5, 1.0)].map(|p| rotation * p);
            let flat = flatten_triangle(corners);
            for (i, j) in [(0, 1), (1, 2), (2, 0)] {
                assert!((flat[i].distance(flat[j]) - corners[i].distance(corners[j])).abs() < 1e-6);
            }
            assert!(doubled_area(&flat) > 0.0);
        }
    }
}
