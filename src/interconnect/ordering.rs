//! In which order ranks receive what their trees bring them: list scheduling on the clock's own network. Whenever a lane of
//! a rank is free, it takes the piece that others wait for longest among those that its sources hold.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::network::{Channels, Network};
use super::packing::{Demand, Tree};

/// One entry of a lane's queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Move {
    pub source: usize,
    pub item: usize,
    pub lane: usize,
}

/// Rule that chooses among pieces that could be sent next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Preference {
    /// Free links, then long chains.
    FreeLinks,
    /// Long chains, then free links.
    LongChains,
    /// Sources in proportion to what is still to come from them, then long chains.
    InProportion,
}

/// A piece that a lane will receive.
struct Waiting {
    item: usize,
    source: usize,
    /// Transfers that follow one another below it.
    height: u32,
    /// Ranks that get it through this one.
    below: u32,
}

struct Lane {
    rank: usize,
    number: usize,
    free: Vec<bool>,
    /// Per source: pieces still to start, pieces under way.
    sources: Vec<(usize, u32, u32)>,
    /// Not yet held by their sources.
    later: Vec<Waiting>,
    /// Transfers that could start now.
    now: Vec<Waiting>,
}

impl Lane {
    fn count(&mut self, source: usize, to_start: i32, under_way: i32) {
        let at = self.sources.iter().position(|known| known.0 == source).unwrap_or_else(|| {
            self.sources.push((source, 0, 0));
            self.sources.len() - 1
        });
        let known = &mut self.sources[at];
        known.1 = known.1.saturating_add_signed(to_start);
        known.2 = known.2.saturating_add_signed(under_way);
    }

    /// Pieces to come from a source for each that would be under way then.
    fn share(&self, source: usize) -> u32 {
        let known = self.sources.iter().find(|known| known.0 == source);
        known.map_or(0, |(_, to_start, under_way)| 1000 * to_start / (under_way + 1))
    }
}

#[derive(Clone, Copy, PartialEq)]
struct Arrival(f64, usize, usize);

impl Eq for Arrival {}
impl PartialOrd for Arrival {
    fn partial_cmp(&self, other: &Arrival) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Arrival {
    fn cmp(&self, other: &Arrival) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0).then((self.1, self.2).cmp(&(other.1, other.2)))
    }
}

/// Queues of all ranks: `queues[rank]` in the order in which the pieces start. `beside` pieces may come over the same last
/// link at once; `trees[i]` brings `items[i]`.
pub(super) fn order(
    channels: &Channels,
    items: &[Demand],
    trees: &[Tree],
    gpus: usize,
    preference: Preference,
    beside: usize,
) -> Vec<Vec<Move>> {
    let mut lanes = lanes_of(channels, items, trees, gpus, beside);
    let mut queues = vec![Vec::new(); gpus];
    let mut network = Network::new(channels);
    let mut busy = vec![0.0f64; channels.capacity.len()];
    let mut arrivals: BinaryHeap<Reverse<Arrival>> = BinaryHeap::new();
    // Flow number -> (lane, item, source).
    let mut flows: Vec<(usize, usize, usize, usize)> = Vec::new();
    let (mut now_s, mut ended, mut first) = (0.0f64, Vec::new(), 0);
    loop {
        let count = lanes.len();
        for lane in (0..count).map(|i| (i + first) % count) {
            let Some(slot) = lanes[lane].free.iter().position(|free| *free).filter(|_| !lanes[lane].now.is_empty())
            else {
                continue;
            };
            let Some(chosen) = choose(&lanes[lane], channels, &busy, items, gpus, preference) else { continue };
            let piece = lanes[lane].now.swap_remove(chosen);
            let rank = lanes[lane].rank;
            lanes[lane].free[slot] = false;
            lanes[lane].count(piece.source, -1, 1);
            network.start(flows.len(), piece.source, rank, items[piece.item].bytes, now_s);
            occupy(channels, &mut busy, piece.source, rank, 1.0);
            flows.push((lane, piece.item, piece.source, slot));
            queues[rank].push(Move {
                source: piece.source,
                item: piece.item,
                lane: lanes[lane].number * beside + slot,
            });
        }
        first = (first + 1) % count.max(1);
        let arrival_s = arrivals.peek().map_or(f64::INFINITY, |arrival| arrival.0.0);
        let next_s = network.next_end_s(now_s).min(arrival_s);
        if next_s == f64::INFINITY {
            return queues;
        }
        now_s = next_s.max(now_s);
        network.ended(now_s, &mut ended);
        for &flow in &ended {
            let (lane, item, source, slot) = flows[flow];
            let rank = lanes[lane].rank;
            lanes[lane].free[slot] = true;
            lanes[lane].count(source, 0, -1);
            occupy(channels, &mut busy, source, rank, -1.0);
            arrivals.push(Reverse(Arrival(now_s + channels.latency_s(source, rank), rank, item)));
        }
        while let Some(&Reverse(Arrival(at_s, rank, item))) = arrivals.peek() {
            if at_s > now_s {
                break;
            }
            arrivals.pop();
            for lane in &mut lanes {
                let mut i = 0;
                while i < lane.later.len() {
                    if lane.later[i].source == rank && lane.later[i].item == item {
                        let piece = lane.later.swap_remove(i);
                        lane.now.push(piece);
                    } else {
                        i += 1;
                    }
                }
            }
        }
    }
}

