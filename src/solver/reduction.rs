//! Sums over all ranks with the same bits for every rank count.
//!
//! The leaves are the chunk sums of `RowPartition`, added along a fixed binary tree over all chunks. A rank adds the
//! subtrees that lie wholly within its chunks (at most 2 log2 of them) and sends only their roots. Then every rank adds
//! the rest of the tree in the same order. A call takes one all-gather, whatever the number of scalars.

use std::ops::Range;

use crate::partition::RowPartition;
use crate::transport::{Transport, TransportError};

/// The fixed tree and the leaves that each rank owns.
#[derive(Clone, Debug)]
pub struct ReductionTree {
    leaves: usize,
    ranges: Vec<Range<usize>>,
    sent: Vec<f64>,
    messages: Vec<Vec<f64>>,
}

/// The roots received from each rank, with the number of roots already added.
struct Streams<'a> {
    messages: &'a [Vec<f64>],
    /// Number of roots added per rank. At most [`crate::transport::RANKS_MAX`] ranks exist.
    taken: [u16; crate::transport::RANKS_MAX],
}

impl ReductionTree {
    /// Tree over the chunks of `partition`.
    pub fn new(partition: &RowPartition) -> ReductionTree {
        let chunks = partition.chunks();
        let leaves = chunks.next_power_of_two();
        let mut ranges: Vec<_> = (0..partition.ranks()).map(|r| partition.chunks_of(r)).collect();
        // The last rank also owns the leaves after the last chunk, which are zeros, so that its subtrees end where the
        // tree ends.
        if let Some(last) = ranges.last_mut() {
            last.end = leaves;
        }
        ReductionTree { leaves, ranges, sent: Vec::new(), messages: Vec::new() }
    }

    /// Adds `WIDTH` scalars over all ranks. `chunk_sums[chunk][i]`: the own chunks' sums.
    pub fn all_reduce<const WIDTH: usize>(
        &mut self,
        transport: &mut dyn Transport,
        chunk_sums: &[[f64; WIDTH]],
    ) -> Result<[f64; WIDTH], TransportError> {
        self.all_reduce_and_gather(transport, chunk_sums, &[], &mut Vec::new())
    }

    /// As [`ReductionTree::all_reduce`]; the same message brings `own` of every rank to `gathered`, in rank order.
    pub fn all_reduce_and_gather<const WIDTH: usize>(
        &mut self,
        transport: &mut dyn Transport,
        chunk_sums: &[[f64; WIDTH]],
        own: &[f64],
        gathered: &mut Vec<f64>,
    ) -> Result<[f64; WIDTH], TransportError> {
        let mut sent = std::mem::take(&mut self.sent);
        sent.clear();
        self.collect(0..self.leaves, &self.ranges[transport.rank()], chunk_sums, &mut sent);
        sent.extend_from_slice(own);
        self.sent = sent;
        if self.ranges.len() == 1 {
            self.messages.resize(1, Vec::new());
            std::mem::swap(&mut self.messages[0], &mut self.sent);
        } else {
            transport.all_gather(&self.sent, &mut self.messages)?;
        }
        gathered.clear();
        for (values, range) in self.messages.iter().zip(&self.ranges) {
            let roots = (self.roots(0..self.leaves, range) * WIDTH).min(values.len());
            gathered.extend_from_slice(&values[roots..]);
        }
        let mut streams = Streams { messages: &self.messages, taken: [0; crate::transport::RANKS_MAX] };
        Ok(self.finish(0..self.leaves, &mut streams))
    }

    /// Bytes of the own message of the last sum.
    pub fn message_bytes(&self) -> u64 {
        size_of_val(&self.sent[..]) as u64
    }

    /// Number of subtrees that the owner of the leaves `own` sends.
    fn roots(&self, node: Range<usize>, own: &Range<usize>) -> usize {
        if node.end <= own.start || node.start >= own.end {
            return 0;
        }
        if own.start <= node.start && node.end <= own.end {
            return 1;
        }
        let middle = node.start.midpoint(node.end);
        self.roots(node.start..middle, own) + self.roots(middle..node.end, own)
    }

