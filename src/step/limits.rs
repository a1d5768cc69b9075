//! The end of a step of cloth with strain limits: one more solve where triangles have turned far, and the rest is
//! pulled back.
//!
//! Fibers (`forces/fiber.rs`) act along directions of the start of the step. Cloth that turns by an angle within a step
//! is longer at its end by half the square of that angle, and has no force against it: a flag that the wind takes at 10
//! m/s turns by a right angle in a few steps. So a step that ends far beyond a limit is solved once more, linearized
//! at its end (D28 in docs/papers.md).
//!
//! What is beyond a limit after that is pulled back. A triangle that snaps there within one step, as folds do in a
//! wind, meets no resistance until the next one; and a fiber at a point pin, which carries the load of the whole cloth,
//! gives way as any spring does. In every round each triangle pulls its corners back by the shortest way in the norm of
//! their masses [Mueller et al. 2007], which keeps the momentum, and vertices go on a part of the way that they went in
//! the round before [Polyak 1964]. Velocities follow the moves. A triangle that was beyond its limit before the step
//! comes back at a bounded rate. What pins leave no way back for stays where it is and is counted. Collisions come
//! after this and have the last word.

use std::ops::Range;
use std::rc::Rc;

use super::limited::{EXCESS, Moves, PULLED_FROM};
use super::span::Span;
use super::stats::{LimitCounts, StageClock, StepStats};
use super::{Failure, RankCloth};
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor};
use crate::integrator::pins::{PRESCRIBED, PinTargets};
use crate::math::{DIM, Vec3};
use crate::model::RankState;
use crate::telemetry::{Activity, EventName};
use crate::transport::TransportError;

/// Strain beyond a limit from which on a step is solved once more.
const SOLVED_AGAIN_FROM: f64 = 0.02;
/// The same where contacts have had a second solve already, which was linearized at the end of the first one as well.
const SOLVED_ONCE_MORE_FROM: f64 = 0.04;
/// Strain beyond a limit from which on a triangle that stays there is counted.
const COUNTED_FROM: f32 = 0.005;
/// Fastest change of strain by which a triangle is pulled back that was beyond its limit at the start of the step
/// already, 1/s: 4 % in a step of 4 ms. Without a bound the speed that a triangle springs back with grows as steps get
/// shorter; cloth that is tangled with itself, which impact zones stretch again, was thrown to six times the speed of
/// the wind. One that was within its limit has no such speed: it is put back where this step took it from.
const PULLED_1_S: f64 = 10.0;
/// Maximum number of rounds, and rounds between two looks at what all ranks have.
const ROUNDS_MOST: u32 = 60;
const ROUNDS_BETWEEN: u32 = 4;
/// Part of a vertex's way in a round that it goes on in the next one.
const GOES_ON: f32 = 0.8;

/// What all ranks have beyond limits.
struct Beyond {
    /// Largest strain beyond a limit.
    worst: f64,
    /// Largest strain beyond what a triangle is pulled back to.
    excess: f64,
    counted: u64,
    pulled: u64,
}

