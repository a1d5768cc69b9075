//! Batches of chunks of buckets, as large as bindings and the memory limit allow. Host code that works on loads only.

use std::ops::Range;

use super::hash::{CHUNK, DeviceEntries};
use crate::collision::Candidate;
use crate::collision::broad::BroadError;
use crate::gpu::Executor;

/// Most tests of a batch: twice as many are still a number of 32 bits.
const TESTS_MOST: u64 = (1 << 31) - 1;
/// Pairs of triangles that the buffer holds at first, and at most, per triangle and rank: more come in turns, so that memory
/// shrinks with the number of ranks even where pairs crowd. Candidates are fewer. And what both hold at least.
const PAIRS_PER_TRIANGLE: usize = 8;
const PAIRS_PER_TRIANGLE_MOST: usize = 16;
const ROOM_LEAST: usize = 4096;
/// A batch holds at least this many entries if the memory limit allows it.
const ENTRIES_TOGETHER: u64 = 1 << 12;
/// Bytes of an array that every adapter can bind.
pub(super) const BINDING_BYTES: usize = 128 << 20;

/// Consecutive buckets of one layer: first and end, counted from the first of the window; tests, entries and busy buckets.
#[derive(Clone, Copy)]
pub(super) struct Chunk {
    pub buckets: [u32; 2],
    pub tests: u64,
    pub entries: u64,
    pub busy: u32,
}

impl Chunk {
    /// From what the device counted.
    pub(super) fn new(buckets: [u32; 2], [low, high, entries, busy]: [u32; 4]) -> Chunk {
        let tests = u64::from(low) | u64::from(high) << 32;
        Chunk { buckets, tests, entries: u64::from(entries), busy }
    }

    /// True if the chunk is too large for one dispatch.
    pub(super) fn is_too_much(&self) -> bool {
        self.tests > TESTS_MOST || self.entries > (BINDING_BYTES / size_of::<[u32; 2]>()) as u64
    }
}

/// The part of a rank's share of the tests that is done together.
pub(super) struct ChunkBatch {
    /// First bucket and end.
    pub buckets: [u32; 2],
    /// Buckets and ends of the first and of the last chunk.
    pub ends: [[u32; 2]; 2],
    pub entries: u64,
    /// Tests of these buckets, and those of them that are the rank's, numbered within the batch.
    pub tests: u64,
    pub own: Range<u64>,
}

/// Capacities of a batch and of the buffers.
pub(super) struct Room {
    buckets: u64,
    entries: u64,
    pub pairs: usize,
    pub candidates: usize,
    /// Pairs and candidates to make room for at first.
    pub first_pairs: usize,
    pub first_candidates: usize,
}

/// Numbers that [`Room`] is computed from.
pub(super) struct Wanted<'a> {
    pub chunks: &'a [Chunk],
    /// Triangles and entries of a rank if they were even.
    pub triangles: usize,
    pub entries: u64,
    /// Bytes that are needed besides.
    pub fixed: u64,
}

impl Room {
    /// Half of what `fixed` leaves of the limit is for entries, a quarter each for pairs and candidates.
    pub(super) fn new(executor: &Executor, wanted: &Wanted, limit_bytes: Option<u64>) -> Result<Room, BroadError> {
        let binds = |bytes: usize| executor.window_items(bytes).unwrap_or(u32::MAX as usize);
        let (item, candidate) = (size_of::<[u32; 2]>(), size_of::<Candidate>());
        let fullest = wanted.chunks.iter().map(|chunk| chunk.entries).max().unwrap_or(0);
        // An even share of the tests may need more entries than an even share of the entries, where cells are emptier.
        // The bound makes memory shrink with the number of ranks.
        let together = (wanted.entries + wanted.entries / 8).max(ENTRIES_TOGETHER);
        let pairs = |per_triangle: usize| (per_triangle * wanted.triangles).max(ROOM_LEAST).min(binds(item));
        let candidates = |pairs: usize, part: usize| (pairs / part).max(ROOM_LEAST).min(binds(candidate));
        let (first_pairs, most_pairs) = (pairs(PAIRS_PER_TRIANGLE), pairs(PAIRS_PER_TRIANGLE_MOST));
        let mut room = Room {
            buckets: binds(16) as u64,
            entries: (binds(item) as u64).min(together).max(fullest),
            pairs: most_pairs,
            candidates: candidates(most_pairs, 4),
            first_pairs,
            first_candidates: candidates(first_pairs, 8),
        };
        let Some(limit_bytes) = limit_bytes else { return Ok(room) };
        // Arrays may be an eighth larger than asked for.
        let free = limit_bytes.saturating_sub(wanted.fixed) / 9 * 8;
        let least = DeviceEntries::bytes_for(CHUNK as u64, fullest);
        let least = least.max((ROOM_LEAST * candidate) as u64) * 4;
        if free < least {
            return Err(BroadError::MemoryLimit { needs_bytes: wanted.fixed + least / 8 * 9 + 9, limit_bytes });
        }
        // An eighth for arrays per bucket, three eighths for entries.
        room.buckets = room.buckets.min(free / 8 / DeviceEntries::bytes_for(1, 0)).max(CHUNK as u64);
        room.entries = room.entries.min(free * 3 / 8 / item as u64).max(fullest);
        room.pairs = room.pairs.min((free / 4) as usize / item);
        room.candidates = room.candidates.min((free / 4) as usize / candidate);
        room.first_pairs = room.first_pairs.min(room.pairs);
        room.first_candidates = room.first_candidates.min(room.candidates);
        Ok(room)
    }
}

/// Number of items to try next if `items` of them produced `found` results and there is room for `room`.
pub(super) fn fewer(items: u64, found: usize, room: usize) -> u64 {
    (u128::from(items) * room as u128 * 7 / 8 / found as u128).max(1) as u64
}

/// The chunks that hold the tests `share`, numbered from the first of the window, as few batches as fit.
pub(super) fn batches(chunks: &[Chunk], share: &Range<u64>, room: &Room) -> Vec<ChunkBatch> {
    let mut batches: Vec<ChunkBatch> = Vec::new();
    let mut before = 0;
    for chunk in chunks {
        let first = before;
        before += chunk.tests;
        let own = share.start.max(first)..share.end.min(before);
        if own.is_empty() {
            continue;
        }
        let own = own.start - first..own.end - first;
        match batches.last_mut() {
            Some(last)
                // Chunks in between have no tests, so no entries either.
                if last.entries + chunk.entries <= room.entries
                    && last.tests + chunk.tests <= TESTS_MOST
                    && u64::from(chunk.buckets[1] - last.buckets[0]) <= room.buckets =>
            {
                last.own.end = last.tests + own.end;
                last.entries += chunk.entries;
                last.tests += chunk.tests;
                last.buckets[1] = chunk.buckets[1];
                last.ends[1] = chunk.buckets;
            }
            _ => batches.push(ChunkBatch {
                buckets: chunk.buckets,
                ends: [chunk.buckets; 2],
                entries: chunk.entries,
                tests: chunk.tests,
                own,
            }),
        }
    }
    batches
}
