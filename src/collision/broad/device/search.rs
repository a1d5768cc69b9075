//! The search on a device, from positions to candidates: batches, tests in bounded buffers that grow, and the order of
//! the buckets that ranks share.

use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use bytemuck::Zeroable;

use super::batches::{BINDING_BYTES, ChunkBatch, Room, Wanted, batches, fewer};
use super::count::Counter;
use super::hash::{DeviceEntries, HashParams};
use super::pairs::{BOXES_ONLY, BY_PAIR, FoundPairs, PairParams, SEPARATION};
use super::space::Nested;
use crate::collision::Candidate;
use crate::collision::broad::active::ActivePatches;
use crate::collision::broad::boxes::Trajectories;
use crate::collision::broad::input::Input;
use crate::collision::broad::{BroadError, BroadStats, Choice, CollisionMesh, Filter, Search, Split, nanoseconds};
use crate::gpu::{CpuExecutor, DeviceVec, Executor};

/// Most tests of a dispatch: displays and drivers lose patience with long ones.
const TESTS_PER_PASS: u64 = 1 << 26;
/// Bits for the number of a piece in [`super::count::face`].
const PIECE_BITS: u32 = 26;

/// The broad phase of one mesh on one executor. Keeps its arrays from query to query.
pub struct DeviceBroad {
    mesh: Arc<CollisionMesh>,
    active: ActivePatches,
    counter: Counter,
    /// Per vertex: see [`Filter::ByPair`].
    reach_m: DeviceVec<f32>,
    entries: DeviceEntries,
    found: FoundPairs,
}

impl DeviceBroad {
    /// True if a mesh fits the bindings that every adapter offers. This adapter's own limits do not count, because all
    /// ranks must have the same answer.
    pub fn fits(mesh: &CollisionMesh) -> bool {
        let binds = |items: usize, bytes: usize| items <= BINDING_BYTES / bytes;
        binds(mesh.triangles.len(), 32) && binds(mesh.vertices, 12) && mesh.vertices < 1 << PIECE_BITS
    }

    /// A broad phase over `mesh`, which fits.
    pub fn new(executor: &Executor, mesh: Arc<CollisionMesh>) -> DeviceBroad {
        DeviceBroad {
            active: ActivePatches::new(&mesh),
            counter: Counter::new(executor, &mesh),
            reach_m: DeviceVec::zeros(executor, 0),
            entries: DeviceEntries::new(executor),
            found: FoundPairs::new(executor),
            mesh,
        }
    }

    /// Bytes of what follows from the mesh alone; every rank holds all of it.
    pub fn mesh_bytes(&self) -> u64 {
        self.active.mesh_bytes() + self.counter.mesh_bytes() + self.reach_m.held_bytes()
    }

    /// Hands the candidates of this rank's share of the tests to `emit`, in no promised order. All ranks must pass the
    /// same mesh and search, on executors of one kind; then all ranks together report each candidate once, less what
    /// the search leaves out. Its touched vertices are not looked at. `host` looks at patches.
    ///
    /// None if some cells have too many entries or tests for one dispatch: no rank has reported anything then, and all
    /// have the same answer.
    ///
    /// # Errors
    /// As `Broad::search`; a fault of the device.
    pub fn search(
        &mut self,
        (executor, host): (&Executor, &CpuExecutor),
        search: &Search,
        split: &mut Split,
        emit: &mut dyn FnMut(&[Candidate]),
    ) -> Result<Option<BroadStats>, BroadError> {
        let (rank, ranks) = split.place();
        if rank >= ranks {
            return Err(BroadError::Rank { rank, ranks });
        }
        let started = Instant::now();
        let mesh = self.mesh.clone();
        let choice = Choice { touched: None, ..search.choice };
        let input = Input::new(&mesh, Trajectories::new(&mesh, &search.query, &choice)?, choice);
        let nested = Nested::new(&input.grid);
        self.active.find(host, &input, |aabb| nested.may_be_large(aabb), split)?;
        let patches = &self.active.patches;
        let mut stats = BroadStats {
            patches: [patches.active.len() as u64, patches.count() as u64],
            bytes: patches.bytes(),
            ..BroadStats::default()
        };
        if patches.active.is_empty() {
            stats.count_ns = nanoseconds(started);
            return Ok(Some(stats));
        }
        if search.memory_limit_bytes.is_some() {
            // Arrays of an earlier query must not count against this one.
            self.counter.drop_arrays(executor);
            (self.entries, self.found) = (DeviceEntries::new(executor), FoundPairs::new(executor));
        }
        self.counter.upload(executor, &search.query);
        if let Filter::ByPair { within_piece_m, .. } = search.filter {
            self.reach_m.assign(executor, within_piece_m);
        }
        let Some(counted) = self.counter.count(executor, &input, patches, split)? else { return Ok(None) };
        let fixed = patches.bytes() + self.counter.bytes() + counted.host_bytes;
        let active = patches.active.iter().map(|&patch| patches.triangles(patch as usize).len());
        let wanted = Wanted {
            chunks: &counted.chunks,
            triangles: active.sum::<usize>() / ranks,
            entries: counted.workload.entries.div_ceil(ranks as u64),
            fixed,
        };
        let room = Room::new(executor, &wanted, search.memory_limit_bytes)?;
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
        let pair_params = pair_params(&input.paths, &search.filter);
        for batch in &batches {
            let started = Instant::now();
            let [first, end] = batch.buckets;
            let of_batch = HashParams { first_bucket: first, buckets: end - first, ..counted.params };
            self.counter.table.fill(executor, &of_batch, batch.entries as usize, &mut self.entries);
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

    /// Sorts the entries of the buckets that the rank's share begins or ends in.
    fn order_shared(&mut self, executor: &Executor, batch: &ChunkBatch) {
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
            self.counter.table.counts.read_range(executor, batch.buckets[0] as usize + bucket, &mut load);
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
            let pairs = self.found.box_tests(executor, &pass, &self.counter.table, &self.entries);
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
            let count =
                self.found.feature_pairs(executor, &pass, &self.counter.table, &self.counter.shapes, &self.reach_m);
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

pub(super) fn pair_params(paths: &Trajectories, filter: &Filter) -> PairParams {
    let (filter_kind, separation_m) = match *filter {
        Filter::Boxes => (BOXES_ONLY, 0.0),
        Filter::ByPair { reach_m, .. } => (BY_PAIR, reach_m),
        Filter::Separation { separation_m } => (SEPARATION, separation_m),
    };
    PairParams {
        filter_kind,
        separation_m,
        pad_m: paths.pad_m(),
        shrink_m: paths.within_piece.map_or(0.0, |by| by.x),
        ..PairParams::zeroed()
    }
}
