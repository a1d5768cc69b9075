//! What others may ask a simulation: its state, its memory, and why a solve failed.

use super::{Failure, Simulation};
use crate::gpu::Executor;
use crate::model::RankState;
use crate::scene::PreconditionerKind;
use crate::solver::PcgError;
use crate::solver::comparison::MatrixFree;

impl Simulation {
    /// State of the own rows; one wait for the executor if it has changed since the last time.
    pub fn state(&self) -> RankState {
        self.own_state().as_ref().clone()
    }

    /// Gives all of it up but the executor, for another simulation.
    pub fn into_executor(self) -> Executor {
        self.executor
    }

    /// Bytes of device memory (on the cpu executor: of host memory).
    pub fn memory_bytes(&self) -> u64 {
        self.fabrics.bytes()
            + self.triangles.bytes()
            + self.hinges.bytes()
            + self.triangle_records.bytes()
            + self.hinge_records.bytes()
            + self.masses.bytes()
            + self.pinned.bytes()
            + self.positions.bytes()
            + self.velocities.bytes()
            + self.fill_tables.bytes()
            + self.matrix.bytes()
            + self.contacts.bytes()
            + self.rhs.bytes()
            + self.inverse_diagonal.bytes()
            + self.solver.bytes()
            + self.matrix_free.as_ref().map_or(0, MatrixFree::bytes)
    }

    /// The preconditioner in use.
    pub fn preconditioner(&self) -> PreconditionerKind {
        self.solver.preconditioner()
    }

    /// Finds the vertex behind a failed solve and names what usually causes it.
    pub(super) fn explain(&self, step: u32, error: PcgError) -> Failure {
        let cause = match error {
            PcgError::Transport(error) => return error.into(),
            other => other.to_string(),
        };
        if let Some(fault) = self.executor.take_fault() {
            return Failure::in_step(step, fault);
        }
        let own = self.own_state();
        let rhs = self.rhs.read(&self.executor);
        let suspects = [
            ("position", &own.positions, "simulation.step_s or the start state"),
            ("velocity", &own.velocities, "simulation.step_s or air.wind"),
            ("force", &rhs, "fabric stiffness (stretching, bending) or simulation.step_s"),
        ];
        for (quantity, values, suspect) in suspects {
            if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                return Failure::NotFinite {
                    step,
                    row: (self.rows_start + at / 3) as u32,
                    quantity: quantity.into(),
                    cause,
                    suspect: suspect.into(),
                };
            }
        }
        Failure::Step { step, cause }
    }
}
