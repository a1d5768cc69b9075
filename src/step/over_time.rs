//! What changes during a run by itself: gravity, wind, friction and stiffness with keys, and force fields. All of it is
//! a function of time, and of a vertex's place at the start of a solve, so it is the same on any number of ranks.

use super::RankCloth;
use super::span::Span;
use crate::context::RankContext;
use crate::forces::ContactElement;
use crate::gpu::{DeviceVec, Executor};
use crate::math::{DIM, DVec3};

impl RankCloth {
    /// Takes the values at the end of `span`, which an implicit step goes by.
    pub(super) fn take_time(&mut self, executor: &Executor, span: Span) {
        self.settings.take_time(span.end_s);
        if let Some(factor) = &self.settings.over_time.stiffness_factor {
            self.elements.stiffen(executor, factor.at(span.end_s) as f32);
        }
        if let Some(factor) = &self.settings.over_time.friction_factor {
            self.friction_factor = factor.at(span.end_s) as f32;
        }
    }

    /// Friction of contacts whose coefficients are those of the scene.
    pub(super) fn change_friction(&self, contacts: &mut [ContactElement]) {
        if self.friction_factor != 1.0 {
            contacts.iter_mut().for_each(|contact| contact.friction *= self.friction_factor);
        }
    }

    /// rhs += dt m a of the force fields at the places that the state holds.
    pub(super) fn push(&mut self, rank: &mut RankContext<'_>, span: Span) {
        let forces = &self.settings.over_time.forces;
        if forces.is_empty() {
            return;
        }
        let own = self.state.recorded(rank);
        let share = f64::from(self.gravity_share());
        let push = |x: &[f32; DIM]| {
            let point = DVec3::from_array(x.map(f64::from));
            let sum: DVec3 = forces.iter().map(|force| force.acceleration_m_s2(point, span.end_s)).sum();
            (sum * (-span.length_s * share)).as_vec3().to_array()
        };
        let changes: Vec<f32> = own.positions.as_chunks::<DIM>().0.iter().flat_map(push).collect();
        let changes = DeviceVec::upload(rank.executor, &changes);
        self.inertia.apply(rank.executor, &self.system.masses, &changes, &mut self.system.rhs);
    }
}
