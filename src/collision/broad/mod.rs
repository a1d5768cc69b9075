//! Broad phase: pairs of features whose swept, inflated boxes overlap, found with a triangle hash table and split evenly
//! over the ranks by a workload table [Li et al. 2020, Sec. 4.2 and 4.4].
//!
//! Passes: look (boxes of patches of triangles, which of them take part), count (triangles per bucket of the layers that
//! this rank guesses to be its own), scan (tests per bucket and layer, share of this rank), then per batch of buckets fill
//! and test. Each is loops over flat arrays. Ranks that work together look at an even part of the patches each and count a
//! part of the layers each; see [`Split`]. Promises the same *set* of pairs for any number of ranks, threads and batches,
//! each pair once over all ranks; not an order. Does not say whether anything touches.

mod boxes;
mod brute;
mod contour;
mod cull;
mod device;
mod features;
mod fill;
mod grid;
mod input;
mod layers;
mod mesh;
mod pairs;
mod patches;
mod split;
mod table;
mod workload;

use std::ops::Range;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use thiserror::Error;

pub use brute::brute_force;
pub use device::{DeviceBroad, Filter};
pub use mesh::{CollisionMesh, CollisionMeshError};
pub use split::Split;

use crate::collision::Candidate;
use crate::gpu::{CpuExecutor, GpuError};
use crate::transport::TransportError;
use boxes::Motion;
use fill::Entries;
use input::Input;
use pairs::Tester;
use patches::Patches;
use table::Table;
use workload::{Batch, LayerLoad, Workload, layers_of};

/// Patches from which on ranks do a part each of what all need: below, hearing of each other takes longer.
const PATCHES_TOGETHER: usize = 256;
/// Entries that are always made at once if the memory limit allows it.
const ENTRIES_TOGETHER: u64 = 1 << 12;
/// Buckets per unit of work of the test pass.
const GRAIN: usize = 256;

/// What to search.
#[derive(Clone, Copy, Debug)]
pub struct Query<'a> {
    /// Start positions, metres: x, y, z of every vertex, obstacles included.
    pub x_t0: &'a [f32],
    /// End positions, metres; the start positions again for a proximity query.
    pub x_t1: &'a [f32],
    /// Distance up to which pairs are wanted, metres: the thickness for proximity, 0 or the smallest separation for
    /// continuous collision detection.
    pub radius_m: f32,
}

/// Why a query gave no candidates.
#[derive(Debug, Error, PartialEq)]
pub enum BroadError {
    /// Not one position per vertex.
    #[error("the {which} positions have {values} values, but {vertices} vertices need {}", 3 * vertices)]
    PositionCount {
        /// "start" or "end".
        which: &'static str,
        /// Values given.
        values: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// Not a number, infinite or absurd.
    #[error("vertex {vertex} has the {which} coordinate {value_m} m; coordinates must be finite and at most 1e18 m")]
    Position {
        /// "start" or "end".
        which: &'static str,
        /// Vertex, counting from 0.
        vertex: usize,
        /// The coordinate.
        value_m: f32,
    },
    /// Not a distance.
    #[error("the search radius is {radius_m} m; it must be finite and not negative")]
    Radius {
        /// The radius.
        radius_m: f32,
    },
    /// Not one mark per vertex.
    #[error("{values} vertices are marked as touched or not, but the mesh has {vertices} vertices")]
    TouchedCount {
        /// Marks given.
        values: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// No such rank.
    #[error("rank {rank} of {ranks} ranks does not exist")]
    Rank {
        /// The rank.
        rank: usize,
        /// Number of ranks.
        ranks: usize,
    },
    /// Not even the fullest cell fits.
    #[error(
        "collision tables need {needs_bytes} bytes, more than the memory limit of {limit_bytes} bytes; raise the limit or use more workers"
    )]
    MemoryLimit {
        /// A limit that would do.
        needs_bytes: u64,
        /// The limit given.
        limit_bytes: u64,
    },
    /// The device stopped.
    #[error(transparent)]
    Device(#[from] GpuError),
    /// Another rank was not heard.
    #[error(transparent)]
    Transport(#[from] TransportError),
}

/// What a query did on this rank. Counts repeat exactly; times do not.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BroadStats {
    /// Triangle-triangle tests of all ranks.
    pub tests_total: u64,
    /// Those of this rank.
    pub tests: u64,
    /// Buckets with at least one test, over all ranks.
    pub cells: u64,
    /// Triangle entries that this rank wrote, over all batches.
    pub entries: u64,
    /// Pairs of features that this rank reported.
    pub candidates: u64,
    /// Patches of triangles that took part, and those of the mesh, over all ranks.
    pub patches: [u64; 2],
    /// Largest number of bytes held at once: patches, counters, sums, entries, buffers. Not the mesh, not the positions.
    pub bytes: u64,
    /// Passes of fill and test.
    pub batches: u64,
    /// Time of the passes before entries are made, waiting for other ranks included.
    pub count_ns: u64,
    /// Time of the fill passes.
    pub fill_ns: u64,
    /// Time of the tests, the work on candidates included.
    pub test_ns: u64,
}

/// What a search leaves out of a query's pairs.
#[derive(Clone, Copy, Debug, Default)]
pub struct Choice<'a> {
    /// Per vertex: pairs of triangles of which none has a vertex that is set here are left out. None keeps all.
    pub touched: Option<&'a [bool]>,
    /// Distance beyond which pairs within one piece may be left out, metres. None stands for the query's radius.
    pub piece_radius_m: Option<f32>,
    /// Whether pairs within one piece that are proven farther apart than that distance on the whole way may be left out, by
    /// self-collision culling. Not looked at in a search among touched vertices.
    pub cull: bool,
}

