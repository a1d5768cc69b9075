//! Modeled time of a schedule on a topology, by the clock (`clock.rs`). A model, not a measurement: no protocol
//! overhead and no compute.
//!
//! Every rank receives in the order of its queue: a transfer starts when the one before it in the queue has arrived and its
//! source holds the sub-vector, like copies in one stream. Stages are not separated by a barrier. With pieces
//! (`pieces.rs`) every lane of a rank is such a queue, but the next piece is posted ahead: it follows as soon as the links
//! are free, so that latencies overlap.

use super::Schedule;
use super::clock::{Program, TaskTimes};
use super::network::Channels;
use super::pieces::Pieces;
use super::topology::Topology;
use super::transfers::TransferPlan;

/// Modeled times of a schedule, seconds.
#[derive(Clone, Debug, PartialEq)]
pub struct ScheduleCost {
    /// How much later than every rank's stage s - 1 every rank's stage s is complete; the first counts from the start.
    pub stage_s: Vec<f64>,
    /// When every rank holds everything.
    pub total_s: f64,
}

/// Modeled cost of `schedule` on `topology` if every sub-vector has `sub_vector_bytes` bytes.
///
/// Nodes that name ranks that the topology does not have cost nothing, and a schedule whose ranks wait for each other in a
/// circle costs infinity; [`super::check_schedule`] finds both.
pub fn modeled_cost(schedule: &Schedule, topology: &Topology, sub_vector_bytes: f64) -> ScheduleCost {
    let mut plan = TransferPlan::of_schedule(schedule, sub_vector_bytes);
    plan.queues.truncate(topology.gpus());
    plan.queues.iter_mut().for_each(|queue| queue.retain(|transfer| transfer.source < topology.gpus()));
    let spans = transfer_times(&plan, topology);
    let stages = spans.iter().map(Vec::len).max().unwrap_or(0);
    let of_stage = |stage: usize| spans.iter().filter_map(move |queue| queue.get(stage)).map(|span| span.done_s);
    ScheduleCost::of_stages((0..stages).map(|stage| of_stage(stage).fold(0.0, f64::max)).collect())
}

/// Modeled cost of moving every sub-vector in pieces.
pub fn pieces_cost(pieces: &Pieces, topology: &Topology, sub_vector_bytes: f64) -> ScheduleCost {
    let gpus = topology.gpus();
    let spans = transfer_times(&TransferPlan::of_pieces(pieces, sub_vector_bytes), topology);
    // When a rank holds all of its k-th sub-vector; its own one is there from the start.
    let mut whole_s = vec![vec![0.0f64; gpus]; gpus];
    for (rank, (queue, spans)) in pieces.queues.iter().zip(&spans).enumerate() {
        for (piece, span) in queue.iter().zip(spans) {
            let at_s = &mut whole_s[rank][piece.vector];
            *at_s = at_s.max(span.done_s);
        }
        whole_s[rank].sort_by(f64::total_cmp);
    }
    ScheduleCost::of_stages((1..gpus).map(|k| whole_s.iter().map(|times| times[k]).fold(0.0, f64::max)).collect())
}

/// Bytes that a rank contributes to a reduction: at most 54 numbers (`solver/reduction.rs`).
pub(super) const REDUCTION_BYTES: f64 = 54.0 * 8.0;

/// Modeled time of an all-reduce from the moment at which the last rank has reached it: the longest path's latency, and
/// the numbers of all ranks over the narrowest link. Nothing for a single rank.
pub fn all_reduce_s(topology: &Topology) -> f64 {
    all_reduce_on(&Channels::of(topology), topology.gpus())
}

pub(super) fn all_reduce_on(channels: &Channels, ranks: usize) -> f64 {
    if ranks < 2 {
        return 0.0;
    }
    let pairs = || (0..ranks).flat_map(|from| (0..ranks).map(move |to| (from, to))).filter(|(from, to)| from != to);
    let latency_s = pairs().map(|(from, to)| channels.latency_s(from, to)).fold(0.0, f64::max);
    let narrowest = channels.capacity.iter().copied().fold(f64::INFINITY, f64::min);
    latency_s + ranks as f64 * REDUCTION_BYTES / narrowest
}

/// When every transfer of every rank is under way, in the order of its queue; never if transfers wait in a circle.
pub fn transfer_times(plan: &TransferPlan, topology: &Topology) -> Vec<Vec<TaskTimes>> {
    let mut program = Program::default();
    let tasks = plan.add_to(&mut program, None);
    let spans = program.run(topology).unwrap_or_else(|_| vec![TaskTimes::NEVER; program.len()]);
    tasks.iter().map(|queue| queue.iter().map(|&task| spans[task]).collect()).collect()
}

impl ScheduleCost {
    /// `complete_s[s]`: when stage s is complete on every rank.
    fn of_stages(complete_s: Vec<f64>) -> ScheduleCost {
        let mut before_s = 0.0f64;
        let step = |at_s: &f64| {
            let later_s = at_s.max(before_s);
            // Infinity less infinity is NaN.
            let took_s = if later_s == before_s { 0.0 } else { later_s - before_s };
            before_s = later_s;
            took_s
        };
        let stage_s = complete_s.iter().map(step).collect();
        ScheduleCost { stage_s, total_s: before_s }
    }
}
