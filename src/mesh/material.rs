//! Material (rest) coordinates from a 3D rest shape: every triangle is laid flat without stretching.
//!
//! Adjacent triangles can lie anywhere in the plane, because forces read edge differences only.

use crate::math::{DVec2, DVec3, Vec2, Vec3};

/// Lays a triangle flat isometrically. Warp (material x) is the world's x axis projected into the triangle, or the y
/// axis if the triangle faces along x. So a flat mesh has one warp direction, which an axis along the first edge of
/// each triangle would not give. A triangle without area gets coordinates without area.
pub fn flatten_triangle(corners: [Vec3; 3]) -> [Vec2; 3] {
    let [a, b, c] = corners.map(|p| p.as_dvec3());
    let normal = (b - a).cross(c - a).normalize_or_zero();
    // From this value on the projection of y is the longer one for every normal.
    const FACES_ALONG_X: f64 = 0.8;
    let reference = if normal.x.abs() < FACES_ALONG_X { DVec3::X } else { DVec3::Y };
    let warp = (reference - normal * normal.dot(reference)).normalize_or_zero();
    let weft = normal.cross(warp);
    [a, b, c].map(|p| DVec2::new((p - a).dot(warp), (p - a).dot(weft)).as_vec2())
}

/// Applies [`flatten_triangle`] to every triangle. Indices must be in range.
pub fn flatten_triangles(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<[Vec2; 3]> {
    triangles.iter().map(|t| flatten_triangle(t.map(|v| positions[v as usize]))).collect()
}

/// Mirrors every material triangle that is wound against its triangle in space. Lengths and warp axis stay, and the
/// signed area becomes positive, as all users of the coordinates expect.
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

/// Largest stretch of a triangle that counts as isometric; the smallest is its inverse.
const ISOMETRIC: f64 = 1.2;
/// Fraction of the area that must be isometric for texture coordinates to count as a sewing pattern rather than image
/// coordinates. The rest allows for a few stretched places of a mesh that was draped before.
const ISOMETRIC_PART: f64 = 0.9;

/// Comparison of texture coordinates with the mesh in space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TextureFit {
    /// Area in texture space, m^2.
    pub texture_m2: f64,
    /// Area in space, m^2.
    pub space_m2: f64,
    /// Fraction of the area in space whose lengths agree within 20 %.
    pub isometric: f64,
}

impl TextureFit {
    /// Compares the triangles, which must have an area in space.
    pub(super) fn new(positions: &[Vec3], triangles: &[[u32; 3]], texture_uv: &[[Vec2; 3]]) -> TextureFit {
        let mut fit = TextureFit { texture_m2: 0.0, space_m2: 0.0, isometric: 0.0 };
        for (corners, uv) in triangles.iter().zip(texture_uv) {
            let [a, b, c] = corners.map(|v| positions[v as usize].as_dvec3());
            let (d1, d2) = (b - a, c - a);
            let area = d1.cross(d2).length() / 2.0;
            let [p, q, r] = uv.map(|uv| uv.as_dvec2());
            let (e1, e2) = (q - p, r - p);
            let determinant = e1.perp_dot(e2);
            fit.space_m2 += area;
            fit.texture_m2 += determinant.abs() / 2.0;
            // Derivatives of the position along u and v. The squared stretches follow from them.
            let (f_u, f_v) = ((d1 * e2.y - d2 * e1.y) / determinant, (d2 * e1.x - d1 * e2.x) / determinant);
            let (mean, half) = ((f_u.dot(f_u) + f_v.dot(f_v)) / 2.0, (f_u.dot(f_u) - f_v.dot(f_v)) / 2.0);
            let radius = half.hypot(f_u.dot(f_v));
            // Without an area in texture space these are infinite or NaN, so the triangle does not count as isometric.
            if mean + radius <= ISOMETRIC * ISOMETRIC && mean - radius >= 1.0 / (ISOMETRIC * ISOMETRIC) {
                fit.isometric += area;
            }
        }
        fit.isometric /= fit.space_m2.max(f64::MIN_POSITIVE);
        fit
    }

    /// True if the texture coordinates are a sewing pattern, that is, the rest shape.
    pub fn is_isometric(&self) -> bool {
        self.isometric >= ISOMETRIC_PART
    }
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

    #[test]
    fn the_fit_of_texture_coordinates() {
        let positions = [Vec3::ZERO, Vec3::new(2.0, 0.0, 1.0), Vec3::new(0.0, 3.0, 0.0)];
        let flat = flatten_triangle(positions);
        let fit = |uv: [Vec2; 3]| TextureFit::new(&positions, &[[0, 1, 2]], &[uv]);
        let area = 3.0 * 5f64.sqrt() / 2.0;
        assert!((fit(flat).space_m2 - area).abs() < 1e-6 && (fit(flat).texture_m2 - area).abs() < 1e-6);
        assert!(fit(flat).is_isometric() && fit(flat.map(|uv| Vec2::new(-uv.x, uv.y))).is_isometric(), "also mirrored");
        for (scale, isometric) in [(0.85, true), (1.15, true), (0.8, false), (1.25, false), (0.0, false)] {
            assert_eq!(fit(flat.map(|uv| uv * scale)).is_isometric(), isometric, "{scale}");
            assert_eq!(fit(flat.map(|uv| uv * Vec2::new(1.0, scale))).is_isometric(), isometric, "one way {scale}");
        }
        assert!(!fit(flat.map(|uv| uv + Vec2::new(uv.y, 0.0))).is_isometric(), "sheared");
    }
}