/// Takes the candidates that one thread finds.
pub trait Sink: Send {
    /// Takes candidates; called again and again with at most a few thousand.
    fn take(&mut self, found: &[Candidate]);
}

/// The broad phase of one mesh. Keeps its buffers from query to query.
pub struct Broad {
    mesh: Arc<CollisionMesh>,
    patches: Patches,
    table: Table,
    workload: Workload,
    entries: Entries,
}

/// Hands all candidates to one closure.
struct Locked<'a, E: ?Sized>(&'a Mutex<&'a mut E>);

impl<E: FnMut(&[Candidate]) + Send + ?Sized> Sink for Locked<'_, E> {
    fn take(&mut self, found: &[Candidate]) {
        if let Ok(mut emit) = self.0.lock() {
            emit(found);
        }
    }
}

fn nanoseconds(since: Instant) -> u64 {
    u64::try_from(since.elapsed().as_nanos()).unwrap_or(u64::MAX)
}

impl Broad {
    /// A broad phase over `mesh`.
    pub fn new(mesh: CollisionMesh) -> Broad {
        Broad {
            patches: Patches::new(&mesh),
            mesh: Arc::new(mesh),
            table: Table::default(),
            workload: Workload::default(),
            entries: Entries::default(),
        }
    }

    /// The mesh.
    pub fn mesh(&self) -> &Arc<CollisionMesh> {
        &self.mesh
    }

    /// Bytes of the mesh and of what follows from it alone; every rank holds all of it.
    pub fn mesh_bytes(&self) -> u64 {
        self.mesh.bytes() + self.patches.mesh_bytes()
    }

    /// Hands the candidates of this rank's share of the tests to `emit`, at most a few thousand at a time, in no promised
    /// order. All ranks must pass the same mesh and the same positions, bit for bit; then all ranks together report
    /// exactly [`brute_force`]'s pairs, each once.
    ///
    /// With a memory limit the entries are made in batches of cells, at the price of one pass over all triangles each;
    /// it fails only if the replicated counters and the fullest cell do not fit.
    pub fn candidates(
        &mut self,
        cpu: &CpuExecutor,
        query: &Query,
        rank: usize,
        ranks: usize,
        memory_limit_bytes: Option<u64>,
        emit: &mut (dyn FnMut(&[Candidate]) + Send),
    ) -> Result<BroadStats, BroadError> {
        let emit = Mutex::new(emit);
        let start = || Locked(&emit);
        let split = &mut Split::alone(rank, ranks);
        self.search(cpu, query, &Choice::default(), split, memory_limit_bytes, &start, &mut |_| ())
    }

