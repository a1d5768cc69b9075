//! Cells and buckets. A hierarchy of uniform grids, each four times coarser than the one before: a triangle *resides* in
//! the finest grid whose cells are at least as large as its box, so it covers at most 2 x 2 x 2 cells, and *visits* all
//! coarser grids that have residents. A floor of two triangles therefore takes a few entries, not one per cell below
//! it.
//!
//! Cells are hashed into buckets by blocks of 2 x 2 x 2: the block is hashed, the place in the block is kept. The (up to
//! eight) cells of one triangle therefore never share a bucket, and a block is one cache line of counters.

use glam::{Vec3A, Vec4};

use super::boxes::{Aabb, Trajectories};
use super::mesh::CollisionMesh;

/// Number of grids. The last one has one cell for all of space and takes the triangles that no other takes.
pub(super) const LEVELS: usize = 16;
/// Side of a cell over the near-largest box. If sizes differ widely it is twice this over a near-smallest box, and the
/// coarser grids take the larger ones.
const CELL_FACTOR: f32 = 1.5;
/// Boxes looked at to choose the cell size.
const SAMPLES: usize = 512;
/// Cells per axis and direction; farther positions share the outermost cell.
const REACH: f32 = (1 << 20) as f32;
/// Added to a coordinate, it leaves the nearest integer in the low bits of the sum.
const MAGIC: f32 = (3 << 22) as f32;

/// The cells of a box in one grid: lower and upper cell per axis, as biased integers that differ by at most 1.
#[derive(Clone, Copy)]
pub(super) struct Cells {
    pub lo: [u32; 3],
    pub hi: [u32; 3],
}

/// Sizes and origin of the grids; a function of the query alone, so every rank has the same.
pub(super) struct Grid {
    origin: Vec3A,
    cell_m: [f32; LEVELS],
    per_m: [f32; LEVELS],
    /// The axis along which most of the cloth is spread out farthest.
    longest: usize,
}

impl Grid {
    /// Cells fit most (sampled) cloth triangles; the origin is the median of the samples, so that a piece far away
    /// costs the rest no resolution.
    pub(super) fn new(mesh: &CollisionMesh, paths: &Trajectories) -> Grid {
        let stride = mesh.cloth_triangles.div_ceil(SAMPLES).max(1);
        let boxes: Vec<Aabb> =
            mesh.triangles[..mesh.cloth_triangles].iter().step_by(stride).map(|&t| paths.triangle(t)).collect();
        let quantile = |value: &dyn Fn(&Aabb) -> f32, part: f32| {
            let mut values: Vec<f32> = boxes.iter().map(value).collect();
            let at = (values.len() as f32 * part) as usize;
            if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(at, f32::total_cmp).1 }
        };
        let middle = |axis: usize| quantile(&|b| 0.5 * (b.lo[axis] + b.hi[axis]), 0.5);
        let (small, large) = (quantile(&Aabb::extent, 0.25), quantile(&Aabb::extent, 0.97));
        let mut size = (CELL_FACTOR * large).min(2.0 * CELL_FACTOR * small).max(1e-30);
        let (mut cell_m, mut per_m) = ([f32::INFINITY; LEVELS], [0.0; LEVELS]);
        for level in 0..LEVELS - 1 {
            (cell_m[level], per_m[level]) = (size, 1.0 / size);
            size *= 4.0;
        }
        let spread = |axis: usize| {
            let mut middles: Vec<f32> = boxes.iter().step_by(8).map(|b| 0.5 * (b.lo[axis] + b.hi[axis])).collect();
            middles.sort_unstable_by(f32::total_cmp);
            let at = |part: usize| middles.get(middles.len() * part / 10).copied().unwrap_or(0.0);
            at(9) - at(1)
        };
        let spread = [spread(0), spread(1), spread(2)];
        let longest = (1..3).fold(0, |longest, axis| if spread[axis] > spread[longest] { axis } else { longest });
        Grid { origin: Vec3A::new(middle(0), middle(1), middle(2)), cell_m, per_m, longest }
    }

    /// The axis along which most of the cloth is spread out farthest.
    pub(super) fn longest(&self) -> usize {
        self.longest
    }

    /// Origin of all grids.
    pub(super) fn origin(&self) -> Vec3A {
        self.origin
    }

    /// Cells of the finest grid per meter.
    pub(super) fn finest_per_m(&self) -> f32 {
        self.per_m[0]
    }

    /// Cells of a box. Monotone in each bound, whatever is rounded or cut off, so boxes that overlap share the cell of
    /// the lower corner of their intersection.
    #[inline(always)]
    pub(super) fn cells(&self, level: usize, of: &Aabb) -> Cells {
        let scale = Vec3A::splat(self.per_m[level]);
        let cell = |x: Vec3A| {
            let cell =
                ((x - self.origin) * scale).clamp(Vec3A::splat(-REACH), Vec3A::splat(REACH)) + Vec3A::splat(MAGIC);
            cell.to_array().map(f32::to_bits)
        };
        Cells { lo: cell(of.lo), hi: cell(of.hi) }
    }

    /// The cells of a box in the first grid, if it resides there.
    #[inline(always)]
    pub(super) fn finest(&self, of: &Aabb) -> Option<Cells> {
        self.resides(0, of)
    }

    #[inline(always)]
    fn resides(&self, level: usize, of: &Aabb) -> Option<Cells> {
        let cells = self.cells(level, of);
        // Rounding far from the origin may spread a box over more cells than its size says.
        let apart = (0..3).fold(0, |apart, k| apart | (cells.hi[k] - cells.lo[k]));
        ((of.hi - of.lo).cmple(Vec3A::splat(self.cell_m[level])).all() && apart <= 1).then_some(cells)
    }

    /// Grid and cells where a box resides that does not reside in the first.
    pub(super) fn coarse(&self, of: &Aabb) -> (usize, Cells) {
        (1..LEVELS - 1)
            .find_map(|level| self.resides(level, of).map(|cells| (level, cells)))
            .unwrap_or_else(|| (LEVELS - 1, self.cells(LEVELS - 1, of)))
    }
}