/// Adds a transfer at full speed of its narrowest link to the loads of its links (as shares of them).
fn occupy(channels: &Channels, busy: &mut [f64], from: usize, to: usize, sign: f64) {
    let path = channels.path(from, to);
    let narrowest = path.iter().map(|c| channels.capacity[*c as usize]).fold(f64::INFINITY, f64::min);
    for &channel in path {
        busy[channel as usize] += sign * narrowest / channels.capacity[channel as usize];
    }
}

fn choose(
    lane: &Lane,
    channels: &Channels,
    busy: &[f64],
    items: &[Demand],
    gpus: usize,
    preference: Preference,
) -> Option<usize> {
    let crowd = |piece: &Waiting| {
        let path = channels.path(piece.source, lane.rank);
        let narrowest = path.iter().map(|c| channels.capacity[*c as usize]).fold(f64::INFINITY, f64::min);
        let after = |c: &u32| busy[*c as usize] + narrowest / channels.capacity[*c as usize];
        // Links that have no room for it, each as often as it would be shared.
        path.iter().map(|c| (after(c) - 1e-6).floor().max(0.0) as u32).sum::<u32>()
    };
    let key = |piece: &Waiting| {
        let crowd = crowd(piece);
        let chain = (Reverse(piece.height), Reverse(piece.below));
        let place = ((items[piece.item].owner + gpus - lane.rank) % gpus, piece.item);
        match preference {
            Preference::LongChains => (0, chain, crowd, place),
            Preference::InProportion => (u32::MAX - lane.share(piece.source), chain, crowd, place),
            Preference::FreeLinks => (crowd, chain, 0, place),
        }
    };
    (0..lane.now.len()).min_by_key(|&i| key(&lane.now[i]))
}

fn lanes_of(channels: &Channels, items: &[Demand], trees: &[Tree], gpus: usize, beside: usize) -> Vec<Lane> {
    let mut lanes: Vec<Lane> = Vec::new();
    let mut of_rank: Vec<Vec<(u32, usize)>> = vec![Vec::new(); gpus];
    for (item, (demand, tree)) in items.iter().zip(trees).enumerate() {
        let (mut height, mut below) = (vec![0u32; gpus], vec![0u32; gpus]);
        for &(source, receiver) in tree.iter().rev() {
            height[source] = height[source].max(height[receiver] + 1);
            below[source] += below[receiver] + 1;
        }
        for &(source, rank) in tree {
            let last = channels.path(source, rank).last().copied().unwrap_or(0);
            let known = of_rank[rank].iter().find(|(channel, _)| *channel == last).map(|(_, lane)| *lane);
            let lane = known.unwrap_or_else(|| {
                let lane = Lane {
                    rank,
                    number: of_rank[rank].len(),
                    free: vec![true; beside],
                    sources: Vec::new(),
                    later: Vec::new(),
                    now: Vec::new(),
                };
                lanes.push(lane);
                of_rank[rank].push((last, lanes.len() - 1));
                lanes.len() - 1
            });
            let piece = Waiting { item, source, height: height[rank], below: below[rank] };
            let lane = &mut lanes[lane];
            lane.count(source, 1, 0);
            if source == demand.owner { lane.now.push(piece) } else { lane.later.push(piece) }
        }
    }
    lanes
}
