//! One exchange from the point of view of each receiver: when its receipts begin and arrive by the clock, counted from the
//! moment at which all ranks publish. For transports that hold messages back; pure, nothing waits here.

use serde::{Deserialize, Serialize};

use super::cost::{all_reduce_s, transfer_times};
use super::queues::Plan;
use super::recorded::Traffic;
use super::topology::Topology;
use super::transfers::TransferPlan;

/// A moment that depends on how long the messages are, as a straight line through two runs of the clock.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// With messages of no length: latencies alone, seconds.
    pub empty_s: f64,
    /// With messages as planned, seconds.
    pub full_s: f64,
}

impl Line {
    /// With messages of `share` times the planned length.
    pub fn at(&self, share: f64) -> f64 {
        self.empty_s + share * (self.full_s - self.empty_s)
    }
}

/// One sub-vector or set of halo rows that a rank receives.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Receipt {
    /// Rank that hands it over.
    pub source: usize,
    /// Rank that owns it.
    pub owner: usize,
    /// Receipts of one lane follow one another.
    pub lane: usize,
    /// When the transfer begins.
    pub start: Line,
    /// When its source holds it; from the start if the source owns it.
    pub held: Line,
    /// When it has arrived.
    pub done: Line,
}

/// Arrival times at one rank over the links of a topology.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RankLinks {
    /// Receipts when whole sub-vectors travel.
    pub whole: Vec<Receipt>,
    /// Bytes of a sub-vector.
    pub whole_bytes: f64,
    /// Receipts when halo rows travel.
    pub halo: Vec<Receipt>,
    /// Per owner: bytes of halo rows that this rank reads of it.
    pub halo_bytes: Vec<f64>,
    /// Time of a gather of small values after the last rank has reached it, seconds.
    pub gather_s: f64,
}

impl RankLinks {
    /// For every rank: sub-vectors of `sub_vector_bytes` travel as `plan` says, halo rows as `halo` counts them (one vector).
    pub fn of(topology: &Topology, plan: &Plan, sub_vector_bytes: f64, halo: &Traffic) -> Vec<RankLinks> {
        let whole = receipts(&plan.transfers(sub_vector_bytes), topology);
        let rows = receipts(&halo.transfers(topology, plan), topology);
        let gather_s = all_reduce_s(topology);
        let links = |(rank, (whole, rows)): (usize, (Vec<Receipt>, Vec<Receipt>))| RankLinks {
            whole,
            whole_bytes: sub_vector_bytes,
            halo: rows,
            halo_bytes: halo.received.iter().map(|readers| readers[rank]).collect(),
            gather_s,
        };
        whole.into_iter().zip(rows).enumerate().map(links).collect()
    }
}

/// Share of its bytes that a message of no length keeps: a transfer of nothing would be left out.
const NOTHING: f64 = 1e-9;

fn receipts(plan: &TransferPlan, topology: &Topology) -> Vec<Vec<Receipt>> {
    let mut empty = plan.clone();
    empty.queues.iter_mut().flatten().for_each(|transfer| transfer.bytes *= NOTHING);
    let (empty_s, full_s) = (transfer_times(&empty, topology), transfer_times(plan, topology));
    let line = |rank: usize, i: usize, moment: fn(&super::TaskTimes) -> f64| Line {
        empty_s: moment(&empty_s[rank][i]),
        full_s: moment(&full_s[rank][i]),
    };
    let receipt = |rank: usize, i: usize| {
        let transfer = plan.queues[rank][i];
        let source = plan.queues.get(transfer.source);
        let there = source.and_then(|queue| queue.iter().position(|other| other.item == transfer.item));
        Receipt {
            source: transfer.source,
            owner: transfer.owner,
            lane: transfer.lane,
            start: line(rank, i, |span| span.start_s),
            held: there.map_or(Line { empty_s: 0.0, full_s: 0.0 }, |at| line(transfer.source, at, |span| span.done_s)),
            done: line(rank, i, |span| span.done_s),
        }
    };
    (0..plan.queues.len()).map(|rank| (0..plan.queues[rank].len()).map(|i| receipt(rank, i)).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::interconnect::{Duplex, ScheduleKind, plan};

    #[test]
    fn receipts_of_a_ring_follow_one_another() {
        // Two links of 1 ms each and 1 GB/s between any two of three GPUs.
        let topology = Topology::balanced_tree(2, 1.0, 1000.0, Duplex::Full).unwrap();
        let plan = plan(ScheduleKind::Ring, &topology, 4e6).unwrap();
        let halo = Traffic { published: vec![1e6; 2], received: vec![vec![0.0, 1e6], vec![0.0, 0.0]] };
        let links = RankLinks::of(&topology, &plan, 4e6, &halo);
        let receipt = links[0].whole[0];
        assert_eq!((receipt.source, receipt.owner), (1, 1));
        assert!((receipt.done.full_s - 6e-3).abs() < 1e-12 && (receipt.done.at(0.0) - 2e-3).abs() < 1e-9);
        assert!((receipt.done.at(2.0) - 10e-3).abs() < 1e-8);
        assert!(links[0].halo.is_empty() && links[0].halo_bytes == [0.0, 0.0]);
        assert!((links[1].halo[0].done.full_s - 3e-3).abs() < 1e-12);
        assert!(links[0].gather_s >= 2e-3);
    }

    #[test]
    fn who_hands_on_holds_it_first() {
        let topology = Topology::default_for(4).unwrap();
        let plan = plan(ScheduleKind::Ring, &topology, 1e6).unwrap();
        let none = Traffic { published: vec![0.0; 4], received: vec![vec![0.0; 4]; 4] };
        for (rank, links) in RankLinks::of(&topology, &plan, 1e6, &none).iter().enumerate() {
            assert_eq!(links.whole.len(), 3, "rank {rank}");
            assert_eq!(links.whole[0].held.full_s, 0.0);
            for receipt in &links.whole[1..] {
                assert!(receipt.held.full_s > 0.0 && receipt.start.full_s >= receipt.held.full_s);
            }
        }
    }
}
