//! The second solve of a step: one more Newton step on backward Euler, linearized where the first one ended. With
//! x1 = x0 + dt v1 of the first solve it is (M - dt D - dt^2 K) dv = dt f(x1, v1) - M (v1 - v0), with K, D, f and the
//! contacts of the state x1, v1; [Baraff and Witkin 1998] take the first of these steps alone.
//!
//! What contacts do to a sliding cloth is decided by where its features are at the end of the step: over an edge it
//! turns by a right angle within a few millimeters, and a force along a normal of the start holds what wants to go
//! round. The same holds for membrane forces: a triangle that turns by an angle within a step seems longer by half its
//! square, which takes what tension should have given. Steps of ordinary cloth that touches nothing have one solve.

use super::span::Span;
use super::stats::{StageClock, StepStats};
use super::{Failure, RankCloth};
use crate::context::RankContext;
use crate::gpu::DeviceVec;
use crate::integrator::pins::PinTargets;
use crate::model::RankState;

/// Tolerance of a second solve over that of the first, and at most: its right-hand side is what the first solve has
/// left, by its tolerance and by its linearization. In stiff cloth a tenth of that may be all that moves the cloth.
const TOLERANCE_AGAIN: f64 = 10.0;
const TOLERANCE_AGAIN_MOST: f64 = 0.1;
/// Tolerance of a first solve that a second one follows over that of a single one. Together they leave less than that.
const TOLERANCE_FIRST: f64 = 3.0;

impl RankCloth {
    /// Tolerance of a first solve, with contacts or without.
    pub(super) fn first_tolerance(&self, with_contacts: bool) -> f64 {
        let tolerance = self.settings.relative_tolerance;
        let followed = with_contacts && !self.stiff;
        if followed { (TOLERANCE_FIRST * tolerance).min(TOLERANCE_AGAIN_MOST) } else { tolerance }
    }

    /// Stages 2 to 6 once more from `start`, linearized at the end that the state holds, if contacts or stiff cloth
    /// need it. True if they do.
    pub(super) fn solve_again(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        start: &RankState,
        targets: &PinTargets,
        stats: &mut StepStats,
    ) -> Result<bool, Failure> {
        if let Some(collisions) = &mut self.collisions {
            let end = self.state.recorded(rank);
            let (found, count) = collisions.contacts_again(rank, &end.positions, span, stats)?;
            if count == 0 && stats.contacts == 0 && !self.stiff {
                return Ok(false);
            }
            self.take_contacts(rank, found, stats)?;
        } else if !self.stiff {
            return Ok(false);
        }
        self.solve_from_end(rank, span, start, targets, None, stats)?;
        Ok(true)
    }

    /// Stages 3 to 6 once more, with the contacts as they are. `changes`: the velocity changes of the own rows that all
    /// solves so far have found together, if there were more than one. A solve that breaks off leaves the state.
    pub(super) fn solve_from_end(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        start: &RankState,
        targets: &PinTargets,
        changes: Option<&DeviceVec<f32>>,
        stats: &mut StepStats,
    ) -> Result<(), Failure> {
        let clock = StageClock::start();
        self.state.exchange_again(rank, self.solver.spmv.halo(), start)?;
        clock.lap_kernels(rank.executor, &mut stats.seconds.exchange);

        self.element_records(rank, span, 0.0);
        clock.lap_kernels(rank.executor, &mut stats.seconds.elements);
        rank.transport.alive()?;

        self.fill_matrix(rank, span, 0.0);
        let masses = self.guided.as_ref().map_or(&self.system.masses, |guided| &guided.masses);
        let changes = changes.unwrap_or(&self.solver.vectors.x);
        self.inertia.apply(rank.executor, masses, changes, &mut self.system.rhs);
        clock.lap_kernels(rank.executor, &mut stats.seconds.value_fill);
        rank.transport.alive()?;

        self.solver.vectors.x.fill_zero(rank.executor);
        let single = self.settings.relative_tolerance;
        let wider = (TOLERANCE_AGAIN * single).min(TOLERANCE_AGAIN_MOST);
        let of_first = std::mem::take(&mut stats.residual);
        if !self.solve(rank, if self.stiff { single } else { wider }, false, true, stats)? {
            stats.residual = of_first;
            return Ok(());
        }
        // This solve's is relative to what the first one has left. Of solves that stopped early the report tells the
        // largest.
        stats.residual = if stats.converged { of_first * stats.residual } else { of_first.max(stats.residual) };
        clock.lap_kernels(rank.executor, &mut stats.seconds.solve);

        self.state.put_back(rank.executor, start);
        self.state.advance(rank, span, &self.solver.vectors.x, targets);
        clock.lap_kernels(rank.executor, &mut stats.seconds.advance);
        Ok(())
    }
}
