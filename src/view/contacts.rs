//! Contacts of a frame, found by the detector that a step uses.

use crate::collision::broad::{CollisionMesh, Split};
use crate::collision::{ContactParams, Detector};
use crate::forces::{ContactElement, linearized};
use crate::gpu::CpuExecutor;
use crate::integrator::pins::{RankPin, is_held};
use crate::math::Vec3;
use crate::model::GlobalModel;

/// A detector for the mesh of a run.
pub(super) struct Contacts {
    detector: Detector,
    host: CpuExecutor,
    thickness_m: f32,
}

impl Contacts {
    pub(super) fn new(model: &GlobalModel) -> Result<Contacts, String> {
        let rows = model.rows();
        let vertices = rows + model.obstacles.vertices();
        let mut triangles: Vec<[u32; 3]> = model.triangles.iter().map(|element| element.vertices).collect();
        let mut altitudes_m = vec![f32::MAX; vertices];
        for element in &model.triangles {
            for v in element.vertices {
                altitudes_m[v as usize] = altitudes_m[v as usize].min(element.smallest_altitude_m());
            }
        }
        triangles.extend(model.obstacles.welded_triangles().iter().map(|corners| corners.map(|v| v + rows as u32)));
        let mesh = CollisionMesh::new(vertices, rows, triangles).map_err(|error| error.to_string())?;
        let mut inverse_masses = vec![0.0; vertices];
        inverse_masses.iter_mut().zip(&model.masses).for_each(|(inverse, mass)| *inverse = 1.0 / mass);
        let thickness_m = model.settings.thickness_m as f32;
        let params = ContactParams {
            thickness_m,
            separation_m: 0.0,
            stiffness_ratio: model.settings.contact_stiffness as f32,
            step_s: model.settings.step_s as f32,
            friction: vec![0.0; vertices],
            inverse_masses_per_kg: inverse_masses,
            smallest_altitudes_m: altitudes_m,
            friction_factors: Vec::new(),
            thickness_factors: model.factors[1].clone(),
        };
        let detector = Detector::new(mesh, params).map_err(|error| error.to_string())?;
        // One thread: the run has the others.
        Ok(Contacts { detector, host: CpuExecutor::new(1), thickness_m })
    }

    /// Of every vertex of the mesh: 1 - gap / thickness of its nearest contact, 0 without one.
    pub(super) fn near(&mut self, model: &GlobalModel, positions: &[Vec3], time_s: f64) -> Result<Vec<f32>, String> {
        let order = &model.original_from_global;
        let found = self.found(model, positions, time_s)?;
        let mut near = vec![0.0_f32; positions.len()];
        for contact in &found {
            let close = (1.0 - contact.distance_m / self.thickness_m).clamp(0.0, 1.0);
            for row in contact.vertices {
                // Obstacle vertices have no color.
                if let Some(&vertex) = order.get(row as usize) {
                    let own = &mut near[vertex as usize];
                    *own = own.max(close.max(0.02));
                }
            }
        }
        Ok(near)
    }

    /// Of every vertex of the mesh the sum of the normal forces of its contacts, N: what repels at the distances of the
    /// frame in a step of the scene's length. `held`: rows that a pin holds at the time count as immobile.
    pub(super) fn forces(&mut self, model: &GlobalModel, positions: &[Vec3], time_s: f64) -> Result<Vec<Vec3>, String> {
        let order = &model.original_from_global;
        let mut params = self.detector.params().clone();
        let masses = params.inverse_masses_per_kg.iter_mut().zip(&model.masses);
        masses.for_each(|(inverse, mass)| *inverse = 1.0 / mass);
        let is_hard = |pin: &&RankPin| pin.stiffness_n_m.is_none() && !pin.takes_hold_later;
        for pin in model.pins.iter().filter(is_hard).filter(|pin| is_held((pin.start_s, pin.end_s), time_s, 0.0)) {
            params.inverse_masses_per_kg[pin.row as usize] = 0.0;
        }
        if params != *self.detector.params() {
            self.detector.set_params(params).map_err(|error| error.to_string())?;
        }
        let mut forces = vec![Vec3::ZERO; positions.len()];
        let stiffness_ratio = model.settings.contact_stiffness as f32;
        for contact in self.found(model, positions, time_s)? {
            let push = linearized(&contact, contact.distance_m, stiffness_ratio, true).force_n;
            for (row, weight) in contact.vertices.into_iter().zip(contact.weights) {
                if let Some(&vertex) = order.get(row as usize) {
                    forces[vertex as usize] += Vec3::from(contact.normal) * (weight * push);
                }
            }
        }
        Ok(forces)
    }

    /// The contacts of a frame.
    fn found(&mut self, model: &GlobalModel, positions: &[Vec3], time_s: f64) -> Result<Vec<ContactElement>, String> {
        let order = &model.original_from_global;
        let mut x: Vec<f32> = order.iter().flat_map(|&v| positions[v as usize].to_array()).collect();
        let mut obstacles = Vec::new();
        model.obstacles.positions_at(time_s, &mut obstacles);
        x.extend(obstacles);
        let mut found = Vec::new();
        self.detector
            .contacts(&self.host, &x, &mut Split::alone(0, 1), &mut found)
            .map_err(|error| error.to_string())?;
        Ok(found)
    }
}
