//! Broad phase on a device [Li et al. 2020, Sec. 4.2 and 4.4], with the first part of the narrow phase: what comes back is what
//! a separating-axis test in f32 with error bounds could not prove apart.
//!
//! Finds what the native search finds, less what is proven apart, each pair once over all ranks: passes of `hash` (the
//! table), the host's split of the tests over ranks and batches from loads of chunks of buckets, then passes of `pairs`
//! into bounded buffers, which are read back. A buffer that is too small makes the pass be done again with a larger one or
//! for fewer tests; nothing is left out.
//!
//! Entries of a bucket are in no order, so ranks number its tests differently. Only a bucket that a rank shares with
//! another one, at most two per rank, must have an order: the host sorts its entries.

mod hash;
mod hash_cpu;
mod pairs;
mod pairs_cpu;
#[cfg(test)]
mod tests;

use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use bytemuck::Zeroable;

use super::boxes::Motion;
use super::{BroadError, BroadStats, Choice, CollisionMesh, Query, nanoseconds};
use crate::collision::Candidate;
use crate::gpu::{DeviceVec, Executor};
use hash::{CHUNK, Entries, HashParams, Shapes, Table};
use pairs::{BOXES_ONLY, BY_STENCIL, Found, PairParams, SEPARATION};

/// Most tests of a batch: twice as many are still a number of 32 bits.
const TESTS_MOST: u64 = (1 << 31) - 1;
/// Most tests of a dispatch: displays and drivers lose patience with long ones.
const TESTS_PER_PASS: u64 = 1 << 26;
/// Bits for the number of a piece.
const PIECE_BITS: u32 = 26;
/// Pairs of triangles that the buffer holds at first, per triangle and rank; candidates are fewer. And what both hold at
/// least.
const PAIRS_PER_TRIANGLE: usize = 8;
const ROOM_LEAST: usize = 4096;
/// Bytes of an array that every adapter can bind.
const BINDING_BYTES: usize = 128 << 20;

/// What may be dropped besides pairs whose boxes are apart.
#[derive(Clone, Copy, Debug)]
pub enum Filter<'a> {
    /// Nothing: the candidates of the native search.
    Boxes,
    /// Pairs proven farther apart than this on the whole way, by more than rounded closest points may be wrong.
    ByStencil {
        /// Distance of features of different pieces, metres.
        reach_m: f32,
        /// Per vertex: distance of features of one piece, metres. A vertex and a face have the vertex's, two edges the
        /// least of their ends.
        within_piece_m: &'a [f32],
    },
    /// Pairs proven farther apart than this on the whole way.
    Separation {
        /// Distance, metres.
        separation_m: f32,
    },
}

/// The broad phase of one mesh on one executor. Keeps its arrays from query to query.
pub struct DeviceBroad {
    mesh: Arc<CollisionMesh>,
    shapes: Shapes,
    reach_m: DeviceVec<f32>,
    table: Table,
    entries: Entries,
    found: Found,
}

/// The part of a rank's share of the tests that is done together.
struct Batch {
    chunks: Range<usize>,
    entries: u64,
    /// Tests of these chunks, and those of them that are the rank's, numbered within the batch.
    tests: u64,
    own: Range<u64>,
}

/// Corners, owned features and number of the piece per triangle.
fn faces(mesh: &CollisionMesh) -> Vec<[u32; 4]> {
    let mut numbers = vec![0u32; mesh.vertices];
    let mut next = 0;
    // The smallest vertex of a piece comes before its others.
    for (v, &piece) in mesh.pieces.iter().enumerate() {
        numbers[v] = if piece as usize == v { next } else { numbers[piece as usize] };
        next += u32::from(piece as usize == v);
    }
    let face = |(&[a, b, c], &owned): (&[u32; 3], &u8)| [a, b, c, u32::from(owned) | numbers[a as usize] << 6];
    mesh.triangles.iter().zip(&mesh.owned).map(face).collect()
}

impl DeviceBroad {
    /// Whether a mesh fits what every adapter binds. Not what this one binds: all ranks must have the same answer.
    pub fn fits(mesh: &CollisionMesh) -> bool {
        let binds = |items: usize, bytes: usize| items <= BINDING_BYTES / bytes;
        let triangles = mesh.triangles.len();
        let lists = binds(triangles, 32) && binds(hash::buckets(triangles), 16) && binds(mesh.vertices, 12);
        lists && mesh.vertices < 1 << PIECE_BITS
    }

