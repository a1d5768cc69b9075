//! Triangle hash table, first half: how many triangles are in each bucket (counting pass). Every rank counts all of it,
//! with the same result; counts are all that a rank keeps of the buckets of others.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use super::boxes::{Aabb, Motion};
use super::grid::{Buckets, Cells, Grid, LEVELS, WANTED};
use super::{Choice, CollisionMesh};
use crate::gpu::CpuExecutor;

/// Triangles per unit of work of a pass over triangles.
const GRAIN: usize = 256;

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

/// A grid that has residents.
#[derive(Clone, Copy)]
pub(super) struct Level {
    level: usize,
    pub buckets: Buckets,
    /// Holds the boxes of the residents.
    bounds: Aabb,
}

/// What a query works on.
pub(super) struct Input<'a> {
    pub mesh: &'a CollisionMesh,
    pub motion: Motion<'a>,
    pub grid: Grid,
    /// What the query leaves out.
    pub choice: Choice<'a>,
    /// Obstacles are cut to these bounds.
    cloth: Aabb,
    /// Triangles outside have no partner.
    reach: Option<Aabb>,
}

impl<'a> Input<'a> {
    pub fn new(mesh: &'a CollisionMesh, motion: Motion<'a>, choice: Choice<'a>) -> Input<'a> {
        let grid = Grid::new(mesh, &motion);
        let cloth = motion.cloth_bounds(mesh);
        let mut input = Input { mesh, motion, grid, choice, cloth, reach: None };
        if choice.touched.is_some() {
            let wanted = (0..mesh.triangles.len()).filter(|&t| input.tag(t) != 0);
            input.reach = Some(wanted.fold(Aabb::EMPTY, |all, t| all.join(input.motion.triangle(mesh.triangles[t]))));
        }
        input
    }

    /// [`WANTED`], or 0 for a triangle that is of interest only as partner of such a one.
    #[inline(always)]
    pub fn tag(&self, triangle: usize) -> u32 {
        let Some(touched) = self.choice.touched else { return WANTED };
        let [a, b, c] = self.mesh.triangles[triangle];
        if touched[a as usize] | touched[b as usize] | touched[c as usize] { WANTED } else { 0 }
    }

    /// Box of a triangle; that of an obstacle is cut to the cloth's bounds, which changes no intersection with cloth.
    /// None for a triangle out of reach of all that could be its partner.
    #[inline(always)]
    pub fn aabb(&self, triangle: usize) -> Option<Aabb> {
        let aabb = self.motion.triangle(self.mesh.triangles[triangle]);
        if let Some(reach) = &self.reach
            && !aabb.overlaps(reach)
        {
            return None;
        }
        if triangle < self.mesh.cloth_triangles {
            return Some(aabb);
        }
        aabb.overlaps(&self.cloth).then(|| aabb.clip(&self.cloth))
    }
}

/// Number of triangles per bucket, by role.
#[derive(Default)]
pub(super) struct Table {
    /// Grids that have residents, the first always, from fine to coarse.
    pub levels: Vec<Level>,
    /// Per bucket: resident cloth triangles, resident obstacle triangles.
    resident: Vec<AtomicU32>,
    /// Per bucket behind those of the first grid: visiting cloth triangles, visiting obstacle triangles.
    visiting: Vec<AtomicU32>,
    /// Buckets of the first grid.
    first: usize,
    /// Bytes of the list of triangles that do not reside in the first grid.
    large_bytes: u64,
    /// In a search among touched vertices: the triangles that have entries, ascending.
    pub few: Option<Vec<u32>>,
}

/// Who is in a bucket. Entries are in this order.
#[derive(Clone, Copy, Default)]
pub(super) struct Load {
    pub resident_cloth: u32,
    pub resident_obstacles: u32,
    pub visiting_cloth: u32,
    pub visiting_obstacles: u32,
}

impl Load {
    pub fn residents(&self) -> usize {
        self.resident_cloth as usize + self.resident_obstacles as usize
    }

    pub fn entries(&self) -> usize {
        self.residents() + self.visiting_cloth as usize + self.visiting_obstacles as usize
    }

