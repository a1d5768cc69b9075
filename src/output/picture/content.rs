//! The contents of a picture: cloth and obstacles of a frame as one set of triangles, with normals and colors per
//! vertex.

use super::palette;
use super::smooth::{Colored, subdivided};
use crate::math::Vec3;
use crate::output::FrameMesh;

/// Obstacles keep the edges at which their triangles meet more sharply: cosine of 40 degrees.
const SMOOTH: f32 = 0.766;

/// Triangles ready to be drawn.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Content {
    /// Positions in the scene, meters.
    pub positions: Vec<Vec3>,
    /// Directions that the front faces, of unit length or zero.
    pub normals: Vec<Vec3>,
    /// Linear colors of front and back.
    pub colors: Vec<[Vec3; 2]>,
    /// Those without broken (not finite) corners; those of the cloth first.
    pub triangles: Vec<[u32; 3]>,
    /// How many triangles belong to the cloth.
    pub cloth: usize,
}

impl Content {
    /// Cloth in these colors (front and back of every vertex), `smooth` times subdivided, and obstacles.
    pub(super) fn new(cloth: FrameMesh, colors: Vec<[Vec3; 2]>, smooth: u32, obstacle: Option<&FrameMesh>) -> Content {
        let FrameMesh { positions, mut triangles } = cloth;
        triangles.retain(|t| t.iter().all(|i| positions[*i as usize].is_finite()));
        let mut mesh = Colored { positions, colors, triangles };
        for _ in 0..smooth {
            mesh = subdivided(&mesh);
        }
        let Colored { positions, colors, triangles } = mesh;
        let normals = vertex_normals(&positions, &triangles);
        let mut content = Content { positions, normals, colors, cloth: triangles.len(), triangles };
        if let Some(obstacle) = obstacle {
            content.add_obstacle(obstacle);
        }
        content
    }

    /// Every triangle gets corners of its own: their normals are the vertex's where the surface is smooth there, else
    /// the triangle's.
    fn add_obstacle(&mut self, obstacle: &FrameMesh) {
        let smooth = vertex_normals(&obstacle.positions, &obstacle.triangles);
        let color = palette::obstacle();
        for t in &obstacle.triangles {
            let corners = t.map(|i| obstacle.positions[i as usize]);
            if !corners.iter().all(|p| p.is_finite()) {
                continue;
            }
            let flat = normal_of(corners).normalize_or_zero();
            let normals = t.map(|i| smooth[i as usize]);
            let first = self.positions.len() as u32;
            self.positions.extend(corners);
            self.normals.extend(normals.map(|n| if n.dot(flat) > SMOOTH { n } else { flat }));
            self.colors.extend([[color; 2]; 3]);
            self.triangles.push([first, first + 1, first + 2]);
        }
    }

    /// Lowest and highest corner of the cloth's triangles; of all triangles where there is no cloth.
    pub(super) fn bounds(&self) -> [Vec3; 2] {
        let of = if self.cloth > 0 { &self.triangles[..self.cloth] } else { &self.triangles[..] };
        let none = [Vec3::INFINITY, Vec3::NEG_INFINITY];
        of.iter().flatten().map(|v| self.positions[*v as usize]).fold(none, |[low, high], p| [low.min(p), high.max(p)])
    }
}

/// Normal of a triangle, twice its area long.
fn normal_of([a, b, c]: [Vec3; 3]) -> Vec3 {
    (b - a).cross(c - a)
}

/// Directions of the sums of the triangles' normals, weighted by area.
fn vertex_normals(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    let mut normals = vec![Vec3::ZERO; positions.len()];
    for t in triangles {
        let normal = normal_of(t.map(|i| positions[i as usize]));
        if normal.is_finite() {
            t.iter().for_each(|i| normals[*i as usize] += normal);
        }
    }
    // Unit length here: corners of big and small triangles shall count alike when normals are blended.
    normals.iter_mut().for_each(|n| *n = n.normalize_or_zero());
    normals
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broken_triangles_go_and_sharp_obstacles_stay_sharp() {
        let nan = Vec3::splat(f32::NAN);
        let cloth =
            FrameMesh { positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, nan], triangles: vec![[0, 1, 2], [0, 2, 3]] };
        // Two triangles that meet at a right angle along x.
        let roof =
            FrameMesh { positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z], triangles: vec![[0, 1, 2], [1, 0, 3]] };
        let content = Content::new(cloth, vec![palette::fabric(); 4], 0, Some(&roof));
        assert_eq!((&content.triangles[..], content.cloth), (&[[0, 1, 2], [4, 5, 6], [7, 8, 9]][..], 1));
        assert_eq!(content.normals[4..7], [Vec3::Z; 3]);
        assert_eq!(content.normals[7..10], [Vec3::Y; 3]);
        assert!(content.colors[..4].iter().all(|c| *c == palette::fabric()));
        assert!(content.colors[4..].iter().all(|c| *c == [palette::obstacle(); 2]));
        assert_eq!(content.bounds(), [Vec3::ZERO, Vec3::new(1.0, 1.0, 0.0)]);
    }
}
