//! Surfaces given by a function: the set where it is zero, negative inside, as evenly sized triangles, whole or cut
//! open where another function is negative.
//!
//! A net over a grid finds the surface [Gibson 1998]; rounds of splitting, collapsing and flipping edges and of moving
//! vertices along the surface make its triangles nearly equilateral [Botsch and Kobbelt 2004]. Everything is done in
//! one order on one thread, so the same functions give the same bits.

mod cut;
mod field;
mod net;
mod remesh;
mod topology;

use crate::math::{DVec3, Vec3};

use super::Surface;
pub use field::{Field, LevelSet};
use net::net;
use remesh::remesh;

/// Area of an equilateral triangle over its squared edge.
const EQUILATERAL: f64 = 0.433_012_701_892_219_3;
/// Triangles of the mesh that measures the area.
const COARSE: f64 = 4_000.0;
/// Edges of the grid per edge of the mesh.
const CELLS: f64 = 0.8;
/// How often a finer grid is tried where one gives a surface that is not a manifold.
const TRIES: usize = 4;

impl LevelSet<'_> {
    /// The surface with about `triangles` triangles, within a few percent. Faces point outward. `None` if it has no
    /// surface in its bounds, or none that a grid as fine as this finds as a manifold.
    pub fn mesh(&self, triangles: f64) -> Option<Surface> {
        let area = self.area()?;
        let points = self.points((area / triangles / EQUILATERAL).sqrt())?;
        let positions: Vec<Vec3> = points.0.iter().map(|p| p.as_vec3()).collect();
        Some(Surface { positions, triangles: points.1, ..Surface::default() })
    }

    /// Area of the surface, m^2, from a coarse mesh.
    pub fn area(&self) -> Option<f64> {
        let size = self.bounds[1] - self.bounds[0];
        let mut area = size.x * size.y + size.y * size.z + size.z * size.x;
        // Once from the box around it, once from what that gave.
        for _ in 0..2 {
            let (points, triangles) = self.points((area / COARSE / EQUILATERAL).sqrt())?;
            let of_triangle = |&[a, b, c]: &[u32; 3]| {
                let [a, b, c] = [a, b, c].map(|v| points[v as usize]);
                (b - a).cross(c - a).length() / 2.0
            };
            area = triangles.iter().map(of_triangle).sum();
        }
        Some(area)
    }

    fn points(&self, edge_m: f64) -> Option<(Vec<DVec3>, Vec<[u32; 3]>)> {
        let mut cell = CELLS * edge_m;
        for _ in 0..TRIES {
            let (points, triangles) = net(self.inside, self.bounds, cell);
            let (points, triangles) = match self.keep {
                Some(keep) => cut::cut(points, triangles, self, keep, cell),
                None => (points, triangles),
            };
            if !triangles.is_empty() && topology::is_manifold(points.len(), &triangles) {
                return Some(remesh(points, triangles, self, edge_m));
            }
            cell *= 0.83;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;
    use crate::mesh::validate::check_surface;

    /// Edges with one triangle, and the Euler number.
    fn rim_and_euler(surface: &Surface) -> (usize, i64) {
        check_surface(&surface.positions, &surface.triangles).unwrap();
        let mut edges: HashMap<[u32; 2], u32> = HashMap::new();
        for &[a, b, c] in &surface.triangles {
            for [s, t] in [[a, b], [b, c], [c, a]] {
                *edges.entry([s.min(t), s.max(t)]).or_default() += 1;
            }
        }
        let euler = surface.positions.len() as i64 - edges.len() as i64 + surface.triangles.len() as i64;
        (edges.values().filter(|&&count| count == 1).count(), euler)
    }

    fn smallest_angle(surface: &Surface) -> f64 {
        let angle = |[a, b, c]: [DVec3; 3]| (b - a).angle_between(c - a).to_degrees();
        let least = |corners: &[u32; 3]| {
            let [a, b, c] = corners.map(|v| surface.positions[v as usize].as_dvec3());
            angle([a, b, c]).min(angle([b, c, a])).min(angle([c, a, b]))
        };
        surface.triangles.iter().map(least).fold(90.0, f64::min)
    }

    #[test]
    fn a_ball_is_closed_round_and_even() {
        let inside = |p: DVec3| p.length() - 0.5;
        let ball = LevelSet { inside: &inside, keep: None, bounds: [DVec3::splat(-0.5), DVec3::splat(0.5)] };
        for wanted in [500.0, 3_000.0, 20_000.0] {
            let surface = ball.mesh(wanted).unwrap();
            assert_eq!(rim_and_euler(&surface), (0, 2));
            assert!((surface.triangles.len() as f64 / wanted - 1.0).abs() < 0.12, "{}", surface.triangles.len());
            assert!(surface.positions.iter().all(|p| (p.length() - 0.5).abs() < 1e-4));
            assert!(smallest_angle(&surface) > 25.0, "{}", smallest_angle(&surface));
            let [a, b, c] = surface.triangles[0].map(|v| surface.positions[v as usize]);
            assert!((b - a).cross(c - a).dot(a) > 0.0, "faces point outward");
        }
        assert!((ball.area().unwrap() / std::f64::consts::PI - 1.0).abs() < 0.01);
    }

    #[test]
    fn a_cut_ball_has_its_rim_on_the_cut() {
        let inside = |p: DVec3| p.length() - 0.5;
        let keep = |p: DVec3| p.y + 0.2;
        let cup = LevelSet { inside: &inside, keep: Some(&keep), bounds: [DVec3::splat(-0.5), DVec3::splat(0.5)] };
        let surface = cup.mesh(3_000.0).unwrap();
        let (rim, euler) = rim_and_euler(&surface);
        assert_eq!(euler, 1);
        let on_rim = surface.positions.iter().filter(|p| (p.y + 0.2).abs() < 1e-4).count();
        assert!(surface.positions.iter().all(|p| p.y > -0.2 - 1e-4));
        assert_eq!(on_rim, rim);
        assert!(smallest_angle(&surface) > 15.0, "{}", smallest_angle(&surface));
        let height = 0.7 * std::f64::consts::PI;
        assert!((cup.area().unwrap() / height - 1.0).abs() < 0.01);
    }

    #[test]
    fn two_sheets_in_one_cell_stay_apart_and_nothing_gives_nothing() {
        // Plates closer to each other than a cell of the grid.
        let inside = |p: DVec3| ((p.y.abs() - 0.006).abs() - 0.004).max(p.length() - 0.5);
        let plates = LevelSet { inside: &inside, keep: None, bounds: [DVec3::splat(-0.5), DVec3::splat(0.5)] };
        if let Some(surface) = plates.mesh(4_000.0) {
            check_surface(&surface.positions, &surface.triangles).unwrap();
        }
        let nowhere = |_: DVec3| 1.0;
        let bounds = [DVec3::splat(-0.5), DVec3::splat(0.5)];
        assert!(LevelSet { inside: &nowhere, keep: None, bounds }.mesh(1_000.0).is_none());
    }
}
