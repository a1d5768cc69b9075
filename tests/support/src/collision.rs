//! Models for the tests of collision detection.

use loomtree::collision::broad::{CollisionMesh, Query};
use loomtree::math::Vec3;
use loomtree::mesh::{TriangleMesh, vertex_order};
use loomtree::partition::chunk_rows;

use crate::seeded::Seeded;

/// Cloth, then obstacles, growing piece by piece.
#[derive(Clone, Default)]
pub struct Model {
    pub x0: Vec<Vec3>,
    pub x1: Vec<Vec3>,
    pub triangles: Vec<[u32; 3]>,
    pub cloth: Option<usize>,
}

impl Model {
    /// A grid of n x m vertices at `place(u, v)`, u and v in 0..=1; moves by `motion(start)`.
    pub fn sheet(
        &mut self,
        n: usize,
        m: usize,
        place: impl Fn(f32, f32) -> Vec3,
        mut motion: impl FnMut(Vec3) -> Vec3,
    ) {
        let first = self.x0.len() as u32;
        for i in 0..n * m {
            let at = place((i % n) as f32 / (n - 1) as f32, (i / n) as f32 / (m - 1) as f32);
            self.x0.push(at);
            self.x1.push(motion(at));
        }
        for (i, j) in (0..m as u32 - 1).flat_map(|j| (0..n as u32 - 1).map(move |i| (i, j))) {
            let (a, n) = (first + j * n as u32 + i, n as u32);
            if (i + j) % 2 == 0 {
                self.triangles.extend([[a, a + 1, a + n + 1], [a, a + n + 1, a + n]]);
            } else {
                self.triangles.extend([[a, a + 1, a + n], [a + 1, a + n + 1, a + n]]);
            }
        }
    }

    /// What was there is cloth; what follows is obstacle.
    pub fn obstacles_follow(&mut self) {
        self.cloth = Some(self.x0.len());
    }

    pub fn mesh(&self) -> CollisionMesh {
        let cloth = self.cloth.unwrap_or(self.x0.len());
        CollisionMesh::new(self.x0.len(), cloth, self.triangles.clone()).expect("a mesh")
    }

    pub fn query(&self, radius_m: f32) -> Query<'_> {
        Query { x_t0: flat(&self.x0), x_t1: flat(&self.x1), radius_m }
    }

    /// The same triangles in another order.
    pub fn shuffle(&mut self, random: &mut Seeded) {
        for i in (1..self.triangles.len()).rev() {
            self.triangles.swap(i, (random.bits64() % (i as u64 + 1)) as usize);
        }
    }
}

pub fn flat(points: &[Vec3]) -> &[f32] {
    // Vec3 is three packed floats.
    bytemuck::cast_slice(points)
}

/// Folded like an accordion, slightly crumpled.
pub fn folded(u: f32, v: f32) -> Vec3 {
    let bend = (u * 21.0).sin();
    Vec3::new(0.12 * bend + 0.01 * (v * 40.0).sin(), v, 0.02 * u * 21.0 * 0.4 + 0.01 * (v * 23.0 + u * 9.0).cos())
}

pub fn sphere(center: Vec3, radius: f32) -> impl Fn(f32, f32) -> Vec3 {
    move |u, v| {
        let (a, b) = (u * std::f32::consts::TAU, (v * 0.96 + 0.02) * std::f32::consts::PI);
        center + radius * Vec3::new(a.cos() * b.sin(), a.sin() * b.sin(), b.cos())
    }
}

/// Vertices in the order that scenes have: patches are made for it.
pub fn ordered(model: &Model, rest: impl Fn(usize) -> Vec3) -> Model {
    let positions: Vec<Vec3> = (0..model.x0.len()).map(rest).collect();
    let chunk = chunk_rows(positions.len());
    let order =
        vertex_order(&TriangleMesh { positions, triangles: model.triangles.clone(), material_uv: Vec::new() }, chunk);
    let mut new = vec![0; order.len()];
    order.iter().zip(0..).for_each(|(&old, at)| new[old as usize] = at);
    let pick = |x: &[Vec3]| order.iter().map(|&old| x[old as usize]).collect();
    let triangles = model.triangles.iter().map(|t| t.map(|v| new[v as usize])).collect();
    Model { x0: pick(&model.x0), x1: pick(&model.x1), triangles, cloth: model.cloth }
}
