//! Obstacles that pins take hold of while the cloth moves.

use crate::math::{DVec3, Vec3, bounds};
use crate::mesh::NearestPoint;
use crate::scene::{Grip, Hold, Obstacles};

/// Whole obstacles, in a numbering of their own.
#[derive(Clone, Debug, Default)]
pub struct Surfaces {
    /// Their vertices.
    pub obstacles: Obstacles,
    /// Number of every vertex among those of all obstacles of the scene, ascending.
    pub vertices: Vec<u32>,
    /// Triangles of all of them, numbered as `vertices`; pins know their range.
    pub triangles: Vec<[u32; 3]>,
}

impl Surfaces {
    /// The same, if the lists fit each other.
    pub fn checked(self) -> Option<Surfaces> {
        let count = self.vertices.len();
        let fits = self.obstacles.vertices() == count
            && self.vertices.is_sorted()
            && self.triangles.iter().flatten().all(|&v| (v as usize) < count);
        fits.then_some(self)
    }

    /// Positions of all vertices at a time.
    pub(super) fn at(&self, time_s: f64) -> Vec<Vec3> {
        let mut values = Vec::new();
        self.obstacles.positions_at(time_s, &mut values);
        bytemuck::cast_slice(&values).to_vec()
    }

    /// The holds of rows at the places `points` on the nearest of the triangles `range`, whose corners are among
    /// `positions`; none where that is farther away than `reach_m`. Of several equally near triangles the first.
    pub(super) fn holds(
        &self,
        range: [u32; 2],
        positions: &[Vec3],
        points: &[(u32, DVec3)],
        reach_m: f64,
    ) -> Vec<Option<Hold>> {
        let triangles = &self.triangles[range[0] as usize..range[1] as usize];
        let (low, high) = bounds(points.iter().map(|(_, point)| *point));
        let (low, high) = (low - reach_m, high + reach_m);
        let is_near = |corners: &&[u32; 3]| {
            let corners = corners.map(|v| positions[v as usize].as_dvec3());
            let (least, most) = bounds(corners.into_iter());
            least.cmple(high).all() && most.cmpge(low).all()
        };
        let near: Vec<[u32; 3]> = triangles.iter().filter(is_near).copied().collect();
        let surface = NearestPoint::new(positions, &near);
        let hold = |&(row, point): &(u32, DVec3)| {
            let foot = surface.to(point).filter(|foot| foot.distance_m <= reach_m)?;
            let corners = near[foot.triangle];
            let at = corners.map(|v| positions[v as usize].as_dvec3());
            let named = corners.map(|v| self.vertices[v as usize]);
            Some(Grip::new(named, at, foot.weights, point).hold(row))
        };
        points.iter().map(hold).collect()
    }

    /// Place among `vertices` of a vertex of the scene's obstacles.
    pub(super) fn local(&self, vertex: u32) -> Option<u32> {
        self.vertices.binary_search(&vertex).ok().map(|place| place as u32)
    }
}
