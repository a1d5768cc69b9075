//! Work queues: which rank receives which sub-vector from whom in which stage. Every schedule here passes
//! [`super::check_schedule`]; which one is cheapest is a matter of the modeled cost (`cost.rs`).

use super::cost::{ScheduleCost, modeled_cost};
use super::pieces::Pieces;
use super::synthesis::synthesize;
use super::topology::Topology;
use super::transfers::TransferPlan;
use super::{QueueNode, Schedule};

/// A way to make work queues.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ScheduleKind {
    #[default]
    /// The cheapest of the others by the clock.
    Auto,
    /// The recursion of the paper, for powers of two [Li et al. 2020, Sec. 3.1.2].
    FatTree,
    /// Everybody forwards to the next in tree order.
    Ring,
    /// Everybody pulls from every owner.
    Direct,
    /// Made for the given machine (`synthesis.rs`).
    Best,
}

impl ScheduleKind {
    /// All kinds, in the order in which they are offered to the user.
    pub const ALL: [ScheduleKind; 5] =
        [ScheduleKind::Auto, ScheduleKind::FatTree, ScheduleKind::Ring, ScheduleKind::Direct, ScheduleKind::Best];

    /// Name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            ScheduleKind::Auto => "auto",
            ScheduleKind::FatTree => "fat-tree",
            ScheduleKind::Ring => "ring",
            ScheduleKind::Direct => "direct",
            ScheduleKind::Best => "best",
        }
    }
}

impl std::fmt::Display for ScheduleKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

/// Why work queues cannot be made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ScheduleError {
    /// The paper's recursion halves the ranks until one is left.
    #[error("schedule fat-tree needs a power of two of GPUs and there are {gpus}: use ring, direct, best or auto")]
    NotPowerOfTwo {
        /// Number of GPUs of the topology.
        gpus: usize,
    },
}

/// Work queues of the paper's recursion [Li et al. 2020, Sec. 3.1.2] for a binary tree with ranks 0..n-1 at its leaves.
///
/// For a switch over two halves of h ranks each: the queues of the halves; then the halves swap what they own across
/// it; then the queues of the halves again, same sources, for the sub-vectors of the other half. The printed text
/// uses `m` both as split point and as offset and names no source for step 3; offset h and unchanged sources are what
/// makes each source hold what it sends. Every sub-vector crosses the root once, all of them in stage n/2.
pub fn fat_tree(gpus: usize) -> Result<Schedule, ScheduleError> {
    if !gpus.is_power_of_two() {
        return Err(ScheduleError::NotPowerOfTwo { gpus });
    }
    Ok(Schedule { gpus, queues: switch_queues(0, gpus) })
}

/// Queues of ranks `first..first + width` among themselves.
fn switch_queues(first: usize, width: usize) -> Vec<Vec<QueueNode>> {
    if width == 1 {
        return vec![Vec::new()];
    }
    let half = width / 2;
    let left = switch_queues(first, half);
    let right = switch_queues(first + half, half);
    let left = left.into_iter().zip(first..).map(|(queue, i)| twice_around_swap(queue, i + half, half as isize));
    let right = right.into_iter().zip(first..).map(|(queue, i)| twice_around_swap(queue, i, -(half as isize)));
    left.chain(right).collect()
}

/// A half's queue, then the receipt from the partner `across` the switch, then the queue again for the other half's
/// sub-vectors.
fn twice_around_swap(queue: Vec<QueueNode>, across: usize, offset: isize) -> Vec<QueueNode> {
    let of_other_half =
        |node: &QueueNode| QueueNode { source: node.source, vector: node.vector.wrapping_add_signed(offset) };
    let again: Vec<QueueNode> = queue.iter().map(of_other_half).collect();
    let swap = QueueNode { source: across, vector: across };
    queue.into_iter().chain([swap]).chain(again).collect()
}

/// Work queues of an in-order ring: in stage s (from 1) rank r receives from its predecessor the sub-vector that is s
/// places behind. Any number of ranks.
pub fn ring(gpus: usize) -> Schedule {
    let queue = |rank: usize| {
        let node = |stage| QueueNode { source: (rank + gpus - 1) % gpus, vector: (rank + gpus - stage) % gpus };
        (1..gpus).map(node).collect()
    };
    Schedule { gpus, queues: (0..gpus).map(queue).collect() }
}

/// Work queues without forwarding: in stage s (from 1) rank r pulls from the owner s places ahead, so that no two ranks
/// pull from the same owner in one stage. Any number of ranks.
pub fn direct(gpus: usize) -> Schedule {
    let queue = |rank: usize| {
        let node = |stage| QueueNode { source: (rank + stage) % gpus, vector: (rank + stage) % gpus };
        (1..gpus).map(node).collect()
    };
    Schedule { gpus, queues: (0..gpus).map(queue).collect() }
}

