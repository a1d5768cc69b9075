//! Triangle hash table, first half: how many triangles are in each bucket of a window of layers (counting pass). A rank counts
//! the layers that its share of the tests lies in, and looks only at patches of triangles that reach them.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use super::boxes::Aabb;
use super::grid::{Buckets, Cells, LEVELS};
use super::input::Input;
use super::layers::Layers;
use super::patches::Patches;
use crate::gpu::CpuExecutor;

/// Patches per unit of work of a pass over triangles.
const GRAIN: usize = 4;

/// Adds one and returns the value before. `shared`: other threads may do the same now.
#[inline(always)]
pub(super) fn bump(count: &AtomicU32, shared: bool) -> u32 {
    if shared {
        return count.fetch_add(1, Relaxed);
    }
    let before = count.load(Relaxed);
    count.store(before + 1, Relaxed);
    before
}

/// A coarser grid that has residents.
#[derive(Clone, Copy)]
struct Level {
    level: usize,
    buckets: Buckets,
    /// Holds the boxes of the residents.
    bounds: Aabb,
}

/// Number of triangles per bucket, by role. Buckets are numbered layer by layer; behind those of the last layer come those of
/// the coarser grids, which count as one layer more.
#[derive(Default)]
pub(super) struct HashTable {
    layers: Layers,
    /// Coarser grids that have residents, from fine to coarse.
    levels: Vec<Level>,
    /// Triangles that reside in coarser grids, ascending.
    large: Vec<(u32, Aabb)>,
    /// Layers of every active patch.
    spans: Vec<Range<u32>>,
    /// Layers that are counted.
    window: Range<usize>,
    /// First bucket that is counted.
    first: usize,
    /// First bucket of the coarser grids.
    coarse: usize,
    /// Per bucket from the first: resident cloth triangles, resident obstacle triangles.
    resident: Vec<AtomicU32>,
    /// Per bucket of the coarser grids, if they are counted: visiting cloth triangles, visiting obstacle triangles.
    visiting: Vec<AtomicU32>,
    /// In a search among touched vertices: the buckets of the finest grid to look at.
    marked: Option<Marked>,
}

/// Number of triangles in a bucket, by role. Entries are in this order.
#[derive(Clone, Copy, Default)]
pub(super) struct Load {
    pub resident_cloth: u32,
    pub resident_obstacles: u32,
    pub visiting_cloth: u32,
    pub visiting_obstacles: u32,
}

impl Load {
    pub(super) fn residents(&self) -> usize {
        self.resident_cloth as usize + self.resident_obstacles as usize
    }

    pub(super) fn entries(&self) -> usize {
        self.residents() + self.visiting_cloth as usize + self.visiting_obstacles as usize
    }

    /// Pairs to test: all with at least one resident and at least one cloth triangle.
    #[inline(always)]
    pub(super) fn tests(&self) -> u64 {
        let (cloth, all) = (u64::from(self.resident_cloth), self.entries() as u64);
        let own = (cloth * cloth.saturating_sub(1)) / 2 + cloth * (all - cloth);
        own + u64::from(self.resident_obstacles) * u64::from(self.visiting_cloth)
    }
}

/// Buckets of the finest grid where wanted triangles reside.
struct Marked {
    bits: Vec<u64>,
    /// True if a wanted triangle resides in a coarser grid, where any triangle may visit it. If false, only wanted
    /// triangles need to visit coarser grids.
    coarse: bool,
}

impl Marked {
    fn new(input: &Input, patches: &Patches, layers: &Layers) -> Marked {
        let all = 0..layers.count();
        let mut marked = Marked { bits: vec![0; layers.start(all.end).div_ceil(64)], coarse: false };
        for triangle in patches.active.iter().flat_map(|&patch| patches.triangles(patch as usize)) {
            let wanted = input.tag(triangle) != 0;
            let Some(aabb) = wanted.then(|| input.aabb(triangle)).flatten() else { continue };
            match input.grid.finest(&aabb) {
                Some(cells) => {
                    layers.for_each(&cells, &all, |bucket, _| marked.bits[bucket as usize / 64] |= 1 << (bucket % 64));
                }
                None => marked.coarse = true,
            }
        }
        marked
    }

    #[inline(always)]
    fn contains(&self, bucket: u32) -> bool {
        self.bits[bucket as usize / 64] >> (bucket % 64) & 1 != 0
    }
}

fn clear(counts: &mut Vec<AtomicU32>, len: usize) {
    counts.truncate(len);
    counts.iter_mut().for_each(|count| *count.get_mut() = 0);
    if counts.capacity() < len {
        // A new vector neither copies the old counts nor reserves more than asked for.
        *counts = Vec::new();
        counts.reserve_exact(len);
    }
    counts.resize_with(len, || AtomicU32::new(0));
}

