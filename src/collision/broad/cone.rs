//! Cones of normals [Volino and Magnenat-Thalmann 1994; Tang et al. 2009]: where the triangles of a patch face during a
//! step. See `cull` for what that proves.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::Vec3A;

use super::input::Input;

/// Least cosine between a normal and the direction of view: beyond it altitudes are seen too short to prove anything.
const LEAST_COSINE: f32 = 0.15;
/// Least area over squared longest edge, seen along the axis: keeps the rounding of normals below [`ROUNDING`].
const LEAST_AREA: f32 = 1e-3;
/// Exceeds the error of normals of such triangles in angle (radians) and relative length; their rounding is 16 units in
/// the last place of the squared edge.
pub(super) const ROUNDING: f32 = 4e-3;

/// A cone that holds all normals of a patch during the step.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Cone {
    /// Unit vector, or 0 where there is no cone.
    pub axis: [f32; 3],
    /// Least cosine of the angle between a normal and the axis.
    cosine: f32,
    /// Least altitude of a triangle seen along the axis, meters.
    altitude_m: f32,
}

impl Cone {
    /// The cone of some triangles.
    pub(super) fn new(input: &Input, triangles: Range<usize>) -> Cone {
        let moves = input.paths.moves();
        let mut normals = Vec::with_capacity(triangles.len());
        let mut sum = Vec3A::ZERO;
        for &[a, b, c] in &input.mesh.triangles[triangles] {
            let sides = |end: bool| {
                let a = input.paths.at(a, end);
                (input.paths.at(b, end) - a, input.paths.at(c, end) - a)
            };
            let longest = |(one, other): (Vec3A, Vec3A)| {
                one.length_squared().max(other.length_squared()).max((one - other).length_squared())
            };
            let start = sides(false);
            let end = if moves { sides(true) } else { start };
            let first = start.0.cross(start.1);
            // Bernstein coefficients of the normal over time.
            let (middle, last) = if moves {
                (0.5 * (start.0.cross(end.1) + end.0.cross(start.1)), end.0.cross(end.1))
            } else {
                (first, first)
            };
            sum += first + last;
            normals.push(([first, middle, last], longest(start).max(longest(end))));
        }
        let Some(axis) = sum.try_normalize() else { return Cone::zeroed() };
        let (mut cosine, mut altitude_m) = (1.0f32, f32::INFINITY);
        for (normals, longest_squared) in &normals {
            for normal in normals {
                let area = normal.dot(axis);
                // The comparison is false for NaN.
                let faces_the_axis = area > LEAST_AREA * longest_squared;
                if !faces_the_axis {
                    return Cone::zeroed();
                }
                cosine = cosine.min(area / normal.length());
                altitude_m = altitude_m.min(area / longest_squared.sqrt());
            }
        }
        let altitude_m = altitude_m * (1.0 - ROUNDING);
        Cone { axis: axis.to_array(), cosine: (cosine - ROUNDING).max(0.0), altitude_m }
    }

    /// An altitude that all triangles exceed when seen along `view`; 0 if some may not face it.
    pub(super) fn altitude_along(&self, view: Vec3A) -> f32 {
        let toward = view.dot(Vec3A::from_array(self.axis));
        let sine = |cosine: f32| (1.0 - cosine * cosine).max(0.0).sqrt();
        // Cosine of the sum of both angles; less than half a turn, as both cosines are positive.
        let least = self.cosine * toward - sine(self.cosine) * sine(toward) - ROUNDING;
        if toward > 0.0 && least >= LEAST_COSINE { self.altitude_m * least } else { 0.0 }
    }
}
