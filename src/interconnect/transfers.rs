//! What one exchange moves, transfer by transfer: the common form of work queues, pieces and halos, and how it becomes a
//! part of a program for the clock.

use super::Schedule;
use super::clock::{Milestone, Program, Work};
use super::network::Channels;
use super::ordering::{Move, Preference, order};
use super::packing::{Demand, Tree, pack};
use super::pieces::Pieces;
use super::topology::Topology;

/// One receipt of one rank.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transfer {
    /// Rank that hands it over.
    pub source: usize,
    /// Rank that owns what is handed over.
    pub owner: usize,
    /// Number of what is handed over, the same for all who receive it.
    pub item: usize,
    /// Transfers of one lane of a rank follow one another.
    pub lane: usize,
    /// Size, bytes.
    pub bytes: f64,
}

/// All transfers of an exchange.
#[derive(Clone, Debug, PartialEq)]
pub struct TransferPlan {
    /// True if a lane posts its next transfer ahead, so that it follows as soon as the links are free; false if it waits
    /// for the arrival of the one before, like copies in one stream.
    pub ahead: bool,
    /// Receipts of every rank in order.
    pub queues: Vec<Vec<Transfer>>,
}

impl TransferPlan {
    /// Whole sub-vectors of `bytes` bytes along work queues.
    pub fn of_schedule(schedule: &Schedule, bytes: f64) -> TransferPlan {
        TransferPlan::of_queues(schedule, |_, _| bytes)
    }

    /// Sub-vectors of `bytes` bytes in pieces.
    pub fn of_pieces(pieces: &Pieces, bytes: f64) -> TransferPlan {
        let bytes = bytes / pieces.chunks as f64;
        let transfer = |piece: &super::Piece| Transfer {
            source: piece.source,
            owner: piece.vector,
            item: piece.vector * pieces.chunks + piece.chunk,
            lane: piece.lane,
            bytes,
        };
        let queues = pieces.queues.iter().map(|queue| queue.iter().map(transfer).collect()).collect();
        TransferPlan { ahead: true, queues }
    }

    /// The same ways, with `factor(owner)` times the bytes of every owner. Receipts of nothing are left out.
    pub fn scaled(&self, factor: impl Fn(usize) -> f64) -> TransferPlan {
        let scale = |transfer: &Transfer| Transfer { bytes: transfer.bytes * factor(transfer.owner), ..*transfer };
        let queue = |queue: &Vec<Transfer>| queue.iter().map(scale).filter(|transfer| transfer.bytes > 0.0).collect();
        TransferPlan { ahead: self.ahead, queues: self.queues.iter().map(queue).collect() }
    }

    /// Halo rows along work queues: `halo[owner][reader]` bytes. Who hands on takes the rows of those behind it as well;
    /// how many rows two readers share is not known, so it takes the sum, but never more than the owner publishes
    /// (`published[owner]` bytes). Receipts of nothing are left out.
    pub fn halo_of_schedule(schedule: &Schedule, halo: &[Vec<f64>], published: &[f64]) -> TransferPlan {
        let gpus = schedule.gpus;
        // What a receipt carries: the reader's own rows and those of everybody who gets them through it.
        let mut carried = vec![vec![0.0; gpus]; gpus];
        let source_of = |rank: usize, vector: usize| {
            schedule.queues[rank].iter().find(|node| node.vector == vector).map(|node| node.source)
        };
        for owner in 0..gpus {
            for reader in (0..gpus).filter(|reader| halo[owner][*reader] > 0.0) {
                let mut at = Some(reader);
                // As many steps as ranks at most, should the queues go round in a circle.
                for _ in 0..gpus {
                    let Some(rank) = at.filter(|rank| *rank != owner) else { break };
                    carried[owner][rank] += halo[owner][reader];
                    at = source_of(rank, owner);
                }
            }
            carried[owner].iter_mut().for_each(|bytes: &mut f64| *bytes = bytes.min(published[owner]));
        }
        TransferPlan::of_queues(schedule, |rank, vector| carried[vector][rank])
    }

    /// The cheapest found way to bring every demand to its readers: contention-aware, readers hand on to each other, large
    /// demands go in chunks (items are numbered demand by demand). Returns it with its modeled time.
    pub fn best_for(topology: &Topology, demands: &[Demand]) -> (TransferPlan, f64) {
        let channels = Channels::of(topology);
        let target_s = super::bound::demand_bound_s(topology, demands).max(1e-12);
        let largest = demands.iter().map(|demand| demand.bytes).fold(0.0, f64::max);
        let mut best = (TransferPlan { ahead: true, queues: vec![Vec::new(); topology.gpus()] }, f64::INFINITY);
        for parts in [1.0, 2.0, 4.0, 8.0] {
            let items = cut(demands, largest / parts);
            if items.len() > ITEMS_MAX.max(demands.len()) {
                break;
            }
            for trees in [pack(&channels, &items, target_s, topology.gpus()), items.iter().map(star).collect()] {
                for (preference, beside) in ORDERS {
                    let moves = order(&channels, &items, &trees, topology.gpus(), preference, beside);
                    let queues = moves.iter().map(|queue| queue.iter().map(|m| transfer_of(m, &items)).collect());
                    let plan = TransferPlan { ahead: true, queues: queues.collect() };
                    let seconds = plan.seconds_on(&channels);
                    if seconds < best.1 {
                        best = (plan, seconds);
                    }
                }
            }
        }
        best
    }

