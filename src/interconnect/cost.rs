//! Modelled cost of a schedule on a topology: stage by stage, with contention on links. A model, not a measurement: no
//! protocol overhead, no compute, all transfers of a stage start together and the next stage begins when all are done.

use std::collections::HashMap;

use super::Schedule;
use super::topology::{Duplex, Topology};

/// Modelled times of a schedule, seconds.
#[derive(Clone, Debug, PartialEq)]
pub struct ScheduleCost {
    /// Time of every stage, seconds.
    pub stage_s: Vec<f64>,
    /// Sum of the stages, seconds.
    pub total_s: f64,
}

/// What the transfers of one stage put on one channel (a direction of a link, or a whole half-duplex link).
#[derive(Clone, Copy, Default)]
struct Load {
    transfers: usize,
    latency_s: f64,
}

/// Modelled cost of `schedule` on `topology` if every sub-vector has `sub_vector_bytes` bytes.
///
/// A transfer occupies every link of its path in its direction; a half-duplex link counts both directions as one.
/// With B = bytes of a sub-vector, k_l = transfers of the stage on link l, w_l = its bandwidth and L_l = the longest
/// sum of latencies over the path of a transfer that uses l:
///
/// ```text
/// stage = max over links l of (L_l + k_l * B / w_l),    total = sum over stages
/// ```
///
/// Transfers of ranks that the topology does not have are not on any of its links and cost nothing;
/// [`super::check_schedule`] finds such schedules.
pub fn modelled_cost(schedule: &Schedule, topology: &Topology, sub_vector_bytes: f64) -> ScheduleCost {
    let stages = schedule.queues.iter().map(Vec::len).max().unwrap_or(0);
    let stage_s: Vec<f64> =
        (0..stages).map(|stage| stage_cost_s(schedule, topology, sub_vector_bytes, stage)).collect();
    let total_s = stage_s.iter().sum();
    ScheduleCost { stage_s, total_s }
}

fn stage_cost_s(schedule: &Schedule, topology: &Topology, sub_vector_bytes: f64, stage: usize) -> f64 {
    let links = topology.links();
    let mut loads: HashMap<(usize, bool), Load> = HashMap::new();
    for (rank, queue) in schedule.queues.iter().enumerate() {
        let Some(node) = queue.get(stage) else { continue };
        if rank >= topology.gpus() || node.source >= topology.gpus() {
            continue;
        }
        let path = topology.path(node.source, rank);
        let latency_s = path.iter().map(|hop| links[hop.link].latency_us * 1e-6).sum();
        for hop in path {
            let direction = hop.forward || links[hop.link].duplex == Duplex::Half;
            let load = loads.entry((hop.link, direction)).or_default();
            load.transfers += 1;
            load.latency_s = load.latency_s.max(latency_s);
        }
    }
    // The maximum does not depend on the map's order.
    let time_s = |((link, _), load): (&(usize, bool), &Load)| {
        load.latency_s + load.transfers as f64 * sub_vector_bytes / (links[*link].bandwidth_gb_s * 1e9)
    };
    loads.iter().map(time_s).fold(0.0, f64::max)
}
