//! Messages between coordinator and workers. Headers are small. Bulk data (elements, positions, events) follows as
//! arrays that are not serialized (`transport::message`).

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

use crate::interconnect::RankLinks;
use crate::linear_system::{RankSystem, SolveParams, SolveRecord, SolveStats};
use crate::model::RankModel;
use crate::step::{ExchangePlan, Failure, Guidance, StepStats};

/// Executor that a worker uses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ExecutorChoice {
    /// A hardware GPU if there is one, otherwise native code.
    #[default]
    Auto,
    /// A GPU adapter, software ones included.
    Gpu,
    /// Native code.
    Cpu,
}

/// Whether ranks that share cores are pinned to one core each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum BindCores {
    /// Workers with one thread that share fewer cores evenly are pinned.
    #[default]
    Auto,
    /// The system places the threads.
    Never,
}

/// Setup of a worker.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct WorkerSetup {
    /// Executor.
    pub executor: ExecutorChoice,
    /// Adapter of the gpu executor; none: rank modulo the number of adapters.
    pub adapter: Option<usize>,
    /// Threads of the cpu executor.
    pub threads: usize,
    /// Whether it may be pinned to one core.
    pub bind_cores: BindCores,
    /// Number of ranks.
    pub ranks: usize,
    /// Index of this rank among the ranks of all sessions side by side on its machine. Adapters and cores are assigned
    /// in this order.
    pub place: usize,
    /// Ranks of all sessions side by side on its machine.
    pub places: usize,
    /// Number of the connection of the data ports. When it changes, all ranks drop their ports and connect again.
    pub epoch: u32,
    /// Longest message between ranks, in values.
    pub max_message_values: usize,
    /// Longest wait for another rank, seconds.
    pub patience_s: f64,
    /// Links that the transport emulates; their time stamps are part of `max_message_values`.
    pub links: Option<RankLinks>,
}

/// Step in the heartbeat of a worker that solves a linear system.
pub const SOLVING: u64 = u64::MAX;
/// Step in the heartbeat of a worker that connects to the others, and until its first step.
pub const CONNECTING: u64 = u64::MAX - 1;

/// Coordinator -> worker.
#[allow(missing_docs, reason = "the line of a variant says what it carries")]
#[derive(Debug, Serialize, Deserialize)]
pub enum ToWorker {
    /// Be this rank of a simulation from now on, in the start state of its scene (step 0); arrays: those of the model.
    /// May be sent again, also with another mesh.
    Load { setup: WorkerSetup, exchange: ExchangePlan, model: Box<RankModel> },
    /// Be this rank of a linear solve and answer [`ToCoordinator::Solved`]; arrays: those of the system.
    Solve { setup: WorkerSetup, exchange: ExchangePlan, params: SolveParams, system: Box<RankSystem> },
    /// Continue from this state of the own rows, that of step `step`; arrays: [`crate::model::RankState::to_bytes`].
    SetState { step: u32 },
    /// Advance to this step, which must be the one after that of the state.
    Step { step: u32, record: bool },
    /// As `Step`, drawn toward a guide; arrays: positions of the own rows at the start and at the end of its motion.
    GuidedStep { step: u32, record: bool, guidance: Guidance },
    /// As `Step`, straight to this state of the own rows; arrays: [`crate::model::RankState::to_bytes`]. If the way is
    /// not free the answer says so, and the state stays that of the step before.
    Arrive { step: u32, record: bool },
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
    /// A linear solve is done; arrays: the solution on the own rows, f64, and the recorded events.
    Solved { stats: SolveStats, executor: String, record: SolveRecord },
    /// This rank cannot continue.
    Failed(Failure),
}

/// Report of a worker after its setup.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct WorkerReady {
    /// `cpu` or `gpu`.
    pub executor: String,
    /// Device name.
    pub device: String,
    /// Slots of its matrix divided by stored blocks.
    pub padding_ratio: f64,
    /// Unix time of the zero of its event clock, nanoseconds.
    pub epoch_unix_ns: u64,
    /// Bytes of device memory.
    pub memory_bytes: u64,
    /// Preconditioner in use.
    pub preconditioner: crate::scene::PreconditionerKind,
}
