//! Whether a straight motion of cloth is free: asked by those who move vertices outside of a step.

use super::broad::{BroadError, CollisionMesh, Split};
use super::detector::Detector;
use super::rules::ContactParams;
use super::{Impact, LeftOut};
use crate::gpu::CpuExecutor;

/// A motion of all vertices of a surface.
pub struct StraightWay<'a> {
    /// Triangles of the cloth, then of the obstacles.
    pub triangles: &'a [[u32; 3]],
    /// Vertices of the cloth, which come first.
    pub cloth_vertices: usize,
    /// Pairs that take no notice of each other.
    pub left_out: Vec<LeftOut>,
}

impl StraightWay<'_> {
    /// Pairs of features that are not proven apart on the straight way from `from` to `to` (xyz of every vertex).
    ///
    /// # Errors
    /// A sentence: the surface has a fault, or a position is not finite.
    pub fn touching(&self, from: &[f32], to: &[f32]) -> Result<Vec<Impact>, String> {
        let vertices = from.len() / 3;
        let mesh = CollisionMesh::new(vertices, self.cloth_vertices, self.triangles.to_vec())
            .map_err(|error| error.to_string())?;
        let params = ContactParams {
            thickness_m: 0.0,
            separation_m: 0.0,
            stiffness_ratio: 0.0,
            step_s: 1.0,
            friction: vec![0.0; vertices],
            inverse_masses_per_kg: vec![1.0; vertices],
            smallest_altitudes_m: vec![f32::MAX; vertices],
            friction_factors: Vec::new(),
            thickness_factors: Vec::new(),
        };
        let mut detector = Detector::new(mesh, params).map_err(|error| error.to_string())?;
        detector.leave_out(self.left_out.clone());
        let mut found = Vec::new();
        let host = CpuExecutor::new(1);
        let split = &mut Split::alone(0, 1);
        let query: Result<_, BroadError> = detector.impacts(&host, from, to, None, split, &mut found);
        query.map_err(|error| error.to_string())?;
        Ok(found)
    }
}
