//! Plastic bending and stretching at the end of a step (`forces::crease`, `forces::plastic_stretch`). Cloth without
//! plastic fabrics has no work here.
//!
//! A rank moves all elements that touch its rows, those that it shares with others as they do, from the same positions.

use super::elements::Elements;
use super::{Failure, RankCloth, StepStats};
use crate::context::RankContext;
use crate::forces::HingeElement;
use crate::forces::plastic_stretch::PlasticTriangle;
use crate::gpu::Executor;
use crate::model::{Crease, PlasticCounts, RankState, RestStretch};
use crate::step::stats::StageClock;
use crate::telemetry::{Activity, EventName};

impl RankCloth {
    /// Moves the angles at rest of hinges that bend beyond their yield curvature, and the shapes at rest of triangles
    /// that stretch beyond their yield strain.
    pub(super) fn yield_beyond(&mut self, rank: &mut RankContext<'_>, stats: &mut StepStats) -> Result<(), Failure> {
        if !self.elements.is_plastic() {
            return Ok(());
        }
        let clock = StageClock::start();
        self.state.exchange(rank, self.solver.spmv.halo())?;
        let start = rank.recorder.before_kernels();
        self.elements.yield_beyond(rank.executor, &self.state.positions);
        let bytes = self.elements.plastic_bytes();
        rank.recorder.end(EventName::Elements, Activity::Compute, start, 2 * bytes, bytes * 2);
        self.take_rest_shapes(rank.executor);
        clock.lap_kernels(rank.executor, &mut stats.seconds.elements);
        Ok(())
    }

    /// Strain limits count from the shapes at rest as they are now.
    pub(super) fn take_rest_shapes(&mut self, executor: &Executor) {
        if let Some(limited) = self.limited.as_mut().filter(|_| self.elements.stretch_count() > 0) {
            limited.take_rest_shapes(&self.elements.triangles.host(executor));
        }
    }
}

impl Elements {
    /// The crease of every hinge; none if the folds of no fabric stay.
    pub(super) fn creases(&self, executor: &Executor) -> Vec<Crease> {
        if self.crease_count() == 0 {
            return Vec::new();
        }
        self.hinges.host(executor)[..self.bends()].iter().map(HingeElement::crease).collect()
    }

    /// The rest stretch of every triangle; none if no fabric stays stretched.
    pub(super) fn stretches(&self, executor: &Executor) -> Vec<RestStretch> {
        if self.stretch_count() == 0 {
            return Vec::new();
        }
        self.plastic_triangles.host(executor).iter().map(PlasticTriangle::state).collect()
    }

    /// Numbers of [`Elements::creases`] and [`Elements::stretches`].
    pub(super) fn plastic_counts(&self) -> PlasticCounts {
        PlasticCounts { creases: self.crease_count(), stretches: self.stretch_count() }
    }

    /// Sets the creases and rest stretches of all elements to those of `state`.
    pub(super) fn set_plastic(&mut self, executor: &Executor, state: &RankState) {
        let (creases, stretches) = (&state.creases, &state.stretches);
        assert_eq!(
            (creases.len(), stretches.len()),
            (self.crease_count(), self.stretch_count()),
            "a state of this rank"
        );
        if !creases.is_empty() {
            let mut hinges = self.hinges.read(executor);
            hinges.iter_mut().zip(creases).for_each(|(hinge, &crease)| hinge.set_crease(crease));
            self.hinges.write_range(executor, 0, &hinges);
        }
        if !stretches.is_empty() {
            let mut triangles = self.plastic_triangles.read(executor);
            triangles.iter_mut().zip(stretches).for_each(|(triangle, &stretch)| triangle.set_state(stretch));
            self.plastic_triangles.write_range(executor, 0, &triangles);
        }
        self.take_up_plastic(executor);
    }
}
