//! The tests: boxes of triangles within a bucket, then boxes of the features that the two triangles own.

use std::ops::Range;

use super::boxes::Aabb;
use super::fill::{Entries, rows};
use super::grid::Entry;
use super::mesh::edge_of;
use super::table::{Input, Load, Table};
use super::workload::Batch;
use crate::collision::Candidate;

/// Candidates handed over at once, at most.
pub(super) const BUFFER: usize = 4096;
/// Most candidates of a pair of triangles: 3 + 3 vertices, 3 x 3 edges.
const PER_PAIR: usize = 15;
/// Triangles of a bucket whose feature boxes are kept; in a larger bucket they are formed per pair.
const KEPT: usize = 128;
/// Box tests between two looks at what they found.
const STRIDE: usize = 64;

/// Boxes of the vertices and edges of a triangle.
#[derive(Clone, Copy)]
struct Features {
    corners: [u32; 3],
    owned: u8,
    known: bool,
    vertices: [Aabb; 3],
    edges: [Aabb; 3],
}

const UNKNOWN: Features =
    Features { corners: [0; 3], owned: 0, known: false, vertices: [Aabb::EMPTY; 3], edges: [Aabb::EMPTY; 3] };

impl Features {
    #[inline(always)]
    fn of(input: &Input, triangle: u32) -> Features {
        let corners = input.mesh.triangles[triangle as usize];
        let vertices = corners.map(|v| input.motion.vertex(v));
        // Widening is monotone, so the union of widened boxes is the widened union.
        let edges = [0, 1, 2].map(|k| vertices[k].join(vertices[(k + 1) % 3]));
        Features { corners, owned: input.mesh.owned[triangle as usize], known: true, vertices, edges }
    }

    /// Which owned features overlap a box; bits as in [`super::CollisionMesh::owned`].
    #[inline(always)]
    fn reach(&self, other: &Aabb) -> u8 {
        let mut reach = 0;
        for k in 0..3 {
            reach |= u8::from(self.vertices[k].overlaps(other)) << k;
            reach |= u8::from(self.edges[k].overlaps(other)) << (3 + k);
        }
        reach & self.owned
    }
}

/// Buffers of one thread.
pub(super) struct Tester {
    features: Vec<Features>,
    buffer: Vec<Candidate>,
    /// Candidates found since the start.
    pub found: u64,
    /// Box tests of triangles made since the start.
    pub tested: u64,
}

impl Tester {
    pub fn new() -> Tester {
        Tester { features: vec![UNKNOWN; KEPT], buffer: Vec::with_capacity(BUFFER), found: 0, tested: 0 }
    }

    /// Bytes of the buffers.
    pub fn bytes() -> u64 {
        (KEPT * size_of::<Features>() + BUFFER * size_of::<Candidate>()) as u64
    }

    /// The tests of the rank in `buckets` of a batch.
    pub fn run(
        &mut self,
        input: &Input,
        table: &Table,
        entries: &Entries,
        batch: &Batch,
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
            // Which ones meet is hard to predict, so the loop does not branch on it.
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

    #[inline(always)]
    fn features(&mut self, input: &Input, entries: &[Entry], at: usize) -> Features {
        if at >= KEPT {
            return Features::of(input, entries[at].triangle);
        }
        if !self.features[at].known {
            self.features[at] = Features::of(input, entries[at].triangle);
        }
        self.features[at]
    }

    /// Pairs of features that two triangles own.
    #[inline(always)]
    fn pair(&mut self, input: &Input, entries: &[Entry], one: usize, other: usize) {
        let (box_a, box_b) = (entries[one].aabb(), entries[other].aabb());
        let a = self.features(input, entries, one);
        let b = self.features(input, entries, other);
        let (reach_a, reach_b) = (a.reach(&box_b), b.reach(&box_a));
        for (of, reach, face) in [(&a, reach_a, &b), (&b, reach_b, &a)] {
            for k in 0..3 {
                if reach >> k & 1 == 1 && !face.corners.contains(&of.corners[k]) {
                    self.buffer.push(Candidate::vertex_face(of.corners[k], face.corners));
                }
            }
        }
        if reach_a >> 3 == 0 || reach_b >> 3 == 0 {
            return;
        }
        for i in (0..3).filter(|i| reach_a >> (3 + i) & 1 == 1) {
            let edge = edge_of(a.corners, i);
            for j in (0..3).filter(|j| reach_b >> (3 + j) & 1 == 1) {
                let other = edge_of(b.corners, j);
                let apart = edge[0] != other[0] && edge[0] != other[1] && edge[1] != other[0] && edge[1] != other[1];
                if apart && a.edges[i].overlaps(&b.edges[j]) {
                    self.buffer.push(Candidate::edge_edge(edge, other));
                }
            }
        }
    }
}
