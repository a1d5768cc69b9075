//! Interconnect: topology file -> switch tree, work queues, schedules. Pure: no devices, no processes.

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