    /// A broad phase over `mesh`, which fits.
    pub fn new(executor: &Executor, mesh: Arc<CollisionMesh>) -> DeviceBroad {
        DeviceBroad {
            shapes: Shapes {
                x_t0: DeviceVec::zeros(executor, 0),
                x_t1: None,
                faces: DeviceVec::upload(executor, &faces(&mesh)),
            },
            reach_m: DeviceVec::zeros(executor, 0),
            table: Table::new(executor, mesh.triangles.len()),
            entries: Entries::new(executor),
            found: Found::new(executor),
            mesh,
        }
    }

    /// Hands the candidates of this rank's share of the tests to `emit`, in no promised order. All ranks must pass the same
    /// mesh, positions, radii and filter, on executors of one kind; then all ranks together report each candidate once.
    ///
    /// None if some cells have too many entries or tests for one dispatch: no rank has reported anything then, and all have
    /// the same answer.
    ///
    /// # Errors
    /// As [`super::Broad::candidates`]; a fault of the device.
    pub fn search(
        &mut self,
        executor: &Executor,
        query: &Query,
        piece_radius_m: Option<f32>,
        filter: &Filter,
        (rank, ranks): (usize, usize),
        memory_limit_bytes: Option<u64>,
        emit: &mut dyn FnMut(&[Candidate]),
    ) -> Result<Option<BroadStats>, BroadError> {
        if rank >= ranks {
            return Err(BroadError::Rank { rank, ranks });
        }
        let started = Instant::now();
        let mesh = self.mesh.clone();
        let motion = Motion::new(&mesh, query, &Choice { piece_radius_m, ..Choice::default() })?;
        let params = HashParams::new(&mesh, &motion);
        self.upload(executor, query, filter);
        let loads = self.table.count(executor, &params, &self.shapes);
        let tests_total: u64 = loads.iter().map(|load| tests_of(*load)).sum();
        let most_entries = (BINDING_BYTES / size_of::<[u32; 2]>()) as u32;
        if loads.iter().any(|load| tests_of(*load) > TESTS_MOST || load[2] > most_entries) {
            return Ok(None);
        }
        let fixed = self.table.bytes() + self.shapes_bytes();
        let room = Room::new(executor, mesh.triangles.len() / ranks, fixed, memory_limit_bytes, &loads)?;
        let cut = |rank: usize| (u128::from(tests_total) * rank as u128 / ranks as u128) as u64;
        let batches = batches(&loads, &(cut(rank)..cut(rank + 1)), &room);
        let mut stats = BroadStats {
            tests_total,
            tests: cut(rank + 1) - cut(rank),
            cells: loads.iter().map(|load| u64::from(load[3])).sum(),
            bytes: fixed,
            batches: batches.len() as u64,
            count_ns: nanoseconds(started),
            ..BroadStats::default()
        };
        if memory_limit_bytes.is_some() {
            // What an earlier, unlimited query left must not count against this one.
            (self.entries, self.found) = (Entries::new(executor), Found::new(executor));
        }
        let pair_params = pair_params(&motion, filter);
        for batch in &batches {
            let started = Instant::now();
            let buckets = batch.chunks.start * CHUNK..(batch.chunks.end * CHUNK).min(params.buckets as usize);
            let of_batch = HashParams { first_bucket: buckets.start as u32, buckets: buckets.len() as u32, ..params };
            self.table.fill(executor, &of_batch, batch.entries as usize, &mut self.entries);
            self.order_shared(executor, batch, &of_batch);
            stats.fill_ns += nanoseconds(started);
            stats.entries += batch.entries;
            let started = Instant::now();
            let pass = PairParams { first_bucket: of_batch.first_bucket, buckets: of_batch.buckets, ..pair_params };
            stats.candidates += self.test(executor, &pass, batch.own.clone(), &room, emit)?;
            stats.test_ns += nanoseconds(started);
            stats.bytes = stats.bytes.max(fixed + self.entries.bytes() + self.found.bytes());
        }
        executor.take_fault().map_or(Ok(Some(stats)), |fault| Err(BroadError::Device(fault)))
    }

