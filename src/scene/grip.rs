//! How a pinned vertex hangs on a triangle of an obstacle.

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

use crate::math::DVec3;
use crate::mesh::place;

/// A point that moves with a triangle: barycentric coordinates of its foot, and its offset from there in axes that turn
/// with the triangle.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Grip {
    /// Vertices of the triangle, in the numbering of the obstacles that are evaluated.
    pub vertices: [u32; 3],
    weights: [f64; 3],
    /// Along the first edge, across it within the triangle, and along the normal; meters.
    offset: [f64; 3],
}

/// What a vertex is held at by a pin that took hold while the cloth moved: a part of the state of a run.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Hold {
    /// Vertex of the mesh in the state of the whole cloth, place among the own rows in that of a rank.
    pub vertex: u32,
    /// Vertices of the triangle, in the numbering of all obstacles of the scene; [`Hold::NO_TRIANGLE`] for a place that
    /// belongs to no obstacle.
    pub corners: [u32; 3],
    /// Barycentric coordinates of the foot.
    pub weights: [f32; 3],
    /// With a triangle as those of [`Grip`]; without one the place less the motion of the pin so far. Meters.
    pub offset_m: [f32; 3],
}

impl Hold {
    /// Corners of a hold that no triangle has.
    pub const NO_TRIANGLE: [u32; 3] = [u32::MAX; 3];

    /// As the grip that it rounds; none without a triangle.
    pub fn grip(&self) -> Option<Grip> {
        let of = |values: [f32; 3]| values.map(f64::from);
        let grip = Grip { vertices: self.corners, weights: of(self.weights), offset: of(self.offset_m) };
        (self.corners != Hold::NO_TRIANGLE).then_some(grip)
    }
}

impl Grip {
    /// The grip as a state keeps it, for a vertex.
    pub fn hold(&self, vertex: u32) -> Hold {
        let of = |values: [f64; 3]| values.map(|value| value as f32);
        Hold { vertex, corners: self.vertices, weights: of(self.weights), offset_m: of(self.offset) }
    }

    /// Takes hold of the triangle `vertices`, whose corners are at `corners`, at the foot with the barycentric
    /// coordinates `weights`, for a vertex at `point`.
    pub fn new(vertices: [u32; 3], corners: [DVec3; 3], weights: [f64; 3], point: DVec3) -> Grip {
        let offset = point - place(corners, weights);
        Grip { vertices, weights, offset: axes(corners).map(|axis| axis.dot(offset)) }
    }

    /// The same grip on a triangle whose corners have these numbers.
    pub fn on(self, vertices: [u32; 3]) -> Grip {
        Grip { vertices, ..self }
    }

    /// Where the vertex is when the triangle is at `corners`.
    pub fn point(&self, corners: [DVec3; 3]) -> DVec3 {
        let [along, across, normal] = axes(corners);
        place(corners, self.weights) + along * self.offset[0] + across * self.offset[1] + normal * self.offset[2]
    }

    /// Where the vertex is when the vertices of the obstacles are at `positions`, xyz.
    pub fn point_of(&self, positions: &[f32]) -> DVec3 {
        let corner = |v: u32| DVec3::from_array(std::array::from_fn(|i| f64::from(positions[3 * v as usize + i])));
        self.point(self.vertices.map(corner))
    }
}

/// Axes of a triangle, perpendicular to each other. A triangle that has collapsed to a line keeps the axis along it.
fn axes([a, b, c]: [DVec3; 3]) -> [DVec3; 3] {
    let along = (b - a).normalize_or(DVec3::X);
    let normal = along.cross(c - a).normalize_or(along.any_orthonormal_vector());
    [along, normal.cross(along), normal]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DQuat;

    #[test]
    fn a_grip_turns_and_moves_with_its_triangle() {
        let corners = [DVec3::ZERO, DVec3::new(2.0, 0.0, 0.0), DVec3::new(0.5, 1.0, 0.0)];
        let point = DVec3::new(0.4, -0.2, 0.3);
        let grip = Grip::new([0, 1, 2], corners, [0.8, 0.2, 0.0], point);
        assert!(grip.point(corners).distance(point) < 1e-15);
        let (turn, way) = (DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 2.0), DVec3::new(5.0, 0.0, -1.0));
        let moved = |p: DVec3| turn * p + way;
        assert!(grip.point(corners.map(moved)).distance(moved(point)) < 1e-14);
        // A stretched triangle takes the foot along; the distance from it stays.
        let stretched = corners.map(|p| p * 2.0);
        let foot = DVec3::new(0.8, 0.0, 0.0);
        assert!((grip.point(stretched).distance(foot) - point.distance(DVec3::new(0.4, 0.0, 0.0))).abs() < 1e-14);
        assert!(grip.point([DVec3::ONE; 3]).is_finite());
        let values: Vec<f32> = corners.iter().flat_map(|p| p.as_vec3().to_array()).collect();
        assert!(grip.point_of(&values).distance(point) < 1e-7);
    }
}
