//! A step that is drawn toward a given motion, the guide: how the seams of a shot that is split in time are closed, and
//! how a segment finds its way from the state of a coarse run (`time_parallel`).
//!
//! The guide acts as one more force in the implicit system, alpha m (v* - v) on every row, where v* is the velocity of
//! the guide plus what makes up for the distance from it. Internal forces, contacts and impact zones act as ever and
//! have the last word. alpha = w / (1 - w): without any other force the cloth gets the share w of v*.

use std::rc::Rc;

use super::collisions::{Limits, Resolved};
use super::guidance::{Guide, Guided};
use super::span::Span;
use super::stats::{StageClock, StepStats};
use super::{Failure, RankCloth, Simulation};
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor};
use crate::math::DIM;
use crate::model::RankState;
use crate::transport::Transport;

impl Simulation {
    /// As [`Simulation::step`], drawn toward `guide`.
    pub fn guided_step(
        &mut self,
        transport: &mut dyn Transport,
        step: u32,
        record: bool,
        guide: Guide,
    ) -> Result<StepStats, Failure> {
        let span = Span::of_step(step, self.cloth.settings.step_s);
        let guidance = guide.guidance;
        self.cloth.take_guide(&self.executor, span, guide);
        let done = self.step(transport, step, record);
        self.cloth.drop_guide();
        done.map(|stats| StepStats { guidance: Some(guidance), ..stats })
    }

    /// Step `step` as a motion that is given from its start to its end, `target`, the own rows of a state. It counts
    /// only if the straight way there is free of penetrations; otherwise the state stays as it is, and `arrived` of the
    /// result is false.
    pub fn arrive(
        &mut self,
        transport: &mut dyn Transport,
        step: u32,
        record: bool,
        target: RankState,
    ) -> Result<StepStats, Failure> {
        self.recorder.begin_step(step, record);
        let clock = StageClock::start();
        let span = Span::of_step(step, self.cloth.settings.step_s);
        let mut stats = StepStats { step, converged: true, arrived: Some(true), ..StepStats::default() };
        let mut rank = RankContext { executor: &self.executor, transport, recorder: &mut self.recorder };
        let free = self.cloth.is_free_way(&mut rank, span, &target, &mut stats)?;
        if free {
            self.set_state(target);
        }
        if let Some(fault) = self.executor.take_fault() {
            return Err(Failure::in_step(step, fault));
        }
        stats.arrived = Some(free);
        stats.seconds.total = clock.total();
        stats.memory_bytes = self.memory_bytes();
        Ok(stats)
    }
}

impl RankCloth {
    fn take_guide(&mut self, executor: &Executor, step: Span, guide: Guide) {
        let values = self.rows.len() * DIM;
        assert_eq!((guide.start.len(), guide.end.len()), (values, values), "a guide of the own rows");
        let weight = guide.guidance.weight;
        assert!((0.0..1.0).contains(&weight), "a weight from 0 to below 1");
        let pull = weight / (1.0 - weight);
        let masses = self.system.masses.read(executor);
        let scaled = |factor: f64| {
            let all: Vec<f32> = masses.iter().map(|&mass| (f64::from(mass) * factor) as f32).collect();
            DeviceVec::upload(executor, &all)
        };
        let masses = std::mem::replace(&mut self.system.masses, scaled(1.0 + pull));
        self.guided = Some(Guided { guide, step, pull, pulled: scaled(pull), masses, wanted: vec![0.0; values] });
    }

    fn drop_guide(&mut self) {
        if let Some(guided) = self.guided.take() {
            self.system.masses = guided.masses;
        }
    }

    /// Factor on gravity in a system whose masses hold alpha m besides m.
    pub(super) fn gravity_share(&self) -> f32 {
        self.guided.as_ref().map_or(1.0, |guided| (1.0 / (1.0 + guided.pull)) as f32)
    }

    /// The velocity that the guide asks for over `span`, which starts where the state is.
    pub(super) fn aim(&mut self, rank: &mut RankContext<'_>, span: Span) {
        let Some(guided) = &mut self.guided else { return };
        let own = self.state.recorded(rank);
        let part = |time_s: f64| ((time_s - guided.step.start_s) / guided.step.length_s).clamp(0.0, 1.0);
        let (from, to) = (part(span.start_s), part(span.end_s));
        // The distance shrinks by the same factor in every equal part of the step.
        let closed = 1.0 - guided.guide.guidance.distance_left.powf(to - from);
        let ends = guided.guide.start.iter().zip(&guided.guide.end);
        for ((wanted, x), (&start, &end)) in guided.wanted.iter_mut().zip(&own.positions).zip(ends) {
            let (start, way) = (f64::from(start), f64::from(end) - f64::from(start));
            let distance = start + from * way - f64::from(*x);
            *wanted = (((to - from) * way + closed * distance) / span.length_s) as f32;
        }
    }

    /// rhs += alpha m (v* - v), after the system was filled at the velocities that the state holds.
    pub(super) fn pull_along(&mut self, rank: &mut RankContext<'_>) {
        let Some(guided) = &self.guided else { return };
        let own = self.state.recorded(rank);
        let missing: Vec<f32> = own.velocities.iter().zip(&guided.wanted).map(|(v, wanted)| v - wanted).collect();
        let missing = DeviceVec::upload(rank.executor, &missing);
        self.inertia.apply(rank.executor, &guided.pulled, &missing, &mut self.system.rhs);
    }

    /// Whether the straight way from the state to `target` is free of penetrations.
    fn is_free_way(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        target: &RankState,
        stats: &mut StepStats,
    ) -> Result<bool, Failure> {
        let before = self.state.recorded(rank);
        self.move_pins(rank, span)?;
        self.find_contacts(rank, span, stats)?;
        let Some(collisions) = &mut self.collisions else { return Ok(true) };
        // No rounds of impact zones: any impact ends the attempt, on all ranks alike.
        let limits = Limits { rounds_most: 0, at_last: false };
        let free = match collisions.resolve(rank, &target.positions, span, limits, stats)? {
            Resolved::Free(_) => true,
            Resolved::Slow | Resolved::Squeezed(_) | Resolved::LetGo => false,
        };
        self.state.set(rank.executor, Rc::clone(&before));
        Ok(free)
    }
}
