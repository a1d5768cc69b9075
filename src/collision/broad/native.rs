//! The native search: passes over flat arrays on the host's threads.

use std::ops::Range;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use super::active::ActivePatches;
use super::boxes::Trajectories;
use super::fill::BucketEntries;
use super::input::Input;
use super::mesh::CollisionMesh;
use super::pairs::Tester;
use super::patches::Patches;
use super::query::{BroadError, BroadStats, Query, Search, Sink, nanoseconds};
use super::split::Split;
use super::table::HashTable;
use super::workload::{BucketBatch, LayerLoad, Workload, layers_of};
use crate::collision::Candidate;
use crate::gpu::CpuExecutor;

/// From this many patches on, ranks share the passes over patches; with fewer, the exchange takes longer than the pass.
const PATCHES_TOGETHER: usize = 256;
/// A batch holds at least this many entries if the memory limit allows it.
const ENTRIES_TOGETHER: u64 = 1 << 12;
/// Buckets per unit of work of the test pass.
const GRAIN: usize = 256;

/// The broad phase of one mesh. Keeps its buffers from query to query.
pub struct Broad {
    mesh: Arc<CollisionMesh>,
    active: ActivePatches,
    table: HashTable,
    workload: Workload,
    entries: BucketEntries,
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

impl Broad {
    /// A broad phase over `mesh`.
    pub fn new(mesh: CollisionMesh) -> Broad {
        Broad {
            active: ActivePatches::new(&mesh),
            mesh: Arc::new(mesh),
            table: HashTable::default(),
            workload: Workload::default(),
            entries: BucketEntries::default(),
        }
    }

    /// Cloth and obstacles, shared with whoever searches the same mesh.
    pub fn mesh(&self) -> &Arc<CollisionMesh> {
        &self.mesh
    }

    /// Bytes of the mesh and of tables that depend on it alone; every rank holds all of it.
    pub fn mesh_bytes(&self) -> u64 {
        self.mesh.bytes() + self.active.mesh_bytes()
    }

    /// Hands the candidates of this rank's share of the tests to `emit`, at most a few thousand at a time, in no
    /// promised order. All ranks must pass the same mesh and the same positions, bit for bit; then all ranks together
    /// report exactly [`super::brute_force`]'s pairs, each once.
    ///
    /// A memory limit fails only if the replicated counters and the fullest cell do not fit.
    ///
    /// # Errors
    /// Positions or radius that boxes cannot be built from, no such rank, a memory limit that is too low.
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
        let search = Search { memory_limit_bytes, ..Search::all(*query) };
        self.search(cpu, &search, &mut Split::alone(rank, ranks), &start, &mut |_| ())
    }

    /// As [`Broad::candidates`], less what the search leaves out, with the work on candidates done by the threads that
    /// find them: `start` makes a sink for a part of the tests, `finish` gets it back, one at a time. Which candidates
    /// a sink gets, and how many sinks there are, depends on the number of threads.
    ///
    /// # Errors
    /// As [`Broad::candidates`]; another rank that is not heard.
    pub fn search<S: Sink>(
        &mut self,
        cpu: &CpuExecutor,
        search: &Search,
        split: &mut Split,
        start: &(dyn Fn() -> S + Sync),
        finish: &mut (dyn FnMut(S) + Send),
    ) -> Result<BroadStats, BroadError> {
        let (rank, ranks) = split.place();
        if rank >= ranks {
            return Err(BroadError::Rank { rank, ranks });
        }
        let choice = search.choice;
        if let Some(touched) = choice.touched.filter(|touched| touched.len() != self.mesh.vertices) {
            return Err(BroadError::TouchedCount { values: touched.len(), vertices: self.mesh.vertices });
        }
        let started = Instant::now();
        let input = Input::new(&self.mesh, Trajectories::new(&self.mesh, &search.query, &choice)?, choice);
        let mut alone = Split::alone(rank, ranks);
        let split = if self.active.patches.count() < PATCHES_TOGETHER { &mut alone } else { split };
        self.active.find(cpu, &input, |aabb| input.grid.finest(aabb).is_none(), split)?;
        let patches = &self.active.patches;
        let share = count((&mut self.table, &mut self.workload, patches), cpu, &input, split)?;
        let parts = (&self.table, &self.workload, &mut self.entries);
        let limit = search.memory_limit_bytes;
        let (batches, fixed) = plan(parts, cpu.threads(), patches.bytes(), (&share, ranks), limit)?;
        let mut stats = BroadStats {
            tests_total: self.workload.tests,
            cells: self.workload.busy,
            patches: [patches.active.len() as u64, patches.count() as u64],
            bytes: fixed,
            batches: batches.len() as u64,
            count_ns: nanoseconds(started),
            ..BroadStats::default()
        };
        let totals = Mutex::new((0, 0));
        let finish = Mutex::new(finish);
        for batch in &batches {
            let started = Instant::now();
            self.entries.fill(cpu, &input, patches, &self.table, batch);
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

/// Counts the layers that this rank needs and returns its share of the tests. Moves 16 bytes per layer between ranks.
fn count(
    (table, workload, patches): (&mut HashTable, &mut Workload, &Patches),
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

/// The batches of a rank's share within the limit, and the bytes needed besides their entries.
fn plan(
    (table, workload, entries): (&HashTable, &Workload, &mut BucketEntries),
    threads: usize,
    patches_bytes: u64,
    (share, ranks): (&Range<u64>, usize),
    memory_limit_bytes: Option<u64>,
) -> Result<(Vec<BucketBatch>, u64), BroadError> {
    let fixed = patches_bytes + table.bytes() + workload.bytes() + threads as u64 * Tester::bytes();
    if memory_limit_bytes.is_some_and(|limit| fixed + entries.bytes() > limit) {
        // Arrays of an earlier query without a limit must not count against this one.
        *entries = BucketEntries::default();
    }
    let room = memory_limit_bytes.map_or(u64::MAX / 4, |limit| limit.saturating_sub(fixed));
    let (most_entries, most_buckets) = BucketEntries::fit(room);
    // An even share of the tests may need more entries than an even share of the entries, where cells are emptier. The
    // bound makes memory shrink with the number of ranks.
    let even = workload.entries.div_ceil(ranks as u64);
    let together = (even + even / 8).max(ENTRIES_TOGETHER) as usize;
    let batches = workload.batches(table, share, most_entries.min(together), most_buckets);
    let fullest = batches.iter().map(|b| b.entries).max().unwrap_or(0);
    if let Some(limit_bytes) = memory_limit_bytes.filter(|&limit| fixed > limit || fullest > most_entries) {
        let singles = workload.batches(table, share, 0, 0);
        let fullest = singles.iter().map(|b| b.entries).max().unwrap_or(0);
        return Err(BroadError::MemoryLimit { needs_bytes: fixed + BucketEntries::bytes_for(fullest), limit_bytes });
    }
    Ok((batches, fixed))
}
