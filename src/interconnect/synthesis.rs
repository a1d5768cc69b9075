//! Schedule `best`: made for the given machine. Candidates are the known schedules cut into chunks, rings that respect
//! islands of fast links, and trees packed for the links at hand, put in order on the clock's network; the clock decides.
//! Deterministic: no random numbers, and the effort is counted in transfers, not in seconds.

use super::bound::lower_bound;
use super::cost::{ScheduleCost, pieces_cost};
use super::islands::{all_islands, island_rings};
use super::network::Channels;
use super::ordering::{Preference, order};
use super::packing::{Demand, Tree, pack};
use super::pieces::{Piece, Pieces};
use super::topology::Topology;
use super::{QueueNode, Schedule};

/// As close to the bound as this ends the search at once.
const GOAL: f64 = 1.002;
/// As close to the bound as this, the more expensive kinds of candidates are not tried.
const CLOSE_ENOUGH: f64 = 1.02;
/// Chunks per sub-vector that are tried, cheap ones first.
const CHUNKS: [usize; 10] = [1, 2, 3, 4, 6, 8, 12, 16, 24, 48];
/// Transfers times GPUs that all candidates together may cost; 64 GPUs then take a few seconds.
const EFFORT: usize = 7_000_000;

/// The cheapest found way to move sub-vectors of `sub_vector_bytes` bytes in pieces; `known`: schedules to improve on.
pub(super) fn synthesize(topology: &Topology, known: &[&Schedule], sub_vector_bytes: f64) -> (Pieces, ScheduleCost) {
    let mut search = Synthesis::new(topology, sub_vector_bytes);
    for chunks in [1, 2, 4, 8, 16] {
        for schedule in known {
            search.try_known(schedule, chunks);
        }
    }
    if !search.is_within(CLOSE_ENOUGH) {
        for islands in all_islands(topology) {
            for chunks in CHUNKS {
                let rings = || island_rings(topology, &islands, chunks);
                for beside in [3, 2, 1, 4] {
                    search.try_trees(chunks, beside, Preference::InProportion, rings);
                }
            }
        }
    }
    if !search.is_within(CLOSE_ENOUGH) {
        let channels = Channels::of(topology);
        for chunks in CHUNKS {
            let items = chunk_items(topology.gpus(), chunks, sub_vector_bytes);
            let trees = || pack(&channels, &items, search_target_s(topology, sub_vector_bytes), topology.gpus());
            for (preference, beside) in
                [(Preference::FreeLinks, 1), (Preference::InProportion, 3), (Preference::LongChains, 1)]
            {
                search.try_trees(chunks, beside, preference, trees);
            }
        }
    }
    search.best
}

fn search_target_s(topology: &Topology, sub_vector_bytes: f64) -> f64 {
    lower_bound(topology, sub_vector_bytes).cut_s
}

struct Synthesis<'a> {
    topology: &'a Topology,
    channels: Channels,
    sub_vector_bytes: f64,
    bound_s: f64,
    effort: usize,
    best: (Pieces, ScheduleCost),
}

impl<'a> Synthesis<'a> {
    fn new(topology: &'a Topology, sub_vector_bytes: f64) -> Synthesis<'a> {
        let nothing = Pieces { chunks: 1, queues: vec![Vec::new(); topology.gpus()] };
        let never = ScheduleCost { stage_s: Vec::new(), total_s: f64::INFINITY };
        let best = match topology.gpus() {
            1 => (nothing, ScheduleCost { stage_s: Vec::new(), total_s: 0.0 }),
            _ => (nothing, never),
        };
        Synthesis {
            topology,
            channels: Channels::of(topology),
            sub_vector_bytes,
            bound_s: lower_bound(topology, sub_vector_bytes).total_s(),
            effort: EFFORT,
            best,
        }
    }

    fn is_within(&self, factor: f64) -> bool {
        self.best.1.total_s <= self.bound_s * factor
    }

    /// False if the goal is reached or a candidate of this size is too expensive by now.
    fn may_try(&mut self, chunks: usize, beside: usize) -> bool {
        let gpus = self.topology.gpus();
        let effort = gpus * (gpus - 1) * chunks * gpus * beside;
        if self.is_within(GOAL) || effort > self.effort {
            return false;
        }
        self.effort -= effort;
        true
    }

    fn offer(&mut self, pieces: Pieces) {
        let cost = pieces_cost(&pieces, self.topology, self.sub_vector_bytes);
        if cost.total_s < self.best.1.total_s * (1.0 - 1e-9) {
            self.best = (pieces, cost);
        }
    }

    fn try_known(&mut self, schedule: &Schedule, chunks: usize) {
        let pieces = in_chunks(schedule, chunks);
        let mut lasts = vec![chunks, chunks.div_ceil(2), 1, 0];
        lasts.dedup();
        for last in lasts {
            // Cheaper than list scheduling by far.
            if last == 0 || self.may_try(chunks.div_ceil(4), 1) {
                self.offer(last_from_owners(&pieces, &self.channels, last));
            }
        }
    }

    fn try_trees(&mut self, chunks: usize, beside: usize, preference: Preference, trees: impl FnOnce() -> Vec<Tree>) {
        if !self.may_try(chunks, beside) {
            return;
        }
        let gpus = self.topology.gpus();
        let items = chunk_items(gpus, chunks, self.sub_vector_bytes);
        let queues = order(&self.channels, &items, &trees(), gpus, preference, beside);
        let piece = |(source, item, lane)| Piece { source, vector: item % gpus, chunk: item / gpus, lane };
        let queue =
            |moves: &Vec<super::ordering::Move>| moves.iter().map(|m| piece((m.source, m.item, m.lane))).collect();
        self.offer(Pieces { chunks, queues: queues.iter().map(queue).collect() });
    }
}

/// Every transfer of a schedule cut into chunks that follow one another.
fn in_chunks(schedule: &Schedule, chunks: usize) -> Pieces {
    let cut = |node: &QueueNode| {
        let QueueNode { source, vector } = *node;
        (0..chunks).map(move |chunk| Piece { source, vector, chunk, lane: 0 })
    };
    Pieces { chunks, queues: schedule.queues.iter().map(|queue| queue.iter().flat_map(cut).collect()).collect() }
}

/// The same with the last `count` pieces of a rank taken from their owners where these are nearer: in a ring over a tree
/// the owner is the sibling, so that the last bytes of all ranks arrive with a short latency and cross no upper link.
fn last_from_owners(pieces: &Pieces, channels: &Channels, count: usize) -> Pieces {
    let mut pieces = pieces.clone();
    for (rank, queue) in pieces.queues.iter_mut().enumerate() {
        for last in queue.iter_mut().rev().take(count) {
            if channels.latency_s(last.vector, rank) < channels.latency_s(last.source, rank) {
                last.source = last.vector;
            }
        }
    }
    pieces
}

/// Chunk c of sub-vector v as item c n + v: chunk-major, so that equal prices spread the chunks of one sub-vector over
/// different trees.
fn chunk_items(gpus: usize, chunks: usize, sub_vector_bytes: f64) -> Vec<Demand> {
    let bytes = sub_vector_bytes / chunks as f64;
    (0..chunks * gpus)
        .map(|i| i % gpus)
        .map(|owner| Demand { owner, bytes, readers: (0..gpus).filter(|reader| *reader != owner).collect() })
        .collect()
}
