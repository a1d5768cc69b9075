//! Space as kernels see it: layers of blocks of cells with buckets of their own, coarser grids, and which triangles a rank needs
//! for the layers that it counts. Host code; the same on every rank, whatever its device rounds.
//!
//! Cells of triangles are found on the device. The host knows each of them up to one neighbor, as the two may round
//! differently, so it hands over more triangles rather than fewer; buckets that a rank counts are counted in full.

use std::ops::Range;

use glam::{UVec3, Vec3A};

use super::hash::{CHUNK, HashParams, Window};
use super::levels::{LEVELS, REACH, home_of};
use crate::collision::broad::boxes::Aabb;
use crate::collision::broad::grid::{Buckets, Grid};
use crate::collision::broad::input::Input;
use crate::collision::broad::layers::{Layers, block};
use crate::collision::broad::patches::Patches;

/// Most cells per meter: with the largest coordinate still a finite number.
const PER_M_MOST: f32 = 1e18;
/// Exceeds the difference between a device's cells and this code's for the same position: relative, and in cells.
const ROUNDING: f32 = 1.0 / REACH;

/// The nested grids of the shader: cells of coarser ones are four times larger each.
#[derive(Clone, Copy)]
pub(super) struct Nested {
    origin: Vec3A,
    per_m: f32,
}

/// Lowest and highest cell that a device may find for a corner.
type Corner = [UVec3; 2];

impl Nested {
    pub(super) fn new(grid: &Grid) -> Nested {
        Nested { origin: grid.origin(), per_m: grid.finest_per_m().min(PER_M_MOST) }
    }

    fn corner(&self, x: Vec3A) -> Corner {
        let at = (x - self.origin) * self.per_m;
        let wrong = at.abs() * ROUNDING + Vec3A::splat(ROUNDING);
        [at - wrong, at + wrong].map(|at| {
            let cell = at.clamp(Vec3A::splat(-REACH), Vec3A::splat(REACH - 1.0)).floor() + Vec3A::splat(REACH);
            UVec3::from_array(cell.to_array().map(|cell| cell as u32))
        })
    }

    /// Both corners of a box.
    fn cells(&self, of: &Aabb) -> [Corner; 2] {
        [self.corner(of.lo), self.corner(of.hi)]
    }

    /// True if a triangle with this box may reside in a coarser grid.
    pub(super) fn may_be_large(&self, of: &Aabb) -> bool {
        let [lo, hi] = self.cells(of);
        home_of(lo[0], hi[1]) > 0
    }
}

/// Bounds of the possible residents of a coarser grid, in cells of the finest grid.
#[derive(Clone, Copy)]
struct LevelBounds {
    lo: UVec3,
    hi: UVec3,
}

/// The space of a query.
pub(super) struct Space {
    axis: usize,
    grid: Nested,
    layers: Layers,
    /// Buckets of the finest grid and of the coarser ones, by layer.
    buckets: Vec<[Buckets; 2]>,
    /// Grids with residents, as far as the host knows.
    levels: [Option<LevelBounds>; LEVELS],
}

impl Space {
    /// The space of the active patches.
    pub(super) fn new(input: &Input, patches: &Patches) -> Space {
        let (axis, grid) = (input.grid.longest(), Nested::new(&input.grid));
        let blocks = |patch: &u32| {
            let [lo, hi] = grid.cells(&patches.states[*patch as usize].aabb());
            let triangles = patches.triangles(*patch as usize).len();
            ([block(lo[0][axis]), block(hi[1][axis])], triangles)
        };
        let layers = Layers::of_blocks(axis, block(REACH as u32), patches.active.iter().map(blocks));
        let mut end = 0;
        let buckets_of = |&triangles: &u64| {
            let fine = Buckets::new(end, triangles as usize);
            let coarse = Buckets::new(fine.end(), triangles as usize / 4);
            end = coarse.end();
            [fine, coarse]
        };
        let buckets = layers.triangles().iter().map(buckets_of).collect();
        let levels = levels(input, &grid, patches);
        Space { axis, grid, layers, buckets, levels }
    }

    /// Number of layers.
    pub(super) fn layers(&self) -> usize {
        self.layers.count()
    }

    /// Buckets of all layers.
    pub(super) fn buckets(&self) -> usize {
        self.start(self.layers())
    }

    /// Layers that may hold about an even share of the tests.
    pub(super) fn guess(&self, rank: usize, ranks: usize) -> Range<usize> {
        self.layers.guess(rank, ranks)
    }

    fn start(&self, layer: usize) -> usize {
        match self.buckets.get(layer) {
            Some([fine, _]) => fine.start(),
            None => self.buckets.last().map_or(0, |[_, coarse]| coarse.end()),
        }
    }

    /// Chunks of a layer.
    pub(super) fn chunks_of(&self, layer: usize) -> usize {
        (self.start(layer + 1) - self.start(layer)).div_ceil(CHUNK)
    }

