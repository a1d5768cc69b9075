//! Broad phase on a device [Li et al. 2020, Sec. 4.2 and 4.4], with the first part of the narrow phase: what comes back is what
//! a separating-axis test in f32 with error bounds could not prove apart.
//!
//! Finds what the native search finds, less what is proven apart, each pair once over all ranks. The host looks at patches of
//! triangles as in a native search, which leaves out what culling proves free and says which layers of space a rank counts
//! (`space`); then come passes of `hash` (the table of these layers), the host's split of the tests over ranks and batches
//! from loads of chunks of buckets, and passes of `pairs` into bounded buffers, which are read back. A buffer that is too
//! small makes the pass be done again with a larger one or for fewer tests; nothing is left out.
//!
//! Entries of a bucket are in no order, so ranks number its tests differently. Only a bucket that a rank shares with
//! another one, at most two per rank, must have an order: the host sorts its entries.

mod batches;
mod count;
mod hash;
mod hash_cpu;
mod pairs;
mod pairs_cpu;
mod space;
#[cfg(test)]
mod tests;

use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use bytemuck::Zeroable;

use super::boxes::Motion;
use super::input::Input;
use super::patches::Patches;
use super::split::Split;
use super::{BroadError, BroadStats, Choice, CollisionMesh, Query, nanoseconds};
use crate::collision::Candidate;
use crate::gpu::{CpuExecutor, DeviceVec, Executor};
use batches::{BINDING_BYTES, Batch, Room, Wanted, batches, fewer};
use hash::{Entries, HashParams, Shapes, Table};
use pairs::{BOXES_ONLY, BY_STENCIL, Found, PairParams, SEPARATION};
use space::Nested;

/// Most tests of a dispatch: displays and drivers lose patience with long ones.
const TESTS_PER_PASS: u64 = 1 << 26;
/// Bits for the number of a piece.
const PIECE_BITS: u32 = 26;
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
    /// Per vertex the number of its piece.
    pieces: Vec<u32>,
    patches: Patches,
    shapes: Shapes,
    /// The triangles whose faces are on the device.
    members: Vec<u32>,
    reach_m: DeviceVec<f32>,
    table: Table,
    entries: Entries,
    found: Found,
}

/// Pieces numbered from 0.
fn numbered_pieces(mesh: &CollisionMesh) -> Vec<u32> {
    let mut numbers = vec![0u32; mesh.vertices];
    let mut next = 0;
    // The smallest vertex of a piece comes before its others.
    for (v, &piece) in mesh.pieces.iter().enumerate() {
        numbers[v] = if piece as usize == v { next } else { numbers[piece as usize] };
        next += u32::from(piece as usize == v);
    }
    numbers
}

impl DeviceBroad {
    /// Whether a mesh fits what every adapter binds. Not what this one binds: all ranks must have the same answer.
    pub fn fits(mesh: &CollisionMesh) -> bool {
        let binds = |items: usize, bytes: usize| items <= BINDING_BYTES / bytes;
        binds(mesh.triangles.len(), 32) && binds(mesh.vertices, 12) && mesh.vertices < 1 << PIECE_BITS
    }

    /// A broad phase over `mesh`, which fits.
    pub fn new(executor: &Executor, mesh: Arc<CollisionMesh>) -> DeviceBroad {
        DeviceBroad {
            pieces: numbered_pieces(&mesh),
            patches: Patches::new(&mesh),
            shapes: Shapes { x_t0: DeviceVec::zeros(executor, 0), x_t1: None, faces: DeviceVec::zeros(executor, 0) },
            members: Vec::new(),
            reach_m: DeviceVec::zeros(executor, 0),
            table: Table::new(executor),
            entries: Entries::new(executor),
            found: Found::new(executor),
            mesh,
        }
    }

    /// Bytes of what follows from the mesh alone; every rank holds all of it.
    pub fn mesh_bytes(&self) -> u64 {
        self.patches.mesh_bytes() + size_of_val(&self.pieces[..]) as u64 + self.reach_m.held_bytes()
    }

