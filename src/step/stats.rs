//! What a step cost and found: counts repeat exactly, seconds do not.

use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::gpu::Executor;

/// Seconds a rank spent in the stages of a step (wall time of this rank; waiting for others is inside).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageSeconds {
    /// Proximity query: broad and narrow phase.
    pub proximity: f64,
    /// Contacts to the ranks that own their rows.
    pub contacts: f64,
    pub exchange: f64,
    pub elements: f64,
    pub index_fill: f64,
    pub value_fill: f64,
    pub solve: f64,
    pub advance: f64,
    /// Candidate positions of all vertices to all ranks.
    pub positions: f64,
    /// Continuous collision detection, all rounds.
    pub continuous: f64,
    /// Impact zones: grouping, solving, sharing what they moved.
    pub zones: f64,
    pub total: f64,
}

/// What collision detection did in the queries of one kind, on this rank.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct QueryStats {
    /// Triangle-triangle tests of all ranks.
    pub tests_total: u64,
    /// Those of this rank.
    pub tests: u64,
    /// Patches of triangles that were searched, and those of the mesh; what self-collision culling and distance left out is
    /// the difference. Of all ranks, the same on each; 0 where a device searched.
    pub patches: [u64; 2],
    /// Pairs of features handed to the narrow phase on this rank.
    pub candidates: u64,
    /// Contacts or impacts this rank found.
    pub found: u64,
    /// Batches the queries took (more than one per query: the memory limit, or cells emptier than those of others).
    pub batches: u64,
    /// Largest number of bytes of tables and buffers.
    pub bytes: u64,
    /// Seconds of the broad phase and of the narrow phase (thread time, so that they can be told apart).
    pub broad_s: f64,
    pub narrow_s: f64,
}

impl QueryStats {
    /// Adds one query.
    pub(super) fn add(&mut self, query: &crate::collision::DetectionStats) {
        let seconds = |ns: u64| ns as f64 * 1e-9;
        let broad = &query.broad;
        self.tests_total += broad.tests_total;
        self.tests += broad.tests;
        self.patches = [0, 1].map(|which| self.patches[which] + broad.patches[which]);
        self.candidates += query.tested;
        self.found += query.found;
        self.batches += broad.batches;
        self.bytes = self.bytes.max(query.bytes);
        // The tests of the broad phase hold the narrow phase.
        self.broad_s += seconds(broad.count_ns + broad.fill_ns + broad.test_ns.saturating_sub(query.narrow_ns));
        self.narrow_s += seconds(query.narrow_ns);
    }
}

/// What impact zones did in a step; the same on all ranks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ZoneCounts {
    /// Rounds of continuous detection and zones; 0 if nothing penetrated.
    pub rounds: u32,
    /// Zones at the end.
    pub zones: u64,
    /// Vertices of the largest zone.
    pub largest: u64,
    /// Impacts of all rounds.
    pub impacts: u64,
    /// Descent iterations of the zones this rank solved.
    pub iterations: u64,
    /// Zones that a fail-safe had to end.
    pub fail_safes: u64,
    /// Times the step was cut in two because nothing else helped.
    pub halvings: u32,
}

impl ZoneCounts {
    /// Adds those of a step or a part of one; iterations and halvings are counted elsewhere.
    pub(super) fn add(&mut self, counts: &crate::impact_zone::ZoneCounts) {
        self.rounds += counts.rounds;
        self.zones += counts.zones;
        self.largest = self.largest.max(counts.largest_vertices);
        self.impacts += counts.impacts;
        self.fail_safes += counts.rigid + counts.scaled + counts.still;
    }
}

/// What a rank reports of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepStats {
    /// Step number, from 1.
    pub step: u32,
    /// PCG iterations.
    pub iterations: u32,
    /// Relative residual reached.
    pub residual: f64,
    /// True if PCG met its tolerance.
    pub converged: bool,
    /// Matrix-vector products.
    pub products: u32,
    /// Bytes this rank received for matrix-vector products.
    pub spmv_bytes: u64,
    /// Bytes this rank received otherwise (positions and velocities).
    pub state_bytes: u64,
    /// Bytes of device memory this rank holds.
    pub memory_bytes: u64,
    /// Peak resident memory of this process, bytes; 0 where the system does not tell.
    pub resident_bytes: u64,
    /// Contacts in the matrix, over all ranks.
    pub contacts: u64,
    /// Smallest distance among the pairs closer than the thickness, metres; none if there are none.
    pub smallest_gap_m: Option<f32>,
    /// Proximity query.
    pub proximity: QueryStats,
    /// Continuous queries.
    pub continuous: QueryStats,
    /// Impact zones.
    pub zones: ZoneCounts,
    /// Bytes held for collisions: mesh, positions of all vertices.
    pub collision_mesh_bytes: u64,
    /// Stage times.
    pub seconds: StageSeconds,
}

/// High-water mark of this process's resident memory.
pub(super) fn peak_resident_bytes() -> u64 {
    let Ok(status) = std::fs::read_to_string("/proc/self/status") else { return 0 };
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok())
        .map_or(0, |kilobytes| kilobytes * 1024)
}

/// Splits a step's time into stages.
pub(super) struct StageClock {
    start: Instant,
    last: std::cell::Cell<Instant>,
}

impl StageClock {
    pub(super) fn start() -> StageClock {
        let now = Instant::now();
        StageClock { start: now, last: std::cell::Cell::new(now) }
    }

    /// Forgets the time since the last lap: it was counted elsewhere.
    pub(super) fn restart(&self) {
        self.last.set(Instant::now());
    }

    /// As [`StageClock::lap`] for a stage of kernels: waits until they are done, or their time would count for a later stage.
    pub(super) fn lap_kernels(&self, executor: &Executor, stage: &mut f64) {
        executor.finish();
        self.lap(stage);
    }

    /// Adds the time since the last lap to `stage`.
    pub(super) fn lap(&self, stage: &mut f64) {
        let now = Instant::now();
        *stage += (now - self.last.replace(now)).as_secs_f64();
    }

    pub(super) fn total(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }
}
