//! Newton iterations of a step of stiff cloth. One linearization at the start of the step lets a stiff sheet turn too
//! slowly: its elements stretch as they turn, and the linear system resists that.
//!
//! With x1 = x0 + dt v1 of the solve before, the next one is (M - dt D - dt^2 K) dv = dt f(x1, v1) - M (v1 - v0), with
//! K, D and f of the state x1, v1. [Baraff and Witkin 1998] take the first of these iterations alone.

use std::rc::Rc;

use super::span::Span;
use super::stats::StepStats;
use super::{Failure, RankCloth};
use crate::context::RankContext;
use crate::integrator::pins::PinTargets;
use crate::math::DIM;
use crate::model::RankState;

/// Newton iterations after the first solve.
const ITERATIONS: u32 = 1;

impl RankCloth {
    /// Repeats the solve of a step from `before` whose end the state holds. A solve that breaks off ends the iterations;
    /// the state then stays as it is.
    pub(super) fn relinearize(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        before: &RankState,
        targets: &PinTargets,
        stats: &mut StepStats,
    ) -> Result<(), Failure> {
        for _ in 0..ITERATIONS {
            let now = self.state.recorded(rank);
            self.state.exchange(rank, self.solver.spmv.halo())?;
            self.element_records(rank, span, 0.0);
            self.fill_matrix(rank, span);
            let mut rhs = self.system.rhs.read(rank.executor);
            let masses = self.system.masses.host(rank.executor);
            for (i, rhs) in rhs.iter_mut().enumerate() {
                *rhs -= masses[i / DIM] * (now.velocities[i] - before.velocities[i]);
            }
            drop(masses);
            self.system.rhs.write_range(rank.executor, 0, &rhs);
            self.solver.vectors.x.fill_zero(rank.executor);
            if !self.solve(rank, self.settings.relative_tolerance, false, true, stats)? {
                return Ok(());
            }
            let (positions, velocities) = (before.positions.clone(), now.velocities.clone());
            self.state.set(rank.executor, Rc::new(RankState { positions, velocities, creases: Vec::new() }));
            self.state.advance(rank, span, &self.solver.vectors.x, targets);
        }
        Ok(())
    }
}
