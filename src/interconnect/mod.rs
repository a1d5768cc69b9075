//! Interconnect: topology file -> switch tree, work queues, schedules. Pure: no devices, no processes.
//!
//! Rank r of a run sits on GPU r of the topology. Every time computed here is modelled from the topology file; nothing
//! in this folder measures anything. Each concept has one file:
//! - [`Topology`]: switches, GPUs and links (`topology.rs`, its file in `topology_file.rs`, rules in `validate.rs`,
//!   paths in `routing.rs`);
//! - [`fat_tree`], [`ring`], [`direct`], [`plan`]: work queues (`queues.rs`);
//! - [`check_schedule`], [`root_crossings`]: what every schedule must hold (`check.rs`);
//! - [`modelled_cost`]: stage times under link contention (`cost.rs`).

mod check;
mod cost;
mod queues;
mod routing;
mod topology;
mod topology_file;
#[cfg(test)]
mod topology_tests;
mod validate;

pub use check::{ScheduleFault, check_schedule, root_crossings};
pub use cost::{ScheduleCost, modelled_cost};
pub use queues::{Plan, ScheduleError, ScheduleKind, candidates, direct, fat_tree, plan, ring};
pub use routing::Hop;
pub use topology::{DeviceModel, Duplex, Link, MAX_GPUS, Topology};
pub use topology_file::TopologyError;

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
    /// Number of ranks.
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