impl RankCloth {
    /// Brings the state at the end of `span` within the strain limits; `start`: the state at its start, `solved_again`:
    /// whether the step has had a second solve ([`RankCloth::solve_again`]).
    pub(super) fn keep_limits(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        start: &RankState,
        targets: &PinTargets,
        solved_again: bool,
        stats: &mut StepStats,
    ) -> Result<(), Failure> {
        if self.limited.is_none() {
            return Ok(());
        }
        let clock = StageClock::start();
        let began = rank.recorder.now();
        let mut beyond = self.measure_limits(rank, span)?;
        clock.lap_kernels(rank.executor, &mut stats.seconds.elements);
        rank.recorder.end(EventName::Elements, Activity::Compute, began, 0, 0);
        let again_from = if solved_again { SOLVED_ONCE_MORE_FROM } else { SOLVED_AGAIN_FROM };
        if beyond.worst > again_from {
            let end = self.state.recorded(rank);
            let changes: Vec<f32> = end.velocities.iter().zip(&start.velocities).map(|(v1, v0)| v1 - v0).collect();
            let changes = DeviceVec::upload(rank.executor, &changes);
            self.solve_from_end(rank, span, start, targets, Some(&changes), stats)?;
            stats.limits.solved_again += 1;
            clock.restart();
            beyond = self.measure_limits(rank, span)?;
        }
        let began = rank.recorder.now();
        if beyond.worst > span.length_s * PULLED_1_S {
            let at_start = self.of_local_rows(rank, &start.positions)?;
            if let Some(limited) = &mut self.limited {
                limited.unbind_within(&at_start, COUNTED_FROM);
            }
            beyond = self.compare_limits(rank)?;
        }
        stats.limits.pulled += beyond.pulled;
        stats.limits.beyond = beyond.counted;
        if beyond.excess > f64::from(EXCESS) {
            stats.limits.beyond = self.pull_back(rank, span, &beyond, stats)?;
        }
        rank.recorder.end(EventName::Elements, Activity::Compute, began, 0, 0);
        clock.lap_kernels(rank.executor, &mut stats.seconds.elements);
        Ok(())
    }

    /// Measures all triangles of the state.
    fn measure_limits(&mut self, rank: &mut RankContext<'_>, span: Span) -> Result<Beyond, TransportError> {
        self.state.exchange_positions(rank, self.solver.spmv.halo())?;
        let positions = self.state.positions.host(rank.executor);
        if let Some(limited) = &mut self.limited {
            limited.measure(rank.executor.native(), &positions, (span.length_s * PULLED_1_S) as f32);
        }
        self.compare_limits(rank)
    }

    /// What all ranks have measured.
    fn compare_limits(&mut self, rank: &mut RankContext<'_>) -> Result<Beyond, TransportError> {
        let own = self.own_locals();
        let Some(limited) = &self.limited else { return Ok(Beyond { worst: 0.0, excess: 0.0, counted: 0, pulled: 0 }) };
        let values = [
            f64::from(limited.worst()),
            f64::from(limited.worst_excess()),
            limited.count(COUNTED_FROM, &own) as f64,
            limited.count(PULLED_FROM, &own) as f64,
        ];
        let start = rank.recorder.now();
        let mut all = Vec::new();
        rank.transport.all_gather(&values, &mut all)?;
        rank.recorder.end(EventName::AllReduce, Activity::Wait, start, 8 * values.len() as u64, 0);
        let largest = |i: usize| all.iter().map(|of_rank| of_rank[i]).fold(0.0, f64::max);
        let sum = |i: usize| all.iter().map(|of_rank| of_rank[i]).sum::<f64>() as u64;
        Ok(Beyond { worst: largest(0), excess: largest(1), counted: sum(2), pulled: sum(3) })
    }

    /// Own rows among the local ones.
    fn own_locals(&mut self) -> Range<usize> {
        let first = self.solver.spmv.halo().plan().own.start;
        first..first + self.rows.len()
    }