/// The buckets of one grid.
#[derive(Clone, Copy)]
pub(super) struct Buckets {
    /// First bucket; a multiple of 8.
    base: u32,
    /// log2 of the number of blocks of 8 buckets.
    bits: u32,
}

impl Buckets {
    /// Buckets for `residents` triangles behind the first `base` buckets.
    pub(super) fn new(base: usize, residents: usize) -> Buckets {
        let blocks = (residents / 12).next_power_of_two();
        Buckets { base: base as u32, bits: blocks.trailing_zeros() }
    }

    pub(super) fn start(&self) -> usize {
        self.base as usize
    }

    /// log2 of the number of blocks of 8 buckets.
    pub(super) fn bits(&self) -> u32 {
        self.bits
    }

    pub(super) fn end(&self) -> usize {
        self.base as usize + (8usize << self.bits)
    }

    /// Calls `visit(bucket, tag)` for each cell; the buckets differ.
    #[inline(always)]
    pub(super) fn for_each(&self, cells: &Cells, mut visit: impl FnMut(u32, u32)) {
        cells.for_each(|cell, tag| visit(self.bucket(cell), tag));
    }

    /// The bucket of a cell.
    #[inline(always)]
    pub(super) fn bucket(&self, [x, y, z]: [u32; 3]) -> u32 {
        let mix = [0x9E37_79B1u32, 0x85EB_CA77, 0xC2B2_AE3D];
        let hash = (x >> 1).wrapping_mul(mix[0]) ^ (y >> 1).wrapping_mul(mix[1]) ^ (z >> 1).wrapping_mul(mix[2]);
        let hash = (hash ^ (hash >> 15)).wrapping_mul(0x2C1B_3C6D);
        let block = ((u64::from(hash) << self.bits) >> 32) as u32;
        self.base + block * 8 + ((x & 1) | (y & 1) << 1 | (z & 1) << 2)
    }
}

impl Cells {
    /// Calls `visit(cell, tag)` for each cell. The tag (see [`same_cell_first`]) holds in bits 0-2 whether the cell is the
    /// box's lowest along x, y, z, in bits 3-5 the second lowest bits of its coordinates.
    #[inline(always)]
    pub(super) fn for_each(&self, mut visit: impl FnMut([u32; 3], u32)) {
        for z in self.lo[2]..=self.hi[2] {
            for y in self.lo[1]..=self.hi[1] {
                for x in self.lo[0]..=self.hi[0] {
                    let first =
                        u32::from(x == self.lo[0]) | u32::from(y == self.lo[1]) << 1 | u32::from(z == self.lo[2]) << 2;
                    let second = (x >> 1 & 1) | (y >> 1 & 1) << 1 | (z >> 1 & 1) << 2;
                    visit([x, y, z], first | second << 3);
                }
            }
        }
    }
}

/// Bit of a tag: pairs of this triangle are wanted whatever the other is.
pub(super) const WANTED: u32 = 0x40;

/// True if two boxes *that overlap* and met in a bucket met in the cell of the lower corner of their intersection,
/// which is the one place where the pair is reported.
///
/// Per axis that cell is the higher of the two lowest cells, so one of the boxes must have its lowest cell here. That
/// holds if both are here for the same cell. If they are here for two cells of one bucket, these are equal in the lowest
/// bits (the place in the block) and, as the boxes overlap and cover two cells per axis, at most two apart: then they
/// differ in the second lowest bits.
///
/// False as well if neither of the two is [`WANTED`].
#[inline(always)]
pub(super) fn same_cell_first(tag: u32, other: u32) -> bool {
    ((tag | other) & (7 | WANTED) == 7 | WANTED) & ((tag ^ other) & 0x38 == 0)
}

/// A triangle in a bucket: its box, negated above so that an overlap is one comparison of eight numbers.
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(16))]
pub(super) struct Entry {
    lo: [f32; 3],
    tag: u32,
    minus_hi: [f32; 3],
    pub triangle: u32,
}

impl Entry {
    #[inline(always)]
    pub(super) fn new(of: &Aabb, tag: u32, triangle: u32) -> Entry {
        Entry { lo: of.lo.to_array(), tag, minus_hi: (-of.hi).to_array(), triangle }
    }

    #[inline(always)]
    pub(super) fn aabb(&self) -> Aabb {
        Aabb { lo: Vec3A::from_array(self.lo), hi: -Vec3A::from_array(self.minus_hi) }
    }

    /// The operand of [`Entry::meets`].
    #[inline(always)]
    pub(super) fn probe(&self) -> Probe {
        let ([lx, ly, lz], [hx, hy, hz]) = (self.lo, self.minus_hi);
        Probe { hi: Vec4::new(-hx, -hy, -hz, 0.0), minus_lo: Vec4::new(-lx, -ly, -lz, 0.0), tag: self.tag }
    }

    /// True if the boxes overlap and this bucket is the one to report the pair in.
    #[inline(always)]
    pub(super) fn meets(&self, probe: &Probe) -> bool {
        let [lo, minus_hi]: &[Vec4; 2] = bytemuck::cast_ref(self);
        let overlap = (lo.cmple(probe.hi) & minus_hi.cmple(probe.minus_lo)).bitmask() & 7 == 7;
        overlap & same_cell_first(self.tag, probe.tag)
    }
}

/// One side of many box tests.
pub(super) struct Probe {
    hi: Vec4,
    minus_lo: Vec4,
    tag: u32,
}
