//! Queries of a simulation: its state, its memory, and the cause of a failed solve.

use super::{Failure, RankCloth, Simulation};
use crate::gpu::Executor;
use crate::model::{PlasticCounts, RankState};
use crate::scene::PreconditionerKind;
use crate::solver::PcgError;

impl Simulation {
    /// State of the own rows. It waits for the executor once if the state has changed since the last call.
    pub fn state(&self) -> RankState {
        let creases = self.cloth.elements.creases(&self.executor);
        let stretches = self.cloth.elements.stretches(&self.executor);
        let let_go = self.cloth.collisions.as_ref().map_or(Vec::new(), |collisions| collisions.let_go_of_rows());
        let holds = self.cloth.pins.holds();
        RankState { creases, stretches, let_go, holds, ..self.cloth.state.own(&self.executor).as_ref().clone() }
    }

    /// Numbers of creases and rest stretches in a state of this rank.
    pub fn plastic_counts(&self) -> PlasticCounts {
        self.cloth.elements.plastic_counts()
    }

    /// Drops everything but the executor, for another simulation.
    pub fn into_executor(self) -> Executor {
        self.executor
    }

    /// Bytes of device memory (on the cpu executor: of host memory).
    pub fn memory_bytes(&self) -> u64 {
        self.cloth.bytes()
    }

    /// The preconditioner in use.
    pub fn preconditioner(&self) -> PreconditionerKind {
        self.cloth.solver.preconditioner()
    }
}

impl RankCloth {
    /// Device bytes of everything but collisions.
    pub(super) fn bytes(&self) -> u64 {
        self.elements.bytes() + self.state.bytes() + self.system.bytes() + self.matrix.bytes() + self.solver.bytes()
    }

    /// Finds the vertex that caused a failed solve and names the usual causes.
    pub(super) fn explain(&self, executor: &Executor, step: u32, error: PcgError) -> Failure {
        let cause = match error {
            PcgError::Transport(error) => return error.into(),
            other => other.to_string(),
        };
        if let Some(fault) = executor.take_fault() {
            return Failure::in_step(step, fault);
        }
        let own = self.state.own(executor);
        let rhs = self.system.rhs.read(executor);
        let suspects = [
            ("position", &own.positions, "simulation.step_s or the start state"),
            ("velocity", &own.velocities, "simulation.step_s or air.wind"),
            ("force", &rhs, "fabric stiffness (stretching, bending) or simulation.step_s"),
        ];
        for (quantity, values, suspect) in suspects {
            if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                return Failure::NotFinite {
                    step,
                    row: (self.rows.start + at / 3) as u32,
                    quantity: quantity.into(),
                    cause,
                    suspect: suspect.into(),
                };
            }
        }
        Failure::Step { step, cause }
    }
}