    /// Pulls triangles back, and returns how many are still beyond. If the worst one is farther beyond after it,
    /// nothing is moved.
    fn pull_back(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        found: &Beyond,
        stats: &mut StepStats,
    ) -> Result<u64, TransportError> {
        let own = self.own_locals();
        let inverse_masses = self.inverse_masses(rank)?;
        let before = self.state.recorded(rank);
        let mut positions = self.state.positions.host(rank.executor).into_owned();
        let mut moves = Moves::none(inverse_masses.len());
        let (mut step, mut way) = (vec![Vec3::ZERO; own.len()], vec![Vec3::ZERO; own.len()]);
        // Own vertices that have been pulled, and where all of them are.
        let (mut pulled, mut is_pulled, mut end) = (Vec::new(), vec![false; own.len()], before.positions.clone());
        for round in 1..=ROUNDS_MOST {
            let Some(limited) = &mut self.limited else { break };
            limited.pull(&positions, &inverse_masses, &mut moves);
            for vertex in moves.vertices().iter().map(|&v| v as usize).filter(|v| own.contains(v)) {
                if !std::mem::replace(&mut is_pulled[vertex - own.start], true) {
                    pulled.push(vertex - own.start);
                }
            }
            for &i in &pulled {
                step[i] = step[i] * GOES_ON + moves.of(own.start + i);
                way[i] += step[i];
                let at = i * DIM..(i + 1) * DIM;
                (Vec3::from_slice(&before.positions[at.clone()]) + way[i]).write_to_slice(&mut end[at]);
            }
            self.state.positions.write_range(rank.executor, own.start * DIM, &end);
            self.state.exchange_positions(rank, self.solver.spmv.halo())?;
            let moved = self.state.positions.host(rank.executor);
            let others = (0..own.start).chain(own.end..inverse_masses.len());
            for vertex in others.chain(pulled.iter().map(|i| own.start + i)) {
                let at = vertex * DIM..(vertex + 1) * DIM;
                if moved[at.clone()] != positions[at.clone()] {
                    positions[at.clone()].copy_from_slice(&moved[at]);
                    limited.watch_around(vertex);
                }
            }
            limited.measure_watched(&positions);
            stats.limits.rounds += 1;
            if round % ROUNDS_BETWEEN == 0 && self.compare_limits(rank)?.excess <= f64::from(EXCESS) {
                break;
            }
        }
        let left = self.compare_limits(rank)?;
        if left.worst > found.worst {
            self.state.set(rank.executor, before);
            return Ok(found.counted);
        }
        let mut end = RankState::clone(&before);
        let per_step = 1.0 / span.length_s as f32;
        let vertices = end.positions.as_chunks_mut::<DIM>().0.iter_mut().zip(end.velocities.as_chunks_mut::<DIM>().0);
        for ((x, v), way) in vertices.zip(&way) {
            *x = (Vec3::from(*x) + *way).to_array();
            *v = (Vec3::from(*v) + *way * per_step).to_array();
        }
        self.state.set(rank.executor, Rc::new(end));
        Ok(left.counted)
    }

    /// 1 / mass of every local row, 1/kg; 0 where a pin holds it.
    fn inverse_masses(&mut self, rank: &mut RankContext<'_>) -> Result<Vec<f32>, TransportError> {
        let masses = self.system.masses.host(rank.executor);
        let pinned = self.system.pinned.host(rank.executor);
        let inverse = |(mass, pinned): (&f32, &f32)| if *pinned == PRESCRIBED { 0.0 } else { 1.0 / mass };
        let own: Vec<f32> = masses.iter().zip(pinned.iter()).flat_map(|row| [inverse(row); DIM]).collect();
        Ok(self.of_local_rows(rank, &own)?.chunks_exact(DIM).map(|row| row[0]).collect())
    }

    /// Three values for every local row, from those that each rank has for its own.
    fn of_local_rows(&mut self, rank: &mut RankContext<'_>, own: &[f32]) -> Result<Vec<f32>, TransportError> {
        let executor: &Executor = rank.executor;
        let halo = self.solver.spmv.halo();
        let (first, rows) = (halo.plan().own.start, halo.plan().local_rows);
        let mut of_rows = DeviceVec::zeros(executor, rows * DIM);
        of_rows.write_range(executor, first * DIM, own);
        self.state.exchange_values(rank, halo, &mut of_rows)?;
        Ok(of_rows.host(rank.executor).into_owned())
    }
}

impl LimitCounts {
    /// True if a step has neither pulled a triangle back nor left one beyond its limit.
    pub(crate) fn are_none(&self) -> bool {
        *self == LimitCounts::default()
    }
}