    /// Modeled time of the exchange alone; infinity if transfers wait for each other in a circle.
    pub fn seconds(&self, topology: &Topology) -> f64 {
        self.seconds_on(&Channels::of(topology))
    }

    fn seconds_on(&self, channels: &Channels) -> f64 {
        let mut program = Program::default();
        self.add_to(&mut program, None);
        program.run_on(channels).map_or(f64::INFINITY, |spans| spans.iter().map(|span| span.done_s).fold(0.0, f64::max))
    }

    fn of_queues(schedule: &Schedule, bytes: impl Fn(usize, usize) -> f64) -> TransferPlan {
        let gpus = schedule.gpus;
        let queue = |(rank, queue): (usize, &Vec<super::QueueNode>)| {
            let there = queue.iter().filter(|node| rank < gpus && node.source < gpus && node.vector < gpus);
            let transfer = |node: &super::QueueNode| Transfer {
                source: node.source,
                owner: node.vector,
                item: node.vector,
                lane: 0,
                bytes: bytes(rank, node.vector),
            };
            there.map(transfer).filter(|transfer| transfer.bytes > 0.0).collect()
        };
        TransferPlan { ahead: false, queues: schedule.queues.iter().enumerate().map(queue).collect() }
    }

    /// Adds the transfers to a program; returns their tasks in the order of the queues. `published[rank]`: the task after
    /// which the rank's own items can be read and its receipts are posted.
    pub fn add_to(&self, program: &mut Program, published: Option<&[usize]>) -> Vec<Vec<usize>> {
        let gpus = self.queues.len();
        let items = self.queues.iter().flatten().map(|transfer| transfer.item + 1).max().unwrap_or(0);
        let mut holds: Vec<u32> = vec![u32::MAX; gpus * items];
        let mut tasks = Vec::with_capacity(gpus);
        let moment = if self.ahead { Milestone::Released } else { Milestone::Done };
        for (rank, queue) in self.queues.iter().enumerate() {
            let mut before: Vec<Option<usize>> = Vec::new();
            let mut own = Vec::with_capacity(queue.len());
            for transfer in queue {
                let task = program.add(Work::Transfer { from: transfer.source, to: rank, bytes: transfer.bytes });
                if before.len() <= transfer.lane {
                    before.resize(transfer.lane + 1, None);
                }
                match before[transfer.lane].replace(task) {
                    Some(before) => program.after(task, before, moment),
                    None => published.into_iter().for_each(|all| program.after(task, all[rank], Milestone::Done)),
                }
                holds[rank * items + transfer.item] = task as u32;
                own.push(task);
            }
            tasks.push(own);
        }
        for (queue, tasks) in self.queues.iter().zip(&tasks) {
            for (transfer, &task) in queue.iter().zip(tasks) {
                let held = holds[transfer.source * items + transfer.item];
                if held != u32::MAX {
                    program.after(task, held as usize, Milestone::Done);
                } else if let Some(published) = published {
                    program.after(task, published[transfer.source], Milestone::Done);
                }
            }
        }
        tasks
    }
}

/// Most items that large demands are cut into.
const ITEMS_MAX: usize = 2000;
/// Ways to put them in order that are tried.
const ORDERS: [(Preference, usize); 3] =
    [(Preference::FreeLinks, 1), (Preference::LongChains, 1), (Preference::InProportion, 2)];

/// The demands in equal parts of at most `most` bytes.
fn cut(demands: &[Demand], most: f64) -> Vec<Demand> {
    let parts = |demand: &Demand| {
        let count = (demand.bytes / most - 1e-9).ceil().max(1.0);
        vec![Demand { bytes: demand.bytes / count, ..demand.clone() }; count as usize]
    };
    demands.iter().flat_map(parts).collect()
}

/// Everybody from the owner.
fn star(demand: &Demand) -> Tree {
    demand.readers.iter().map(|&reader| (demand.owner, reader)).collect()
}

fn transfer_of(m: &Move, items: &[Demand]) -> Transfer {
    let Demand { owner, bytes, .. } = items[m.item];
    Transfer { source: m.source, owner, item: m.item, lane: m.lane, bytes }
}
