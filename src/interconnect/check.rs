//! Checks the rules of schedules by walking through the stages, and counts the crossings of the root of a tree.

use super::Schedule;
use super::topology::Topology;

/// The first rule that a schedule breaks. Stages count from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ScheduleFault {
    /// The schedule does not have one queue per rank.
    #[error("a schedule for {gpus} GPUs needs {gpus} queues and has {queues}")]
    QueueCount {
        /// Number of ranks.
        gpus: usize,
        /// Number of queues in the schedule.
        queues: usize,
    },
    /// A queue does not have one node per other rank.
    #[error("the queue of rank {rank} needs {expected} stages and has {stages}")]
    StageCount {
        /// Rank whose queue it is.
        rank: usize,
        /// Number of ranks less one.
        expected: usize,
        /// Number of nodes in the queue.
        stages: usize,
    },
    /// A node names a rank that does not exist.
    #[error("in stage {stage} rank {rank} receives v{vector} from rank {source_rank}, but there are only {gpus} ranks")]
    NoSuchRank {
        /// Stage of the node, counted from 1.
        stage: usize,
        /// Rank that receives.
        rank: usize,
        /// Rank that sends.
        source_rank: usize,
        /// Index of the sub-vector.
        vector: usize,
        /// Number of ranks.
        gpus: usize,
    },
    /// A rank sends to two others at once.
    #[error("in stage {stage} rank {source_rank} sends twice")]
    SendsTwice {
        /// Stage of the node, counted from 1.
        stage: usize,
        /// Rank that sends.
        source_rank: usize,
    },
    /// The sender has not received what it should hand on.
    #[error(
        "in stage {stage} rank {rank} should receive v{vector} from rank {source_rank}, which does not hold it yet"
    )]
    NotHeld {
        /// Stage of the node, counted from 1.
        stage: usize,
        /// Rank that receives.
        rank: usize,
        /// Rank that sends.
        source_rank: usize,
        /// Index of the sub-vector.
        vector: usize,
    },
    /// The receiver owns the sub-vector or received it before.
    #[error("in stage {stage} rank {rank} receives v{vector}, which it already holds")]
    ReceivedTwice {
        /// Stage of the node, counted from 1.
        stage: usize,
        /// Rank that receives.
        rank: usize,
        /// Index of the sub-vector.
        vector: usize,
    },
}

/// Checks that a schedule can be carried out and leaves every rank with every sub-vector: n-1 stages, one receive and
/// one send per rank and stage, every source holds what it sends when the stage begins, nothing is received twice.
pub fn check_schedule(schedule: &Schedule) -> Result<(), ScheduleFault> {
    let gpus = schedule.gpus;
    if schedule.queues.len() != gpus {
        return Err(ScheduleFault::QueueCount { gpus, queues: schedule.queues.len() });
    }
    for (rank, queue) in schedule.queues.iter().enumerate() {
        if queue.len() != schedule.stages() {
            return Err(ScheduleFault::StageCount { rank, expected: schedule.stages(), stages: queue.len() });
        }
    }
    let mut holds = vec![vec![false; gpus]; gpus];
    for (rank, held) in holds.iter_mut().enumerate() {
        held[rank] = true;
    }
    for stage in 1..=schedule.stages() {
        let before = holds.clone();
        let mut sends = vec![false; gpus];
        for (rank, queue) in schedule.queues.iter().enumerate() {
            let (source_rank, vector) = (queue[stage - 1].source, queue[stage - 1].vector);
            if source_rank >= gpus || vector >= gpus {
                return Err(ScheduleFault::NoSuchRank { stage, rank, source_rank, vector, gpus });
            }
            if std::mem::replace(&mut sends[source_rank], true) {
                return Err(ScheduleFault::SendsTwice { stage, source_rank });
            }
            if !before[source_rank][vector] {
                return Err(ScheduleFault::NotHeld { stage, rank, source_rank, vector });
            }
            if std::mem::replace(&mut holds[rank][vector], true) {
                return Err(ScheduleFault::ReceivedTwice { stage, rank, vector });
            }
        }
    }
    // n-1 different sub-vectors besides the own one are all of them.
    Ok(())
}

/// The sub-vectors that cross the root switch in each stage (`[stage][crossing]`, in order of the receiving rank).
/// None if the topology is not a tree with a switch at its root, or does not have the schedule's number of ranks.
pub fn root_crossings(schedule: &Schedule, topology: &Topology) -> Option<Vec<Vec<usize>>> {
    let root = topology.root().filter(|_| topology.is_tree() && schedule.gpus == topology.gpus())?;
    let crosses = |source: usize, rank: usize| {
        topology.path(source, rank).iter().any(|hop| topology.links()[hop.link].ends.contains(&root))
    };
    let stage_crossings = |stage: usize| {
        let nodes = schedule.queues.iter().enumerate().filter_map(|(rank, queue)| Some((rank, queue.get(stage)?)));
        nodes
            .filter(|(rank, node)| node.source < schedule.gpus && *rank < schedule.gpus && crosses(node.source, *rank))
            .map(|(_, node)| node.vector)
            .collect()
    };
    Some((0..schedule.stages()).map(stage_crossings).collect())
}