impl HashTable {
    /// Layers and coarser grids of a query; nothing is counted yet.
    pub(super) fn lay_out(&mut self, input: &Input, patches: &Patches) {
        let boxes: Vec<(Aabb, usize)> = patches
            .active
            .iter()
            .map(|&p| (patches.states[p as usize].aabb(), patches.triangles(p as usize).len()))
            .collect();
        self.layers = Layers::new(&input.grid, boxes.iter().map(|(aabb, triangles)| (aabb, *triangles)));
        let span = |(aabb, _): &(Aabb, usize)| {
            let layers = self.layers.touched_by(&input.grid.cells(0, aabb));
            layers.start as u32..layers.end as u32
        };
        self.spans = boxes.iter().map(span).collect();
        self.large.clear();
        for &patch in patches.active.iter().filter(|&&p| patches.states[p as usize].is_large()) {
            for triangle in patches.triangles(patch as usize) {
                let aabb = input.aabb(triangle).filter(|aabb| input.grid.finest(aabb).is_none());
                self.large.extend(aabb.map(|aabb| (triangle as u32, aabb)));
            }
        }
        self.marked = input.choice.touched.map(|_| Marked::new(input, patches, &self.layers));
        self.lay_out_coarse(input);
        self.window = 0..0;
    }

    fn lay_out_coarse(&mut self, input: &Input) {
        let mut members = [0; LEVELS];
        let mut bounds = [Aabb::EMPTY; LEVELS];
        for (_, aabb) in &self.large {
            let (level, _) = input.grid.coarse(aabb);
            members[level] += 1;
            bounds[level] = bounds[level].join(*aabb);
        }
        self.coarse = self.layers.start(self.layers.count());
        self.levels.clear();
        let mut base = self.coarse;
        for level in (1..LEVELS).filter(|&level| members[level] > 0) {
            let buckets = Buckets::new(base, 4 * members[level]);
            base = buckets.end();
            self.levels.push(Level { level, buckets, bounds: bounds[level] });
        }
    }

    /// Layers, the one of the coarser grids included.
    pub(super) fn layers(&self) -> usize {
        self.layers.count() + 1
    }

    /// Layers that may hold about an even share of the tests; the one of the coarser grids is the last rank's.
    pub(super) fn guess(&self, rank: usize, ranks: usize) -> Range<usize> {
        let guess = self.layers.guess(rank, ranks);
        guess.start..if rank + 1 == ranks { self.layers() } else { guess.end }
    }

    /// Layers that are counted.
    pub(super) fn window(&self) -> Range<usize> {
        self.window.clone()
    }

    /// Buckets of a layer.
    pub(super) fn buckets_of(&self, layer: usize) -> Range<usize> {
        self.layers.start(layer)..if layer < self.layers.count() { self.layers.start(layer + 1) } else { self.end() }
    }

    fn end(&self) -> usize {
        self.levels.last().map_or(self.coarse, |level| level.buckets.end())
    }

    /// The counting pass over a window of layers.
    pub(super) fn count(&mut self, cpu: &CpuExecutor, input: &Input, patches: &Patches, window: Range<usize>) {
        let shared = cpu.threads() > 1;
        self.window = window.clone();
        self.first = self.layers.start(window.start);
        let with_coarse = window.end > self.layers.count();
        let end = if with_coarse { self.end() } else { self.layers.start(window.end) };
        clear(&mut self.resident, 2 * (end - self.first));
        clear(&mut self.visiting, if with_coarse { 2 * (end - self.coarse) } else { 0 });
        let resident = &self.resident;
        let fine = window.start..window.end.min(self.layers.count());
        self.for_each_patch(cpu, patches, &fine, false, |triangles| {
            for triangle in triangles {
                let Some(cells) = input.aabb(triangle).and_then(|aabb| input.grid.finest(&aabb)) else { continue };
                let role = input.role(triangle);
                self.layers.for_each(&cells, &fine, |bucket, _| {
                    if self.marked.as_ref().is_none_or(|marked| marked.contains(bucket)) {
                        bump(&resident[2 * (bucket as usize - self.first) + role], shared);
                    }
                });
            }
        });
        if with_coarse {
            self.count_coarse(cpu, input, patches);
        }
    }

    fn count_coarse(&self, cpu: &CpuExecutor, input: &Input, patches: &Patches) {
        for (triangle, aabb) in &self.large {
            let role = input.role(*triangle as usize);
            if let Some((_, buckets, cells)) = self.coarse_home(input, aabb) {
                buckets.for_each(&cells, |bucket, _| {
                    bump(&self.resident[2 * (bucket as usize - self.first) + role], false);
                });
            }
        }
        if self.levels.is_empty() {
            return;
        }
        let shared = cpu.threads() > 1;
        self.for_each_patch(cpu, patches, &(0..0), true, |triangles| {
            for triangle in triangles {
                let Some(aabb) = input.aabb(triangle) else { continue };
                let role = input.role(triangle);
                let own = if input.grid.finest(&aabb).is_some() { 0 } else { input.grid.coarse(&aabb).0 };
                self.for_each_visited(input, triangle, &aabb, own, |bucket, _| {
                    bump(&self.visiting[2 * (bucket as usize - self.coarse) + role], shared);
                });
            }
        });
    }

