//! Layers: the finest grid cut across its longest axis, one layer per block of cells, with buckets of its own. A range of
//! buckets is therefore a slab of space, and a rank that works on it need not look at triangles elsewhere. Holds
//! estimates of the number of triangles, not the triangles.

use std::ops::Range;

use super::boxes::Aabb;
use super::grid::{Buckets, Cells, Grid};

/// Largest number of layers; triangles beyond the outermost layer belong to it.
const MOST: u32 = 1024;

/// The layers of a query: a function of the query alone, so every rank has the same.
#[derive(Default)]
pub(super) struct Layers {
    axis: usize,
    /// Block of the first layer (biased).
    first: u32,
    buckets: Vec<Buckets>,
    /// Triangles that each layer may have, roughly.
    triangles: Vec<u64>,
}

/// The block of a cell.
pub(super) fn block(cell: u32) -> u32 {
    cell >> 1
}

impl Layers {
    /// Layers for boxes of several triangles each.
    pub(super) fn new<'a>(grid: &Grid, boxes: impl Iterator<Item = (&'a Aabb, usize)> + Clone) -> Layers {
        let axis = grid.longest();
        let middle = block(grid.cells(0, &Aabb { lo: grid.origin(), hi: grid.origin() }).lo[axis]);
        let blocks = |of: &Aabb| {
            let cells = grid.cells(0, of);
            [block(cells.lo[axis]), block(cells.hi[axis])]
        };
        Layers::of_blocks(axis, middle, boxes.map(|(of, triangles)| (blocks(of), triangles)))
    }

    /// Layers around the block `middle` for lowest and highest block and triangles of every box.
    pub(super) fn of_blocks(
        axis: usize,
        middle: u32,
        boxes: impl Iterator<Item = ([u32; 2], usize)> + Clone,
    ) -> Layers {
        let (low, high) = boxes.clone().fold((u32::MAX, 0), |(low, high), ([lo, hi], _)| (low.min(lo), high.max(hi)));
        let low = low.clamp(middle - MOST / 2, middle);
        let high = high.clamp(middle, middle + MOST / 2 - 1);
        let mut layers = Layers { axis, first: low, buckets: Vec::new(), triangles: Vec::new() };
        layers.triangles.resize((high - low) as usize + 1, 0);
        for (blocks, triangles) in boxes {
            let [lo, hi] = blocks.map(|block| layers.layer(block));
            let each = triangles.div_ceil(hi - lo + 1) as u64;
            layers.triangles[lo..=hi].iter_mut().for_each(|count| *count += each);
        }
        let mut base = 0;
        for &triangles in &layers.triangles {
            let buckets = Buckets::new(base, triangles as usize);
            base = buckets.end();
            layers.buckets.push(buckets);
        }
        layers
    }

    /// The layer of a block.
    pub(super) fn layer(&self, block: u32) -> usize {
        let last = self.triangles.len().saturating_sub(1);
        (block.saturating_sub(self.first) as usize).min(last)
    }

    /// Block of the first layer.
    pub(super) fn first(&self) -> u32 {
        self.first
    }

    /// Triangles that each layer may have, roughly.
    pub(super) fn triangles(&self) -> &[u64] {
        &self.triangles
    }

    /// Number of layers.
    pub(super) fn count(&self) -> usize {
        self.buckets.len()
    }

    /// Layers that a box touches.
    #[inline(always)]
    pub(super) fn touched_by(&self, cells: &Cells) -> Range<usize> {
        self.layer(block(cells.lo[self.axis]))..self.layer(block(cells.hi[self.axis])) + 1
    }

    /// First bucket of a layer, or the end of all for the one after the last.
    pub(super) fn start(&self, layer: usize) -> usize {
        match self.buckets.get(layer) {
            Some(buckets) => buckets.start(),
            None => self.buckets.last().map_or(0, Buckets::end),
        }
    }

    /// The layers with buckets in a range that is not empty.
    pub(super) fn holding(&self, buckets: &Range<usize>) -> Range<usize> {
        let start = self.buckets.partition_point(|layer| layer.end() <= buckets.start);
        start..self.buckets.partition_point(|layer| layer.start() < buckets.end).max(start)
    }

    /// Calls `visit(bucket, tag)` for each cell in the layers `wanted`; the buckets differ.
    #[inline(always)]
    pub(super) fn for_each(&self, cells: &Cells, wanted: &Range<usize>, mut visit: impl FnMut(u32, u32)) {
        let low = cells.lo[self.axis];
        let buckets = [low, cells.hi[self.axis]].map(|cell| {
            let layer = self.layer(block(cell));
            wanted.contains(&layer).then(|| self.buckets[layer])
        });
        if buckets[0].is_none() && buckets[1].is_none() {
            return;
        }
        cells.for_each(|cell, tag| {
            if let Some(buckets) = &buckets[usize::from(cell[self.axis] != low)] {
                visit(buckets.bucket(cell), tag);
            }
        });
    }

    /// Consecutive layers with about as many triangles for each of `ranks`.
    pub(super) fn guess(&self, rank: usize, ranks: usize) -> Range<usize> {
        let total = self.triangles.iter().sum::<u64>().max(1);
        let cut = |rank: usize| {
            let mut before = 0;
            let wanted = u128::from(total) * rank as u128;
            self.triangles
                .iter()
                .take_while(|&&triangles| {
                    before += triangles;
                    u128::from(2 * before - triangles) * ranks as u128 <= 2 * wanted
                })
                .count()
        };
        let end = if rank + 1 == ranks { self.count() } else { cut(rank + 1) };
        (if rank == 0 { 0 } else { cut(rank) })..end
    }

    /// Bytes of the lists, unused capacity left out.
    pub(super) fn bytes(&self) -> u64 {
        (size_of_val(&self.buckets[..]) + size_of_val(&self.triangles[..])) as u64
    }
}
