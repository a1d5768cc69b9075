//! The tests: boxes of triangles within a bucket, then boxes of the features that the two triangles own.

use std::ops::Range;

use super::features::{Features, Spread, bits};
use super::fill::{BucketEntries, rows};
use super::grid::Entry;
use super::input::Input;
use super::table::{HashTable, Load};
use super::workload::BucketBatch;
use crate::collision::Candidate;

/// Candidates handed over at once, at most.
pub(super) const BUFFER: usize = 1024;
/// Most candidates of a pair of triangles: 3 + 3 vertices, 3 x 3 edges.
const PER_PAIR: usize = 15;
/// Triangles of a bucket whose feature boxes are kept; those of further triangles are formed per pair.
const KEPT: usize = 64;
/// Box tests whose results are collected before the features are tested.
const STRIDE: usize = 64;

/// Buffers of one thread.
pub(super) struct Tester {
    /// By place in the bucket; the last two slots are for triangles beyond [`KEPT`].
    features: Vec<Features>,
    buffer: Vec<Candidate>,
    /// Candidates found since the start.
    pub found: u64,
    /// Box tests of triangles made since the start.
    pub tested: u64,
}

impl Tester {
    pub(super) fn new() -> Tester {
        Tester { features: vec![Features::UNKNOWN; KEPT + 2], buffer: Vec::with_capacity(BUFFER), found: 0, tested: 0 }
    }

    /// Bytes of the buffers.
    pub(super) fn bytes() -> u64 {
        ((KEPT + 2) * size_of::<Features>() + BUFFER * size_of::<Candidate>()) as u64
    }

    /// The tests of the rank in `buckets` of a batch.
    pub(super) fn run(
        &mut self,
        input: &Input,
        table: &HashTable,
        entries: &BucketEntries,
        batch: &BucketBatch,
        buckets: Range<usize>,
        emit: &mut dyn FnMut(&[Candidate]),
    ) {
        for bucket in buckets {
            let load = table.load(bucket);
            if load.tests() == 0 {
                continue;
            }
            let skip = if bucket == batch.buckets.start { batch.skip } else { 0 };
            let stop = if bucket + 1 == batch.buckets.end { batch.stop } else { load.tests() };
            self.bucket(input, &load, entries.of_bucket(bucket, &load), skip..stop, emit);
        }
        self.flush(emit);
    }

    fn flush(&mut self, emit: &mut dyn FnMut(&[Candidate])) {
        if !self.buffer.is_empty() {
            emit(&self.buffer);
            self.found += self.buffer.len() as u64;
            self.buffer.clear();
        }
    }

    /// The tests numbered `wanted` of a bucket.
    fn bucket(
        &mut self,
        input: &Input,
        load: &Load,
        entries: &[Entry],
        wanted: Range<u64>,
        emit: &mut dyn FnMut(&[Candidate]),
    ) {
        self.tested += wanted.end - wanted.start;
        self.features[..entries.len().min(KEPT)].iter_mut().for_each(|f| f.known = false);
        let mut before = 0;
        for (row, partners) in rows(load) {
            let tests = partners.len() as u64;
            let from = partners.start + wanted.start.saturating_sub(before).min(tests) as usize;
            let to = partners.start + wanted.end.saturating_sub(before).min(tests) as usize;
            before += tests;
            if from < to {
                self.row(input, entries, row, from..to, emit);
            }
            if before >= wanted.end {
                break;
            }
        }
    }

    #[inline(always)]
    fn row(
        &mut self,
        input: &Input,
        entries: &[Entry],
        row: usize,
        partners: Range<usize>,
        emit: &mut dyn FnMut(&[Candidate]),
    ) {
        let probe = entries[row].probe();
        let mut start = partners.start;
        while start < partners.end {
            let end = (start + STRIDE).min(partners.end);
            // The loop does not branch on the result, because it is hard to predict.
            let mut meets = 0u64;
            for (bit, entry) in entries[start..end].iter().enumerate() {
                meets |= u64::from(entry.meets(&probe)) << bit;
            }
            while meets != 0 {
                let other = start + meets.trailing_zeros() as usize;
                meets &= meets - 1;
                self.pair(input, entries, row, other);
                if self.buffer.len() + PER_PAIR > BUFFER {
                    self.flush(emit);
                }
            }
            start = end;
        }
    }

    /// Slot of the features of an entry, filled if needed; `spare` (0 or 1) chooses between the two last slots.
    #[inline(always)]
    fn features(&mut self, input: &Input, entry: &Entry, at: usize, spare: usize) -> usize {
        let slot = if at < KEPT { at } else { KEPT + spare };
        if at >= KEPT || !self.features[slot].known {
            self.features[slot].set(input, entry.triangle);
        }
        slot
    }

    /// Pairs of features that two triangles own.
    #[inline(always)]
    fn pair(&mut self, input: &Input, entries: &[Entry], one: usize, other: usize) {
        let (mut box_a, mut box_b) = (entries[one].aabb(), entries[other].aabb());
        let full_b = box_b;
        let one = self.features(input, &entries[one], one, 0);
        let other = self.features(input, &entries[other], other, 1);
        let (a, b) = (&self.features[one], &self.features[other]);
        let within_piece = input.paths.within_piece.filter(|_| a.piece == b.piece);
        if let Some(by) = within_piece {
            (box_a, box_b) = (box_a.shrink(by), box_b.shrink(by));
            if !box_a.overlaps(&full_b) {
                return;
            }
        }
        let (box_a, box_b) = (Spread::of(&box_a), Spread::of(&box_b));
        let (reach_a, reach_b) = (a.reach(&box_b), b.reach(&box_a));
        for (of, reach, face) in [(a, reach_a, b), (b, reach_b, a)] {
            for slot in bits(reach & of.vertices) {
                let vertex = of.ends[slot][0];
                if !face.corners.contains(&vertex) {
                    self.buffer.push(Candidate::vertex_face(vertex, face.corners));
                }
            }
        }
        let others = reach_b & b.edges;
        if others == 0 {
            return;
        }
        for slot in bits(reach_a & a.edges) {
            let edge = a.ends[slot];
            let mut own = a.spread(slot);
            if let Some(by) = within_piece {
                own.shrink(by.x);
            }
            for slot in bits(others & b.reach(&own)) {
                let other = b.ends[slot];
                let shared =
                    (edge[0] == other[0]) | (edge[0] == other[1]) | (edge[1] == other[0]) | (edge[1] == other[1]);
                if !shared {
                    self.buffer.push(Candidate::edge_edge(edge, other));
                }
            }
        }
    }
}
