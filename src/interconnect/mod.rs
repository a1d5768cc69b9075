//! Interconnect: topology file -> switch tree, work queues, schedules, modeled times. Pure: no devices, no processes.
//!
//! Rank r of a run sits on GPU r of the topology. Every time computed here is modeled from the topology file; nothing
//! in this folder measures anything. Each concept has one file:
//! - [`Topology`]: switches, GPUs and links (`topology.rs`, what it is made of in `parts.rs`, its file in
//!   `topology_file.rs`, rules in `validate.rs`, paths in `routing.rs`);
//! - [`fat_tree`], [`ring`], [`direct`], [`plan`]: work queues (`queues.rs`);
//! - [`check_schedule`], [`root_crossings`]: what every schedule must hold (`check.rs`);
//! - [`Program`]: the clock, transfers and kernels in virtual time (`clock.rs`; shared links in `network.rs`);
//! - [`TransferPlan`]: what one exchange moves (`transfers.rs`); [`modeled_cost`]: how long that takes (`cost.rs`);
//! - [`lower_bound`]: what no schedule beats (`bound.rs`, maximum flows in `flow.rs`);
//! - [`Pieces`] and schedule `best`: `synthesis.rs` tries chunked rings, rings over islands (`islands.rs`) and packed trees
//!   (`packing.rs`), put in order by `ordering.rs`;
//! - [`product_s`]: the matrix-vector product of the paper's Fig. 3 and Eqs. 6-9 (`product.rs`);
//! - [`RecordedStep`], [`replay()`]: recorded steps on another machine (`recorded.rs`, `replay.rs`);
//! - [`RankLinks`]: when messages arrive, for a transport that holds them back (`arrivals.rs`).

mod arrivals;
mod bound;
mod check;
mod clock;
mod cost;
mod flow;
mod islands;
mod network;
mod ordering;
mod packing;
mod parts;
mod pieces;
mod product;
mod queues;
mod recorded;
mod replay;
mod routing;
mod synthesis;
mod topology;
mod topology_error;
mod topology_file;
#[cfg(test)]
mod topology_tests;
mod transfers;
mod validate;
mod wire;

pub use arrivals::{Line, RankLinks, Receipt};
pub use bound::{LowerBound, demand_bound_s, lower_bound};
pub use check::{ScheduleFault, check_schedule, root_crossings};
pub use clock::{Circle, Milestone, Program, TaskTimes, Work};
pub use cost::{ScheduleCost, all_reduce_s, modeled_cost, pieces_cost, transfer_times};
pub use packing::Demand;
pub use parts::{DeviceModel, Duplex, Link, MAX_GPUS};
pub use pieces::{Piece, PieceFault, Pieces};
pub use product::{ProductKernels, add_product, product_s};
pub use queues::{Plan, ScheduleError, ScheduleKind, candidates, direct, fat_tree, plan, ring};
pub use recorded::{Kernel, Phase, RecordFault, RecordedProduct, RecordedStep, Traffic};
pub use replay::{KernelTimes, ProductExchange, Replay, ReplaySpan, ReplayedStep, STAGES, replay};
pub use routing::Hop;
pub use topology::Topology;
pub use topology_error::TopologyError;
pub use transfers::{Transfer, TransferPlan};
pub use wire::{Crossing, crossing};

/// One entry of a work queue: in its stage the queue's rank receives sub-vector `vector` from rank `source`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct QueueNode {
    /// Rank that hands the sub-vector over; it holds it before the stage begins.
    pub source: usize,
    /// Index of the sub-vector (= rank that owns it).
    pub vector: usize,
}

/// The work queues of all ranks: `queues[rank][stage]` [Li et al. 2020, Sec. 3.1.2].
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Schedule {
    /// Number of ranks, one per GPU.
    pub gpus: usize,
    /// One queue per rank, each with one node per stage (`gpus - 1` of them).
    pub queues: Vec<Vec<QueueNode>>,
}

impl Schedule {
    /// Number of transfer stages: one less than ranks, none for a single rank.
    pub fn stages(&self) -> usize {
        self.gpus.saturating_sub(1)
    }
}
