//! Plastic bending at the end of a step (`forces::crease`). Cloth without plastic fabrics has no work here.
//!
//! A rank moves all hinges that touch its rows, those that it shares with others as they do, from the same positions.

use super::elements::Elements;
use super::{Failure, RankCloth, StepStats};
use crate::context::RankContext;
use crate::forces::HingeElement;
use crate::gpu::Executor;
use crate::model::Crease;
use crate::step::stats::StageClock;
use crate::telemetry::{Activity, EventName};

impl RankCloth {
    /// Moves the angles at rest of hinges that bend beyond their yield curvature.
    pub(super) fn crease(&mut self, rank: &mut RankContext<'_>, stats: &mut StepStats) -> Result<(), Failure> {
        if !self.elements.is_plastic() {
            return Ok(());
        }
        let clock = StageClock::start();
        self.state.exchange(rank, self.solver.spmv.halo())?;
        let start = rank.recorder.before_kernels();
        self.elements.crease(rank.executor, &self.state.positions);
        let bytes = self.elements.hinges.bytes();
        rank.recorder.end(
            EventName::Elements,
            Activity::Compute,
            start,
            2 * bytes,
            self.elements.hinges.len() as u64 * 90,
        );
        clock.lap_kernels(rank.executor, &mut stats.seconds.elements);
        Ok(())
    }
}

impl Elements {
    /// The crease of every hinge; none if no fabric is plastic.
    pub(super) fn creases(&self, executor: &Executor) -> Vec<Crease> {
        if !self.is_plastic() {
            return Vec::new();
        }
        self.hinges.host(executor)[..self.bends()].iter().map(HingeElement::crease).collect()
    }

    /// Number of [`Elements::creases`].
    pub(super) fn crease_count(&self) -> usize {
        if self.is_plastic() { self.bends() } else { 0 }
    }

    /// Sets the crease of every hinge.
    pub(super) fn set_creases(&mut self, executor: &Executor, creases: &[Crease]) {
        assert_eq!(creases.len(), self.crease_count(), "creases of a state of this rank");
        if creases.is_empty() {
            return;
        }
        let mut hinges = self.hinges.read(executor);
        hinges.iter_mut().zip(creases).for_each(|(hinge, &crease)| hinge.set_crease(crease));
        self.hinges.write_range(executor, 0, &hinges);
    }
}