    fn upload(&mut self, executor: &Executor, query: &Query, filter: &Filter) {
        self.shapes.x_t0.assign(executor, query.x_t0);
        if std::ptr::eq(query.x_t0, query.x_t1) {
            self.shapes.x_t1 = None;
        } else {
            let end = self.shapes.x_t1.get_or_insert_with(|| DeviceVec::zeros(executor, 0));
            end.assign(executor, query.x_t1);
        }
        if let Filter::ByStencil { within_piece_m, .. } = filter {
            self.reach_m.assign(executor, within_piece_m);
        }
    }

    fn shapes_bytes(&self) -> u64 {
        self.shapes.faces.held_bytes() + self.reach_m.held_bytes()
    }

    /// Sorts the entries of the buckets that the rank's share begins or ends in.
    fn order_shared(&mut self, executor: &Executor, batch: &Batch, params: &HashParams) {
        let last = batch.chunks.len() - 1;
        for (chunk, cut) in [(0, batch.own.start), (last, batch.own.end)] {
            if cut == 0 || cut == batch.tests {
                continue;
            }
            let first = chunk * CHUNK;
            let mut starts = vec![0; CHUNK.min(params.buckets as usize - first) + 1];
            self.entries.test_starts.read_range(executor, first, &mut starts);
            let place = starts.partition_point(|&start| u64::from(start) <= cut);
            if place == 0 || place == starts.len() || u64::from(starts[place - 1]) == cut {
                continue;
            }
            let bucket = first + place - 1;
            let (mut load, mut start) = ([[0; 4]], [0]);
            self.table.counts.read_range(executor, params.first_bucket as usize + bucket, &mut load);
            self.entries.starts.read_range(executor, bucket, &mut start);
            let load = load[0].map(|count| count as usize);
            let mut entries = vec![[0; 2]; load.iter().sum()];
            self.entries.entries.read_range(executor, start[0] as usize, &mut entries);
            let mut rest = &mut entries[..];
            for count in load {
                let (class, others) = rest.split_at_mut(count);
                class.sort_unstable();
                rest = others;
            }
            self.entries.entries.write_range(executor, start[0] as usize, &entries);
        }
    }

    /// The tests `own` of a batch; how many candidates there were.
    fn test(
        &mut self,
        executor: &Executor,
        params: &PairParams,
        own: Range<u64>,
        room: &Room,
        emit: &mut dyn FnMut(&[Candidate]),
    ) -> Result<u64, BroadError> {
        let (mut reported, mut first, mut step) = (0, own.start, TESTS_PER_PASS);
        if self.found.pairs.is_empty() {
            self.found.pairs.resize(executor, room.first_pairs);
            self.found.candidates.resize(executor, (room.first_pairs / 8).max(ROOM_LEAST).min(room.candidates));
        }
        while first < own.end {
            let end = own.end.min(first + step);
            let pass = PairParams { first_test: first as u32, end_test: end as u32, ..*params };
            let pairs = self.found.box_tests(executor, &pass, &self.table, &self.entries);
            if pairs > self.found.pairs.len() {
                if self.found.pairs.len() < room.pairs {
                    self.found.pairs.resize(executor, pairs.min(room.pairs));
                }
                if pairs > room.pairs {
                    step = (step / 2).max(1);
                }
                continue;
            }
            reported += self.features(executor, &pass, pairs, room, emit);
            if let Some(fault) = executor.take_fault() {
                return Err(BroadError::Device(fault));
            }
            first = end;
        }
        Ok(reported)
    }

    /// The features of all pairs of triangles in the buffer; how many candidates there were.
    fn features(
        &mut self,
        executor: &Executor,
        params: &PairParams,
        pairs: usize,
        room: &Room,
        emit: &mut dyn FnMut(&[Candidate]),
    ) -> u64 {
        let (mut reported, mut first, mut step) = (0, 0, pairs);
        let mut list = Vec::new();
        while first < pairs {
            let end = pairs.min(first + step);
            let pass = PairParams { first_pair: first as u32, end_pair: end as u32, ..*params };
            let count = self.found.feature_pairs(executor, &pass, &self.table, &self.shapes, &self.reach_m);
            if count > self.found.candidates.len() {
                if self.found.candidates.len() < room.candidates {
                    self.found.candidates.resize(executor, count.min(room.candidates));
                }
                if count > room.candidates {
                    step = (step / 2).max(1);
                }
                continue;
            }
            list.resize(count, Candidate::zeroed());
            self.found.candidates.read_range(executor, 0, &mut list);
            emit(&list);
            reported += count as u64;
            first = end;
        }
        reported
    }
}