/// The same schedule with rank `order[p]` in the place of rank p. `order` is a permutation of 0..gpus.
fn in_order(schedule: Schedule, order: &[usize]) -> Schedule {
    let mut queues = vec![Vec::new(); schedule.gpus];
    for (place, queue) in schedule.queues.into_iter().enumerate() {
        let renamed = |node: QueueNode| QueueNode { source: order[node.source], vector: order[node.vector] };
        queues[order[place]] = queue.into_iter().map(renamed).collect();
    }
    Schedule { gpus: schedule.gpus, queues }
}

/// Work queues made for a topology, and what they cost by the clock.
#[derive(Clone, Debug)]
pub struct Plan {
    /// How they were made; never [`ScheduleKind::Auto`].
    pub kind: ScheduleKind,
    /// The work queues. Of [`ScheduleKind::Best`]: the order in which whole sub-vectors are taken, the cheapest of the
    /// other kinds.
    pub schedule: Schedule,
    /// Of [`ScheduleKind::Best`]: how the sub-vectors travel in pieces.
    pub pieces: Option<Pieces>,
    /// Modeled, not measured; of the pieces if there are any.
    pub cost: ScheduleCost,
}

impl Plan {
    /// The transfers that move sub-vectors of `sub_vector_bytes` bytes.
    pub fn transfers(&self, sub_vector_bytes: f64) -> TransferPlan {
        match &self.pieces {
            Some(pieces) => TransferPlan::of_pieces(pieces, sub_vector_bytes),
            None => TransferPlan::of_schedule(&self.schedule, sub_vector_bytes),
        }
    }
}

/// Work queues of the wanted kind for a topology, ranks taken in tree order ([`Topology::leaf_order`]), so that GPU ids
/// may be numbered in any way. `sub_vector_bytes` = size of one sub-vector.
pub fn plan(kind: ScheduleKind, topology: &Topology, sub_vector_bytes: f64) -> Result<Plan, ScheduleError> {
    let gpus = topology.gpus();
    let schedule = match kind {
        ScheduleKind::FatTree => fat_tree(gpus)?,
        ScheduleKind::Ring => ring(gpus),
        ScheduleKind::Direct => direct(gpus),
        ScheduleKind::Best => return Ok(best(topology, known(topology, sub_vector_bytes), sub_vector_bytes)),
        ScheduleKind::Auto => return Ok(cheapest(candidates(topology, sub_vector_bytes))),
    };
    Ok(priced(kind, schedule, topology, sub_vector_bytes))
}

/// One plan for every kind that is applicable to the topology. On equal cost `auto` takes the earlier one: without
/// forwarding first (no rank waits for another's receipt), then the simpler one.
pub fn candidates(topology: &Topology, sub_vector_bytes: f64) -> Vec<Plan> {
    let mut plans = known(topology, sub_vector_bytes);
    plans.push(best(topology, plans.clone(), sub_vector_bytes));
    plans
}

/// Plans of the kinds that do not look at the links.
fn known(topology: &Topology, sub_vector_bytes: f64) -> Vec<Plan> {
    [ScheduleKind::Direct, ScheduleKind::Ring, ScheduleKind::FatTree]
        .into_iter()
        .filter_map(|kind| plan(kind, topology, sub_vector_bytes).ok())
        .collect()
}

fn best(topology: &Topology, known: Vec<Plan>, sub_vector_bytes: f64) -> Plan {
    let schedules: Vec<&Schedule> = known.iter().map(|plan| &plan.schedule).collect();
    let (pieces, cost) = synthesize(topology, &schedules, sub_vector_bytes);
    Plan { kind: ScheduleKind::Best, pieces: Some(pieces), cost, ..cheapest(known) }
}

/// # Panics
/// Without plans; `direct` and `ring` always exist.
fn cheapest(plans: Vec<Plan>) -> Plan {
    // Sums in different order differ in the last bits; that must not decide.
    const EQUAL: f64 = 1.0 - 1e-9;
    let cheaper = |best: Plan, other: Plan| if other.cost.total_s < best.cost.total_s * EQUAL { other } else { best };
    plans.into_iter().reduce(cheaper).expect("direct and ring exist for every topology")
}

fn priced(kind: ScheduleKind, schedule: Schedule, topology: &Topology, sub_vector_bytes: f64) -> Plan {
    let schedule = in_order(schedule, &topology.leaf_order());
    let cost = modeled_cost(&schedule, topology, sub_vector_bytes);
    Plan { kind, schedule, pieces: None, cost }
}
