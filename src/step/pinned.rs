//! Pins of a step: prescribed rows, and the springs of soft pins. A spring of stiffness k from a row at x with velocity
//! v to its target x* at the end of the step adds dt^2 k to the diagonal of the row and dt k (x* - x - a v) to its
//! right-hand side, where a is the time that forces are taken ahead: backward Euler of a spring, exactly. Masses stay
//! as they are, so impact zones and inertia know nothing of springs.

use super::RankCloth;
use super::span::Span;
use crate::context::RankContext;
use crate::gpu::DeviceVec;
use crate::integrator::pins::{PRESCRIBED, PinTargets};
use crate::math::DIM;
use crate::transport::TransportError;

impl RankCloth {
    /// Takes and releases holds for `span`, and returns where they lead their rows.
    pub(super) fn move_pins(&mut self, rank: &mut RankContext<'_>, span: Span) -> Result<PinTargets, TransportError> {
        let (time_s, step_s) = (span.start_s, span.length_s);
        if self.pins.waits(time_s, step_s) {
            let own = self.state.recorded(rank);
            self.pins.take_hold(time_s, step_s, &self.pin_paths, &own.positions);
        }
        if let Some(collisions) = &mut self.collisions {
            collisions.share_touching(rank, &self.pins.touching())?;
        }
        let changes = self.pins.changes(time_s, step_s);
        if changes {
            let own = self.state.recorded(rank);
            self.pins.regrip(time_s, step_s, &own.positions, &own.velocities);
        }
        let targets = self.pins.targets(time_s, step_s, &self.pin_paths);
        if changes || self.pins.has_springs() {
            let mut pinned = vec![0.0f32; self.rows.len()];
            targets.rows.iter().for_each(|&row| pinned[row as usize] = PRESCRIBED);
            for spring in &targets.springs {
                pinned[spring.row as usize] = spring.stiffness_n_m * (step_s * step_s) as f32;
            }
            self.system.pinned.write_range(rank.executor, 0, &pinned);
        }
        self.own_springs.clone_from(&targets.springs);
        Ok(targets)
    }

    /// rhs += dt k (x* - x - `ahead_s` v) of the springs, at the state that the system was filled at.
    pub(super) fn pull_springs(&mut self, rank: &mut RankContext<'_>, span: Span, ahead_s: f64) {
        if self.own_springs.is_empty() {
            return;
        }
        let own = self.state.recorded(rank);
        let (mut weights, mut ways) = (vec![0.0f32; self.rows.len()], vec![0.0f32; own.positions.len()]);
        for spring in &self.own_springs {
            let row = spring.row as usize;
            weights[row] = spring.stiffness_n_m * span.length_s as f32;
            for axis in 0..DIM {
                let at = row * DIM + axis;
                ways[at] = (own.positions[at] - spring.target_m[axis]) + ahead_s as f32 * own.velocities[at];
            }
        }
        let [weights, ways] = [weights, ways].map(|values| DeviceVec::upload(rank.executor, &values));
        self.inertia.apply(rank.executor, &weights, &ways, &mut self.system.rhs);
    }
}