    /// Hands the candidates of this rank's share of the tests to `emit`, in no promised order. All ranks must pass the same
    /// mesh, positions, choice and filter, on executors of one kind; then all ranks together report each candidate once, less
    /// what `choice` leaves out. Its touched vertices are not looked at. `host` looks at patches.
    ///
    /// None if some cells have too many entries or tests for one dispatch: no rank has reported anything then, and all have
    /// the same answer.
    ///
    /// # Errors
    /// As [`super::Broad::search`]; a fault of the device.
    pub fn search(
        &mut self,
        (executor, host): (&Executor, &CpuExecutor),
        query: &Query,
        choice: &Choice,
        filter: &Filter,
        split: &mut Split,
        memory_limit_bytes: Option<u64>,
        emit: &mut dyn FnMut(&[Candidate]),
    ) -> Result<Option<BroadStats>, BroadError> {
        let (rank, ranks) = split.place();
        if rank >= ranks {
            return Err(BroadError::Rank { rank, ranks });
        }
        let started = Instant::now();
        let mesh = self.mesh.clone();
        let choice = Choice { touched: None, ..*choice };
        let input = Input::new(&mesh, Motion::new(&mesh, query, &choice)?, choice);
        let nested = Nested::new(&input.grid);
        self.patches.look(host, &input, |aabb| nested.may_be_large(aabb), split)?;
        let mut stats = BroadStats {
            patches: [self.patches.active.len() as u64, self.patches.count() as u64],
            bytes: self.patches.bytes(),
            ..BroadStats::default()
        };
        if self.patches.active.is_empty() {
            stats.count_ns = nanoseconds(started);
            return Ok(Some(stats));
        }
        if memory_limit_bytes.is_some() {
            // What an earlier query left must not count against this one.
            self.drop_arrays(executor);
        }
        self.upload(executor, query, filter);
        let Some(counted) = self.count(executor, &input, split)? else { return Ok(None) };
        let fixed = self.patches.bytes() + self.shapes.faces.held_bytes() + self.table.bytes() + counted.host_bytes;
        let active = self.patches.active.iter().map(|&patch| self.patches.triangles(patch as usize).len());
        let wanted = Wanted {
            chunks: &counted.chunks,
            triangles: active.sum::<usize>() / ranks,
            entries: counted.workload.entries.div_ceil(ranks as u64),
            fixed,
        };
        let room = Room::new(executor, &wanted, memory_limit_bytes)?;
        let batches = batches(&counted.chunks, &counted.share, &room);
        stats = BroadStats {
            tests_total: counted.workload.tests,
            tests: counted.share.end - counted.share.start,
            cells: counted.workload.busy,
            bytes: fixed,
            batches: batches.len() as u64,
            count_ns: nanoseconds(started),
            ..stats
        };
        let pair_params = pair_params(&input.motion, filter);
        for batch in &batches {
            let started = Instant::now();
            let [first, end] = batch.buckets;
            let of_batch = HashParams { first_bucket: first, buckets: end - first, ..counted.params };
            self.table.fill(executor, &of_batch, batch.entries as usize, &mut self.entries);
            self.order_shared(executor, batch);
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

    /// Gives back what queries leave for the next one.
    fn drop_arrays(&mut self, executor: &Executor) {
        self.members = Vec::new();
        self.shapes.faces = DeviceVec::zeros(executor, 0);
        self.table = Table::new(executor);
        (self.entries, self.found) = (Entries::new(executor), Found::new(executor));
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

    /// Sorts the entries of the buckets that the rank's share begins or ends in.
    fn order_shared(&mut self, executor: &Executor, batch: &Batch) {
        for ([start, end], cut) in [(batch.ends[0], batch.own.start), (batch.ends[1], batch.own.end)] {
            if cut == 0 || cut == batch.tests {
                continue;
            }
            let first = (start - batch.buckets[0]) as usize;
            let mut starts = vec![0; (end - start) as usize + 1];
            self.entries.test_starts.read_range(executor, first, &mut starts);
            let place = starts.partition_point(|&start| u64::from(start) <= cut);
            if place == 0 || place == starts.len() || u64::from(starts[place - 1]) == cut {
                continue;
            }
            let bucket = first + place - 1;
            let (mut load, mut start) = ([[0; 4]], [0]);
            self.table.counts.read_range(executor, batch.buckets[0] as usize + bucket, &mut load);
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
            self.found.candidates.resize(executor, room.first_candidates);
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
                    step = fewer(end - first, pairs, room.pairs);
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
                    step = fewer((end - first) as u64, count, room.candidates) as usize;
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