    /// As [`Broad::candidates`], less what `choice` leaves out, with the work on candidates done by the threads that find
    /// them: `start` makes a sink for a part of the tests, `finish` gets it back, one at a time. Which candidates a sink
    /// gets, and how many sinks there are, depends on the number of threads.
    pub fn search<S: Sink>(
        &mut self,
        cpu: &CpuExecutor,
        query: &Query,
        choice: &Choice,
        split: &mut Split,
        memory_limit_bytes: Option<u64>,
        start: &(dyn Fn() -> S + Sync),
        finish: &mut (dyn FnMut(S) + Send),
    ) -> Result<BroadStats, BroadError> {
        let (rank, ranks) = split.place();
        if rank >= ranks {
            return Err(BroadError::Rank { rank, ranks });
        }
        if let Some(touched) = choice.touched.filter(|touched| touched.len() != self.mesh.vertices) {
            return Err(BroadError::TouchedCount { values: touched.len(), vertices: self.mesh.vertices });
        }
        let started = Instant::now();
        let input = Input::new(&self.mesh, Motion::new(&self.mesh, query, choice)?, *choice);
        let mut alone = Split::alone(rank, ranks);
        let split = if self.patches.count() < PATCHES_TOGETHER { &mut alone } else { split };
        self.patches.look(cpu, &input, |aabb| input.grid.finest(aabb).is_none(), split)?;
        let share = count((&mut self.table, &mut self.workload, &self.patches), cpu, &input, split)?;
        let parts = (&self.table, &self.workload, &mut self.entries);
        let (batches, fixed) = plan(parts, cpu.threads(), self.patches.bytes(), (&share, ranks), memory_limit_bytes)?;
        let mut stats = BroadStats {
            tests_total: self.workload.tests,
            cells: self.workload.busy,
            patches: [self.patches.active.len() as u64, self.patches.count() as u64],
            bytes: fixed,
            batches: batches.len() as u64,
            count_ns: nanoseconds(started),
            ..BroadStats::default()
        };
        let totals = Mutex::new((0, 0));
        let finish = Mutex::new(finish);
        for batch in &batches {
            let started = Instant::now();
            self.entries.fill(cpu, &input, &self.patches, &self.table, batch);
            stats.fill_ns += nanoseconds(started);
            stats.entries += batch.entries as u64;
            let started = Instant::now();
            let (table, entries, input) = (&self.table, &self.entries, &input);
            cpu.for_ranges(batch.buckets.len(), GRAIN, |range| {
                let mut tester = Tester::new();
                let buckets = batch.buckets.start + range.start..batch.buckets.start + range.end;
                let mut sink = start();
                tester.run(input, table, entries, batch, buckets, &mut |found| sink.take(found));
                if let Ok(mut finish) = finish.lock() {
                    finish(sink);
                }
                if let Ok(mut totals) = totals.lock() {
                    totals.0 += tester.tested;
                    totals.1 += tester.found;
                }
            });
            stats.test_ns += nanoseconds(started);
            stats.bytes = stats.bytes.max(fixed + self.entries.bytes());
        }
        (stats.tests, stats.candidates) = totals.into_inner().unwrap_or_default();
        Ok(stats)
    }
}

/// Counts what this rank needs; its share of the tests. Between ranks: 16 bytes per layer.
fn count(
    (table, workload, patches): (&mut Table, &mut Workload, &Patches),
    cpu: &CpuExecutor,
    input: &Input,
    split: &mut Split,
) -> Result<Range<u64>, BroadError> {
    let (rank, ranks) = split.place();
    table.lay_out(input, patches);
    let guess = if split.is_together() { table.guess(rank, ranks) } else { 0..table.layers() };
    table.count(cpu, input, patches, guess.clone());
    let mut loads = vec![LayerLoad::default(); table.layers()];
    for layer in guess.clone() {
        loads[layer] = LayerLoad::new(table, layer);
    }
    if !patches.active.is_empty() {
        split.share(&mut loads, |rank| table.guess(rank, ranks))?;
    }
    workload.add_up(&loads);
    let share = workload.share(rank, ranks);
    let needed = layers_of(&loads, &share);
    if needed.start < guess.start || needed.end > guess.end {
        table.count(cpu, input, patches, needed);
    }
    workload.scan(table, &loads);
    Ok(share)
}

/// The batches of a rank's share within the limit, and the bytes that are needed besides their entries.
fn plan(
    (table, workload, entries): (&Table, &Workload, &mut Entries),
    threads: usize,
    patches_bytes: u64,
    (share, ranks): (&Range<u64>, usize),
    memory_limit_bytes: Option<u64>,
) -> Result<(Vec<Batch>, u64), BroadError> {
    let fixed = patches_bytes + table.bytes() + workload.bytes() + threads as u64 * Tester::bytes();
    if memory_limit_bytes.is_some_and(|limit| fixed + entries.bytes() > limit) {
        // What an earlier, unlimited query left must not count against this one.
        *entries = Entries::default();
    }
    let room = memory_limit_bytes.map_or(u64::MAX / 4, |limit| limit.saturating_sub(fixed));
    let (most_entries, most_buckets) = Entries::fit(room);
    // Tests are even over ranks, their entries are not: emptier cells need more. Memory shall shrink with the number of ranks.
    let even = workload.entries.div_ceil(ranks as u64);
    let together = (even + even / 8).max(ENTRIES_TOGETHER) as usize;
    let batches = workload.batches(table, share, most_entries.min(together), most_buckets);
    let fullest = batches.iter().map(|b| b.entries).max().unwrap_or(0);
    if let Some(limit_bytes) = memory_limit_bytes.filter(|&limit| fixed > limit || fullest > most_entries) {
        let singles = workload.batches(table, share, 0, 0);
        let fullest = singles.iter().map(|b| b.entries).max().unwrap_or(0);
        return Err(BroadError::MemoryLimit { needs_bytes: fixed + Entries::bytes_for(fullest), limit_bytes });
    }
    Ok((batches, fixed))
}