    /// Pairs to test: all with at least one resident and at least one cloth triangle.
    #[inline(always)]
    pub fn tests(&self) -> u64 {
        let (cloth, all) = (u64::from(self.resident_cloth), self.entries() as u64);
        let own = (cloth * cloth.saturating_sub(1)) / 2 + cloth * (all - cloth);
        own + u64::from(self.resident_obstacles) * u64::from(self.visiting_cloth)
    }
}

/// Buckets of the first grid where wanted triangles reside.
struct Marked {
    bits: Vec<u64>,
    /// A wanted triangle may visit coarser grids, or reside there and be visited from anywhere.
    coarse: bool,
}

impl Marked {
    fn new(input: &Input, first: &Buckets) -> Marked {
        let mut marked = Marked { bits: vec![0; first.end().div_ceil(64)], coarse: false };
        for triangle in 0..input.mesh.triangles.len() {
            // Any triangle, as a large one may be the partner of a wanted one.
            let wanted = input.tag(triangle) != 0;
            let Some(aabb) = wanted.then(|| input.aabb(triangle)).flatten() else { continue };
            match input.grid.finest(&aabb) {
                Some(cells) => {
                    first.for_each(&cells, |bucket, _| marked.bits[bucket as usize / 64] |= 1 << (bucket % 64))
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
    counts.resize_with(len, || AtomicU32::new(0));
}

impl Table {
    /// The counting pass.
    pub fn count(&mut self, cpu: &CpuExecutor, input: &Input) {
        let shared = cpu.threads() > 1;
        let first = Buckets::new(0, input.mesh.triangles.len());
        self.first = first.end();
        self.levels = vec![Level { level: 0, buckets: first, bounds: Aabb::EMPTY }];
        clear(&mut self.resident, 2 * self.first);
        let marked = input.choice.touched.is_some().then(|| Marked::new(input, &first));
        let found = Mutex::new((Vec::new(), Vec::new()));
        let resident = &self.resident;
        cpu.for_ranges(input.mesh.triangles.len(), GRAIN, |range| {
            let (mut large, mut few) = (Vec::new(), Vec::new());
            for triangle in range {
                let Some(aabb) = input.aabb(triangle) else { continue };
                let Some(cells) = input.grid.finest(&aabb) else {
                    large.push((triangle, aabb));
                    few.push(triangle as u32);
                    continue;
                };
                let role = usize::from(triangle >= input.mesh.cloth_triangles);
                let Some(marked) = &marked else {
                    first.for_each(&cells, |bucket, _| {
                        bump(&resident[2 * bucket as usize + role], shared);
                    });
                    continue;
                };
                let mut any = marked.coarse;
                first.for_each(&cells, |bucket, _| {
                    if marked.contains(bucket) {
                        bump(&resident[2 * bucket as usize + role], shared);
                        any = true;
                    }
                });
                if any {
                    few.push(triangle as u32);
                }
            }
            if let Ok(mut found) = found.lock() {
                found.0.append(&mut large);
                found.1.append(&mut few);
            }
        });
        let (large, mut few) = found.into_inner().unwrap_or_default();
        self.few = marked.is_some().then(|| {
            few.sort_unstable();
            few
        });
        let few = self.few.as_ref().map_or(0, |few| size_of_val(&few[..]));
        self.large_bytes = (size_of_val(&large[..]) + few) as u64;
        self.count_coarse(input, &large);
        self.count_visitors(cpu, input);
    }

    /// Residents of the coarser grids: few.
    fn count_coarse(&mut self, input: &Input, large: &[(usize, Aabb)]) {
        let mut members = [0; LEVELS];
        let mut bounds = [Aabb::EMPTY; LEVELS];
        for (_, aabb) in large {
            let (level, _) = input.grid.coarse(aabb);
            members[level] += 1;
            bounds[level] = bounds[level].join(*aabb);
        }
        let mut base = self.first;
        for level in (1..LEVELS).filter(|&level| members[level] > 0) {
            let buckets = Buckets::new(base, 4 * members[level]);
            base = buckets.end();
            self.levels.push(Level { level, buckets, bounds: bounds[level] });
        }
        self.resident.resize_with(2 * base, || AtomicU32::new(0));
        clear(&mut self.visiting, 2 * (base - self.first));
        for (triangle, aabb) in large {
            let role = usize::from(*triangle >= input.mesh.cloth_triangles);
            let (own, cells) = input.grid.coarse(aabb);
            for level in self.levels.iter().filter(|l| l.level == own) {
                level.buckets.for_each(&cells, |bucket, _| {
                    bump(&self.resident[2 * bucket as usize + role], false);
                });
            }
        }
    }

    fn count_visitors(&self, cpu: &CpuExecutor, input: &Input) {
        let shared = cpu.threads() > 1;
        if self.levels.len() == 1 {
            return;
        }
        cpu.for_ranges(self.triangles(input), GRAIN, |range| {
            for at in range {
                let triangle = self.triangle(at);
                let Some(aabb) = input.aabb(triangle) else { continue };
                let role = usize::from(triangle >= input.mesh.cloth_triangles);
                let own = if input.grid.finest(&aabb).is_some() { 0 } else { input.grid.coarse(&aabb).0 };
                self.for_each_visited(input, triangle, &aabb, own, |bucket, _| {
                    bump(&self.visiting[2 * (bucket as usize - self.first) + role], shared);
                });
            }
        });
    }

    /// Number of triangles that may have entries.
    pub fn triangles(&self, input: &Input) -> usize {
        self.few.as_ref().map_or(input.mesh.triangles.len(), Vec::len)
    }

    /// Triangle with number `at` among those that may have entries.
    #[inline(always)]
    pub fn triangle(&self, at: usize) -> usize {
        self.few.as_ref().map_or(at, |few| few[at] as usize)
    }

    /// Calls `visit(bucket, tag)` for the buckets that a triangle of grid `own` visits: those of coarser grids where
    /// there is a resident to test it with.
    #[inline(always)]
    pub fn for_each_visited(
        &self,
        input: &Input,
        triangle: usize,
        aabb: &Aabb,
        own: usize,
        mut visit: impl FnMut(u32, u32),
    ) {
        let obstacle = triangle >= input.mesh.cloth_triangles;
        for level in &self.levels[1..] {
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

    /// Grid (number and buckets) and cells where a box resides.
    #[inline(always)]
    pub fn home(&self, input: &Input, aabb: &Aabb) -> Option<(usize, Buckets, Cells)> {
        if let Some(cells) = input.grid.finest(aabb) {
            return Some((0, self.levels[0].buckets, cells));
        }
        let (own, cells) = input.grid.coarse(aabb);
        self.levels.iter().find(|l| l.level == own).map(|l| (own, l.buckets, cells))
    }

    #[inline(always)]
    fn residents(&self, bucket: usize) -> [u32; 2] {
        [self.resident[2 * bucket].load(Relaxed), self.resident[2 * bucket + 1].load(Relaxed)]
    }

    /// Number of buckets of all grids.
    pub fn buckets(&self) -> usize {
        self.resident.len() / 2
    }

    /// Whether a bucket belongs to a grid that has visitors.
    #[inline(always)]
    pub fn is_coarse(&self, bucket: usize) -> bool {
        bucket >= self.first
    }

    /// Who is in a bucket.
    #[inline(always)]
    pub fn load(&self, bucket: usize) -> Load {
        let [resident_cloth, resident_obstacles] = self.residents(bucket);
        let mut load = Load { resident_cloth, resident_obstacles, ..Load::default() };
        if self.is_coarse(bucket) {
            let at = 2 * (bucket - self.first);
            load.visiting_cloth = self.visiting[at].load(Relaxed);
            load.visiting_obstacles = self.visiting[at + 1].load(Relaxed);
        }
        load
    }

    /// Bytes of the counters, and of what counting needed besides.
    pub fn bytes(&self) -> u64 {
        4 * (self.resident.len() + self.visiting.len()) as u64 + self.large_bytes
    }
}
