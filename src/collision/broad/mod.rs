//! Broad phase: pairs of features whose swept, inflated boxes overlap, found with a triangle hash table and split evenly
//! over the ranks by a workload table [Li et al. 2020, Sec. 4.2 and 4.4].
//!
//! Passes: count (every rank counts all triangles per bucket), scan (tests per bucket, share of this rank), then per batch
//! of buckets fill and test. Each is loops over flat arrays. Promises the same *set* of pairs for any number of ranks,
//! threads and batches, each pair once over all ranks; not an order. Does not say whether anything touches.

mod boxes;
mod brute;
mod features;
mod fill;
mod grid;
mod mesh;
mod pairs;
mod table;
mod workload;

use std::sync::Mutex;
use std::time::Instant;

use thiserror::Error;

pub use brute::brute_force;
pub use mesh::{CollisionMesh, CollisionMeshError};

use crate::collision::Candidate;
use crate::gpu::CpuExecutor;
use boxes::Motion;
use fill::Entries;
use pairs::Tester;
use table::{Input, Table};
use workload::Workload;

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
    /// Largest number of bytes held at once: counters, sums, entries, buffers. Not the mesh, not the positions.
    pub bytes: u64,
    /// Passes of fill and test.
    pub batches: u64,
    /// Time of the counting pass and the scan.
    pub count_ns: u64,
    /// Time of the fill passes.
    pub fill_ns: u64,
    /// Time of the tests, `emit` included.
    pub test_ns: u64,
}

/// The broad phase of one mesh. Keeps its buffers from query to query.
pub struct Broad {
    mesh: CollisionMesh,
    table: Table,
    workload: Workload,
    entries: Entries,
}

fn nanoseconds(since: Instant) -> u64 {
    u64::try_from(since.elapsed().as_nanos()).unwrap_or(u64::MAX)
}

impl Broad {
    /// A broad phase over `mesh`.
    pub fn new(mesh: CollisionMesh) -> Broad {
        Broad { mesh, table: Table::default(), workload: Workload::default(), entries: Entries::default() }
    }

    /// The mesh.
    pub fn mesh(&self) -> &CollisionMesh {
        &self.mesh
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
        if rank >= ranks {
            return Err(BroadError::Rank { rank, ranks });
        }
        let started = Instant::now();
        let input = Input::new(&self.mesh, Motion::new(&self.mesh, query)?);
        self.table.count(cpu, &input);
        self.workload.scan(&self.table);
        let share = self.workload.share(rank, ranks);
        let fixed = self.table.bytes() + self.workload.bytes() + cpu.threads() as u64 * Tester::bytes();
        if memory_limit_bytes.is_some_and(|limit| fixed + self.entries.bytes() > limit) {
            // What an earlier, unlimited query left must not count against this one.
            self.entries = Entries::default();
        }
        let room = memory_limit_bytes.map_or(u64::MAX / 4, |limit| limit.saturating_sub(fixed));
        let (most_entries, most_buckets) = Entries::fit(room);
        let batches = self.workload.batches(&self.table, &share, most_entries, most_buckets);
        let fullest = batches.iter().map(|b| b.entries).max().unwrap_or(0);
        if let Some(limit_bytes) = memory_limit_bytes.filter(|&limit| fixed > limit || fullest > most_entries) {
            let singles = self.workload.batches(&self.table, &share, 0, 0);
            let fullest = singles.iter().map(|b| b.entries).max().unwrap_or(0);
            return Err(BroadError::MemoryLimit { needs_bytes: fixed + Entries::bytes_for(fullest), limit_bytes });
        }
        let mut stats = BroadStats {
            tests_total: self.workload.tests,
            cells: self.workload.busy,
            bytes: fixed,
            batches: batches.len() as u64,
            count_ns: nanoseconds(started),
            ..BroadStats::default()
        };
        let totals = Mutex::new((0, 0));
        let emit = Mutex::new(emit);
        for batch in &batches {
            let started = Instant::now();
            self.entries.fill(cpu, &input, &self.table, batch);
            stats.fill_ns += nanoseconds(started);
            stats.entries += batch.entries as u64;
            let started = Instant::now();
            let (table, entries, input) = (&self.table, &self.entries, &input);
            cpu.for_ranges(batch.buckets.len(), GRAIN, |range| {
                let mut tester = Tester::new();
                let buckets = batch.buckets.start + range.start..batch.buckets.start + range.end;
                let mut locked = |found: &[Candidate]| {
                    if let Ok(mut emit) = emit.lock() {
                        emit(found);
                    }
                };
                tester.run(input, table, entries, batch, buckets, &mut locked);
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
