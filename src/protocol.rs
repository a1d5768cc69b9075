//! Messages between coordinator and workers. Headers are small; bulk data (elements, positions, events) travels beside
//! them as arrays that no serializer touches (`transport::message`).

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

use crate::interconnect::RankLinks;
use crate::linear_system::{RankSystem, SolveParams, SolveRecord, SolveStats};
use crate::model::RankModel;
use crate::step::{ExchangePlan, Failure, StepStats};

/// Which executor a worker uses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ExecutorChoice {
    /// A hardware GPU where there is one, else native code.
    #[default]
    Auto,
    /// A GPU adapter, software ones included.
    Gpu,
    /// Native code.
    Cpu,
}

/// Whether ranks that share cores keep to one each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum BindCores {
    /// Workers of one thread that share fewer cores evenly do.
    #[default]
    Auto,
    /// The system decides.
    Never,
}

/// How a worker sets itself up.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct WorkerSetup {
    /// Executor.
    pub executor: ExecutorChoice,
    /// Adapter of the gpu executor; none: rank modulo the number of adapters.
    pub adapter: Option<usize>,
    /// Threads of the cpu executor.
    pub threads: usize,
    /// Whether it may keep to one core.
    pub bind_cores: BindCores,
    /// Number of ranks.
    pub ranks: usize,
    /// Place of rank 0 among the ranks of all sessions side by side: adapters and cores are handed out in that order.
    pub first_place: usize,
    /// Ranks of all sessions side by side.
    pub places: usize,
    /// Number of the data ports: another one than before says that all ranks give theirs up and connect anew.
    pub epoch: u32,
    /// Longest message between ranks, values.
    pub max_message_values: usize,
    /// Longest wait for another rank, seconds.
    pub patience_s: f64,
    /// Links that the transport emulates; their stamps are part of `max_message_values`.
    pub links: Option<RankLinks>,
}

/// Step in the heartbeat of a worker that solves a linear system.
pub const SOLVING: u64 = u64::MAX;

/// Coordinator -> worker.
#[allow(missing_docs, reason = "the line of a variant says what it carries")]
#[derive(Debug, Serialize, Deserialize)]
pub enum ToWorker {
    /// Be this rank of a simulation from now on, in the state that its scene starts in (step 0); arrays: those of the
    /// model. May come again, also with another mesh.
    Load { setup: WorkerSetup, exchange: ExchangePlan, model: Box<RankModel> },
    /// Be this rank of a linear solve and answer [`ToCoordinator::Solved`]; arrays: those of the system.
    Solve { setup: WorkerSetup, exchange: ExchangePlan, params: SolveParams, system: Box<RankSystem> },
    /// Go on from this state of the own rows, that of step `step`; arrays: [`crate::model::RankState::to_bytes`].
    SetState { step: u32 },
    /// Advance to this step, which must be the one after that of the state.
    Step { step: u32, record: bool },
    /// Send the state of the own rows.
    SendState,
    /// Leave.
    Stop,
}

/// Worker -> coordinator.
#[allow(missing_docs, reason = "the line of a variant says what it carries")]
#[derive(Debug, Serialize, Deserialize)]
pub enum ToCoordinator {
    /// Set up and connected to all other ranks.
    Ready(WorkerReady),
    /// A step is done; arrays: its events, if they were recorded.
    StepDone(Box<StepStats>),
    /// Arrays: [`crate::model::RankState::to_bytes`] of the own rows.
    State,
    /// A linear solve is done; arrays: the solution on the own rows, f64, and the record's events.
    Solved { stats: SolveStats, executor: String, record: SolveRecord },
    /// This rank cannot go on.
    Failed(Failure),
}

/// What a worker says of itself once it is set up.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct WorkerReady {
    /// `cpu` or `gpu`.
    pub executor: String,
    /// Device name.
    pub device: String,
    /// Slots over stored blocks of its matrix.
    pub padding_ratio: f64,
    /// Unix time of its event clock's zero, nanoseconds.
    pub epoch_unix_ns: u64,
    /// Bytes of device memory.
    pub memory_bytes: u64,
    /// Preconditioner in use.
    pub preconditioner: crate::scene::PreconditionerKind,
}
