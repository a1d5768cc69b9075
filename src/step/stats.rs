//! Costs and results of a step. Counts repeat exactly; seconds do not.

use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::guidance::Guidance;
use crate::gpu::Executor;
use crate::impact_zone::ZoneCounts;

/// Seconds of the stages of a step. On a rank: its wall time, including waits for other ranks. In a report: the time of
/// the slowest rank in each stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct StageSeconds {
    /// Proximity query: broad and narrow phase.
    pub proximity: f64,
    /// Transfer of contacts to the ranks that own their rows.
    pub contacts: f64,
    /// Transfer of positions and velocities of other ranks' vertices.
    pub exchange: f64,
    /// Element records.
    pub elements: f64,
    /// Matrix structure.
    pub index_fill: f64,
    /// Matrix values and right-hand side, in one pass.
    pub value_fill: f64,
    /// Conjugate gradients.
    pub solve: f64,
    /// New velocities and positions.
    pub advance: f64,
    /// Transfer of the candidate positions of all vertices to all ranks.
    pub positions: f64,
    /// Continuous collision detection, all rounds.
    pub continuous: f64,
    /// Impact zones: grouping, solving, transfer of the moved vertices.
    pub zones: f64,
    /// The whole step.
    pub total: f64,
}

impl StageSeconds {
    /// The maximum of each stage.
    pub fn max(self, other: StageSeconds) -> StageSeconds {
        StageSeconds {
            proximity: self.proximity.max(other.proximity),
            contacts: self.contacts.max(other.contacts),
            exchange: self.exchange.max(other.exchange),
            elements: self.elements.max(other.elements),
            index_fill: self.index_fill.max(other.index_fill),
            value_fill: self.value_fill.max(other.value_fill),
            solve: self.solve.max(other.solve),
            advance: self.advance.max(other.advance),
            positions: self.positions.max(other.positions),
            continuous: self.continuous.max(other.continuous),
            zones: self.zones.max(other.zones),
            total: self.total.max(other.total),
        }
    }
}

/// Statistics of the collision queries of one kind in a step, on one rank or on all ranks together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct QueryStats {
    /// Triangle-triangle tests.
    pub tests: u64,
    /// Patches of triangles that were searched, and the number of all patches, over the queries. The others were proven
    /// free of collisions or had no patch nearby. The numbers are the same on each rank; they are 0 if a device
    /// searched.
    pub patches: [u64; 2],
    /// Pairs of features handed to the narrow phase.
    pub pairs: u64,
    /// Contacts or impacts found; duplicates count twice.
    pub found: u64,
    /// Batches of the queries on one rank, the maximum over all ranks. It exceeds the number of queries if a memory
    /// limit required smaller batches, or if cells were emptier than those of other ranks.
    pub batches: u64,
    /// Thread seconds of the broad phase.
    pub broad_s: f64,
    /// Thread seconds of the narrow phase.
    pub narrow_s: f64,
}

impl QueryStats {
    /// Adds one query of this rank.
    pub(super) fn add(&mut self, query: &crate::collision::DetectionStats) {
        let seconds = |ns: u64| ns as f64 * 1e-9;
        let broad = &query.broad;
        self.tests += broad.tests;
        self.patches = [0, 1].map(|which| self.patches[which] + broad.patches[which]);
        self.pairs += query.tested;
        self.found += query.found;
        self.batches += broad.batches;
        // The time of the broad phase includes the narrow phase.
        self.broad_s += seconds(broad.count_ns + broad.fill_ns + broad.test_ns.saturating_sub(query.narrow_ns));
        self.narrow_s += seconds(query.narrow_ns);
    }

    /// Adds the same queries of another rank.
    pub fn add_rank(&mut self, rank: &QueryStats) {
        self.tests += rank.tests;
        self.patches = rank.patches;
        self.pairs += rank.pairs;
        self.found += rank.found;
        self.batches = self.batches.max(rank.batches);
        self.broad_s += rank.broad_s;
        self.narrow_s += rank.narrow_s;
    }
}

/// Vertices without room between obstacles that overlap, and those obstacles: see [`crate::model::LetGo`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct LetGoCounts {
    /// Pairs after the step.
    pub pairs: u64,
    /// Pairs that the step has let go.
    pub new: u64,
    /// Pairs that the step has taken up again.
    pub taken_up: u64,
}

/// Triangles beyond the strain limits of their fabrics.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct LimitCounts {
    /// Solves that were added because triangles ended more than 2 % of strain beyond a limit.
    pub solved_again: u32,
    /// Triangles that the solves of all sub-steps have left more than 0.35 % beyond a limit; they are pulled back.
    pub pulled: u64,
    /// Rounds of pulling back, over all sub-steps.
    pub rounds: u32,
    /// Triangles more than 0.5 % beyond a limit all the same at the end, before collisions.
    pub beyond: u64,
}

/// Report of a rank on a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepStats {
    /// Step number, from 1.
    pub step: u32,
    /// Sub-steps that the step was made in. Further halvings of them are counted in `zones`.
    pub substeps: u32,
    /// Whether a motion that was given has led to its end; none in other steps.
    pub arrived: Option<bool>,
    /// How the step was drawn toward a guide; none in other steps.
    pub guidance: Option<Guidance>,
    /// PCG iterations.
    pub iterations: u32,
    /// Relative residual reached; of two solves the product, which leaves linearization aside.
    pub residual: f64,
    /// True if PCG met its tolerance.
    pub converged: bool,
    /// Solves that broke off because p'Ap <= 0 beyond rounding, or because a value was not finite.
    pub breakdowns: u32,
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
    /// Smallest distance among the pairs closer than the thickness, meters; none without such pairs.
    pub smallest_gap_m: Option<f32>,
    /// Proximity query.
    pub proximity: QueryStats,
    /// Continuous queries.
    pub continuous: QueryStats,
    /// Bytes of tables and buffers of the largest proximity query and of the largest continuous one.
    pub query_bytes: [u64; 2],
    /// Impact zones.
    pub zones: ZoneCounts,
    /// Pairs of vertices and obstacles that are let go.
    pub let_go: LetGoCounts,
    /// Triangles beyond their strain limits, over all ranks.
    pub limits: LimitCounts,
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

/// Stopwatch that divides the time of a step among its stages.
pub(super) struct StageClock {
    start: Instant,
    last: std::cell::Cell<Instant>,
}

impl StageClock {
    pub(super) fn start() -> StageClock {
        let now = Instant::now();
        StageClock { start: now, last: std::cell::Cell::new(now) }
    }

    /// Discards the time since the last lap, because it was counted elsewhere.
    pub(super) fn restart(&self) {
        self.last.set(Instant::now());
    }

    /// As [`StageClock::lap`] for a stage of kernels. It waits until they end, because their time would otherwise count
    /// for a later stage.
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