fn tests_of([low, high, ..]: [u32; 4]) -> u64 {
    u64::from(low) | u64::from(high) << 32
}

fn pair_params(motion: &Motion, filter: &Filter) -> PairParams {
    let (filter_kind, separation_m) = match *filter {
        Filter::Boxes => (BOXES_ONLY, 0.0),
        Filter::ByStencil { reach_m, .. } => (BY_STENCIL, reach_m),
        Filter::Separation { separation_m } => (SEPARATION, separation_m),
    };
    PairParams {
        filter_kind,
        separation_m,
        pad_m: motion.pad_m(),
        shrink_m: motion.within_piece.map_or(0.0, |by| by.x),
        ..PairParams::zeroed()
    }
}

/// How much fits at once.
struct Room {
    buckets: u64,
    entries: u64,
    pairs: usize,
    candidates: usize,
    /// Pairs to make room for at first.
    first_pairs: usize,
}

impl Room {
    /// Half of what `fixed` leaves of the limit is for entries, a quarter each for pairs and candidates.
    fn new(
        executor: &Executor,
        triangles: usize,
        fixed: u64,
        limit_bytes: Option<u64>,
        loads: &[[u32; 4]],
    ) -> Result<Room, BroadError> {
        let binds = |bytes: usize| match executor {
            Executor::Cpu(_) => u32::MAX as usize,
            Executor::Gpu(gpu) => gpu.window_items(bytes),
        };
        let (item, candidate) = (size_of::<[u32; 2]>(), size_of::<Candidate>());
        let wanted = (PAIRS_PER_TRIANGLE * triangles).max(ROOM_LEAST);
        let mut room = Room {
            buckets: binds(16) as u64,
            entries: binds(item) as u64,
            pairs: binds(item),
            candidates: binds(candidate),
            first_pairs: wanted.min(binds(item)),
        };
        let Some(limit_bytes) = limit_bytes else { return Ok(room) };
        // Arrays may be an eighth larger than asked for.
        let free = limit_bytes.saturating_sub(fixed) / 9 * 8;
        let fullest = loads.iter().map(|load| u64::from(load[2])).max().unwrap_or(0);
        let least = Entries::bytes_for(CHUNK as u64, fullest);
        let least = least.max((ROOM_LEAST * candidate) as u64) * 4;
        if free < least {
            return Err(BroadError::MemoryLimit { needs_bytes: fixed + least / 8 * 9 + 9, limit_bytes });
        }
        // An eighth for what belongs to buckets, three eighths for entries.
        room.buckets = room.buckets.min(free / 8 / Entries::bytes_for(1, 0)).max(CHUNK as u64);
        room.entries = room.entries.min(free * 3 / 8 / item as u64).max(fullest);
        room.pairs = room.pairs.min((free / 4) as usize / item);
        room.candidates = room.candidates.min((free / 4) as usize / candidate);
        room.first_pairs = room.first_pairs.min(room.pairs);
        Ok(room)
    }
}

/// The chunks that hold the tests `share`, as few batches as fit.
fn batches(loads: &[[u32; 4]], share: &Range<u64>, room: &Room) -> Vec<Batch> {
    let mut batches: Vec<Batch> = Vec::new();
    let mut before = 0;
    for (chunk, load) in loads.iter().enumerate() {
        let (first, entries) = (before, u64::from(load[2]));
        before += tests_of(*load);
        let own = share.start.max(first)..share.end.min(before);
        if own.is_empty() {
            continue;
        }
        let own = own.start - first..own.end - first;
        let tests = before - first;
        let buckets = |start: usize| ((chunk + 1 - start) * CHUNK) as u64;
        match batches.last_mut() {
            Some(last)
                // Chunks in between have no tests, so no entries either.
                if last.entries + entries <= room.entries
                    && last.tests + tests <= TESTS_MOST
                    && buckets(last.chunks.start) <= room.buckets =>
            {
                last.own.end = last.tests + own.end;
                last.entries += entries;
                last.tests += tests;
                last.chunks.end = chunk + 1;
            }
            _ => batches.push(Batch { chunks: chunk..chunk + 1, entries, tests, own }),
        }
    }
    batches
}