    /// What kernels need for the layers of a window and its [`Space::members`].
    pub(super) fn window(&self, input: &Input, layers: Range<usize>, members: &[u32]) -> Window {
        let first = self.start(layers.start);
        let of_layer = |layer: usize| {
            let [fine, coarse] = &self.buckets[layer];
            [(fine.start() - first) as u32, fine.bits() | coarse.bits() << 8]
        };
        let of_level = |level: &Option<LevelBounds>| match level {
            Some(LevelBounds { lo, hi }) => [lo.x, lo.y, lo.z, hi.x, hi.y, hi.z, 1, 0],
            None => [0; 8],
        };
        let mut chunks = Vec::new();
        for layer in layers.clone() {
            let (start, end) = (self.start(layer) - first, self.start(layer + 1) - first);
            chunks.extend((start..end).step_by(CHUNK).map(|at| [at as u32, (at + CHUNK).min(end) as u32]));
        }
        let cloth = members.partition_point(|&triangle| (triangle as usize) < input.mesh.cloth_triangles);
        let with = |v: Vec3A, w: f32| [v.x, v.y, v.z, w];
        let bounds = input.cloth_bounds();
        let params = HashParams {
            origin: with(self.grid.origin, self.grid.per_m),
            cloth_lo: with(bounds.lo, input.paths.pad_m()),
            cloth_hi: with(bounds.hi, 0.0),
            triangles: members.len() as u32,
            cloth_triangles: cloth as u32,
            axis: self.axis as u32,
            first_block: self.layers.first(),
            last_layer: self.layers() as u32 - 1,
            first_layer: layers.start as u32,
            layers: layers.len() as u32,
            chunks: chunks.len() as u32,
            first_bucket: 0,
            buckets: (self.start(layers.end) - first) as u32,
            padding0: 0,
            padding1: 0,
        };
        let table = layers.clone().map(of_layer).collect();
        Window { params, table, levels: self.levels.iter().map(of_level).collect(), chunks, layers }
    }

    /// Triangles with cells in the layers of a window, ascending, and perhaps a few more.
    pub(super) fn members(&self, input: &Input, patches: &Patches, window: &Range<usize>) -> Vec<u32> {
        let mut members = Vec::new();
        for &patch in &patches.active {
            let (aabb, triangles) = (patches.states[patch as usize].aabb(), patches.triangles(patch as usize));
            let within = self.fine(&self.grid.cells(&aabb));
            if window.start <= within.start && within.end <= window.end {
                members.extend(triangles.map(|triangle| triangle as u32));
            } else if self.reaches(&aabb, window) {
                let reaches = |&t: &usize| input.aabb(t).is_some_and(|aabb| self.reaches(&aabb, window));
                members.extend(triangles.filter(reaches).map(|triangle| triangle as u32));
            }
        }
        members
    }

    /// The layers where cells of the finest grid are.
    fn fine(&self, [lo, hi]: &[Corner; 2]) -> Range<usize> {
        let layer = |cell: UVec3| self.layers.layer(block(cell[self.axis]));
        layer(lo[0])..layer(hi[1]) + 1
    }

    /// True if a box may have a cell, of any grid, in the layers `window`.
    fn reaches(&self, of: &Aabb, window: &Range<usize>) -> bool {
        let cells = self.grid.cells(of);
        let fine = self.fine(&cells);
        if fine.start < window.end && window.start < fine.end {
            return true;
        }
        let [lo, hi] = [cells[0][0], cells[1][1]];
        (1..LEVELS).any(|level| {
            let near = self.levels[level].is_some_and(|all| lo.cmple(all.hi).all() && all.lo.cmple(hi).all());
            near && self.has_cell(level, lo[self.axis]..hi[self.axis] + 1, window)
        })
    }

    /// True if a cell of a coarser grid that holds some of the cells `fine` along the axis belongs to the layers
    /// `window`: to the layer of its lowest cell.
    fn has_cell(&self, level: usize, fine: Range<u32>, window: &Range<usize>) -> bool {
        let bits = 2 * level as u32;
        let from = if window.start == 0 { 0 } else { 2 * (self.layers.first() + window.start as u32) };
        let cell = from.div_ceil(1 << bits).max(fine.start >> bits);
        cell <= (fine.end - 1) >> bits && self.layers.layer(block(cell << bits)) < window.end
    }

    /// Bytes of the host's lists.
    pub(super) fn bytes(&self) -> u64 {
        self.layers.bytes() + size_of_val(&self.buckets[..]) as u64
    }
}

/// Bounds of what may reside in the coarser grids.
fn levels(input: &Input, grid: &Nested, patches: &Patches) -> [Option<LevelBounds>; LEVELS] {
    let mut levels: [Option<LevelBounds>; LEVELS] = [None; LEVELS];
    for &patch in patches.active.iter().filter(|&&p| patches.states[p as usize].is_large()) {
        for aabb in patches.triangles(patch as usize).filter_map(|triangle| input.aabb(triangle)) {
            let [lo, hi] = grid.cells(&aabb);
            let least = home_of(lo[1].min(hi[0]), hi[0]);
            for level in &mut levels[least..=home_of(lo[0], hi[1])] {
                let all = level.get_or_insert(LevelBounds { lo: lo[0], hi: hi[1] });
                *all = LevelBounds { lo: all.lo.min(lo[0]), hi: all.hi.max(hi[1]) };
            }
        }
    }
    // Residents of the finest grid do not visit it.
    levels[0] = None;
    levels
}