    fn collect<const WIDTH: usize>(
        &self,
        node: Range<usize>,
        own: &Range<usize>,
        chunk_sums: &[[f64; WIDTH]],
        roots: &mut Vec<f64>,
    ) {
        if node.end <= own.start || node.start >= own.end {
            return;
        }
        if own.start <= node.start && node.end <= own.end {
            roots.extend(subtree(node.start - own.start..node.end - own.start, chunk_sums));
            return;
        }
        let middle = node.start.midpoint(node.end);
        self.collect(node.start..middle, own, chunk_sums, roots);
        self.collect(middle..node.end, own, chunk_sums, roots);
    }

    fn finish<const WIDTH: usize>(&self, node: Range<usize>, streams: &mut Streams<'_>) -> [f64; WIDTH] {
        let owner = self.ranges.partition_point(|range| range.end <= node.start);
        if node.end <= self.ranges[owner].end {
            // A rank that sends fewer roots than its leaves need breaks the protocol; NaN makes the solve stop.
            return streams.next(owner).unwrap_or([f64::NAN; WIDTH]);
        }
        let middle = node.start.midpoint(node.end);
        let left = self.finish(node.start..middle, streams);
        add(left, self.finish(middle..node.end, streams))
    }
}

impl Streams<'_> {
    /// The next root of a rank.
    fn next<const WIDTH: usize>(&mut self, rank: usize) -> Option<[f64; WIDTH]> {
        let root = self.messages.get(rank)?.as_chunks::<WIDTH>().0.get(self.taken[rank] as usize).copied();
        self.taken[rank] += 1;
        root
    }
}

fn add<const WIDTH: usize>(a: [f64; WIDTH], b: [f64; WIDTH]) -> [f64; WIDTH] {
    std::array::from_fn(|i| a[i] + b[i])
}

fn subtree<const WIDTH: usize>(node: Range<usize>, leaves: &[[f64; WIDTH]]) -> [f64; WIDTH] {
    if node.start >= leaves.len() {
        return [0.0; WIDTH];
    }
    if node.len() == 1 {
        return leaves[node.start];
    }
    let middle = node.start.midpoint(node.end);
    add(subtree(node.start..middle, leaves), subtree(middle..node.end, leaves))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All-reduce over `ranks` ranks without a transport.
    fn reduce(rows: usize, ranks: usize, sums: &[[f64; 2]]) -> [f64; 2] {
        let partition = RowPartition::new(rows, ranks);
        let tree = ReductionTree::new(&partition);
        let messages: Vec<Vec<f64>> = (0..ranks)
            .map(|r| {
                let mut roots = Vec::new();
                tree.collect(0..tree.leaves, &tree.ranges[r], &sums[partition.chunks_of(r)], &mut roots);
                assert!(roots.len() / 2 * 3 <= crate::transport::ALL_GATHER_MAX);
                roots
            })
            .collect();
        tree.finish(0..tree.leaves, &mut Streams { messages: &messages, taken: [0; crate::transport::RANKS_MAX] })
    }

    #[test]
    fn the_sum_has_the_same_bits_for_every_rank_count() {
        for rows in [17, 479, 5000, 100_000] {
            let chunks = RowPartition::new(rows, 1).chunks();
            let sums: Vec<[f64; 2]> =
                (0..chunks).map(|i| [(i as f64 * 0.7).sin() * 1e3, 1.0 / (i as f64 + 0.3)]).collect();
            let one = reduce(rows, 1, &sums);
            let exact: f64 = sums.iter().map(|s| s[0]).sum();
            assert!((one[0] - exact).abs() < 1e-9 * sums.len() as f64);
            for ranks in 2..=16 {
                assert_eq!(
                    reduce(rows, ranks, &sums).map(f64::to_bits),
                    one.map(f64::to_bits),
                    "{rows} rows, {ranks} ranks"
                );
            }
        }
    }
}