    /// Calls `visit` with the triangles of every active patch that reaches the layers `fine` or, with `coarse`, a coarser
    /// grid.
    pub(super) fn for_each_patch(
        &self,
        cpu: &CpuExecutor,
        patches: &Patches,
        fine: &Range<usize>,
        coarse: bool,
        visit: impl Fn(Range<usize>) + Sync,
    ) {
        let reaches = |at: &usize| {
            let span = &self.spans[*at];
            let aabb = || patches.states[patches.active[*at] as usize].aabb();
            ((span.start as usize) < fine.end && fine.start < span.end as usize)
                || (coarse && self.levels.iter().any(|level| level.bounds.overlaps(&aabb())))
        };
        let wanted: Vec<usize> = (0..self.spans.len()).filter(reaches).collect();
        cpu.for_ranges(wanted.len(), GRAIN, |range| {
            for &at in &wanted[range] {
                visit(patches.triangles(patches.active[at] as usize));
            }
        });
    }

    /// Calls `visit(bucket, tag)` for the buckets that a triangle of grid `own` visits: those of coarser grids where
    /// there is a resident to test it with.
    #[inline(always)]
    fn for_each_visited(
        &self,
        input: &Input,
        triangle: usize,
        aabb: &Aabb,
        own: usize,
        mut visit: impl FnMut(u32, u32),
    ) {
        if self.marked.as_ref().is_some_and(|marked| !marked.coarse) && input.tag(triangle) == 0 {
            return;
        }
        let obstacle = input.role(triangle) != 0;
        for level in &self.levels {
            if level.level <= own || !aabb.overlaps(&level.bounds) {
                continue;
            }
            level.buckets.for_each(&input.grid.cells(level.level, aabb), |bucket, tag| {
                let [cloth, other] = self.residents(bucket as usize);
                if cloth > 0 || (other > 0 && !obstacle) {
                    visit(bucket, tag);
                }
            });
        }
    }

    #[inline(always)]
    fn coarse_home(&self, input: &Input, aabb: &Aabb) -> Option<(usize, Buckets, Cells)> {
        let (own, cells) = input.grid.coarse(aabb);
        self.levels.iter().find(|l| l.level == own).map(|l| (own, l.buckets, cells))
    }

    /// Calls `resides(bucket, tag)` and `visits(bucket, tag)` for the buckets in the layers `fine` and, with `coarse`, in
    /// coarser grids where a triangle resides or visits.
    #[inline(always)]
    pub(super) fn for_each_bucket(
        &self,
        input: &Input,
        triangle: usize,
        aabb: &Aabb,
        (fine, coarse): (&Range<usize>, bool),
        mut resides: impl FnMut(u32, u32),
        visits: impl FnMut(u32, u32),
    ) {
        let own = match input.grid.finest(aabb) {
            Some(cells) => {
                self.layers.for_each(&cells, fine, resides);
                0
            }
            None if !coarse => return,
            None => {
                let Some((own, buckets, cells)) = self.coarse_home(input, aabb) else { return };
                buckets.for_each(&cells, &mut resides);
                own
            }
        };
        if coarse {
            self.for_each_visited(input, triangle, aabb, own, visits);
        }
    }

    /// The layers of the finest grid that hold buckets of a range, and whether buckets of coarser grids are among them.
    pub(super) fn reach(&self, buckets: &Range<usize>) -> (Range<usize>, bool) {
        (self.layers.holding(buckets), buckets.end > self.coarse)
    }

    #[inline(always)]
    fn residents(&self, bucket: usize) -> [u32; 2] {
        let at = 2 * (bucket - self.first);
        [self.resident[at].load(Relaxed), self.resident[at + 1].load(Relaxed)]
    }

    /// The buckets that are counted.
    pub(super) fn buckets(&self) -> Range<usize> {
        self.first..self.first + self.resident.len() / 2
    }

    /// True if a bucket belongs to a grid that has visitors.
    #[inline(always)]
    pub(super) fn is_coarse(&self, bucket: usize) -> bool {
        bucket >= self.coarse
    }

    /// Number of triangles in a counted bucket.
    #[inline(always)]
    pub(super) fn load(&self, bucket: usize) -> Load {
        let [resident_cloth, resident_obstacles] = self.residents(bucket);
        let mut load = Load { resident_cloth, resident_obstacles, ..Load::default() };
        if self.is_coarse(bucket) {
            let at = 2 * (bucket - self.coarse);
            load.visiting_cloth = self.visiting[at].load(Relaxed);
            load.visiting_obstacles = self.visiting[at + 1].load(Relaxed);
        }
        load
    }

    /// Bytes of the counters and of the lists that counting needs.
    pub(super) fn bytes(&self) -> u64 {
        let counters = 4 * (self.resident.capacity() + self.visiting.capacity());
        let marked = self.marked.as_ref().map_or(0, |marked| size_of_val(&marked.bits[..]));
        (counters + marked + size_of_val(&self.large[..]) + size_of_val(&self.spans[..])) as u64 + self.layers.bytes()
    }
}
