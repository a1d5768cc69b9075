//! A rank's rows as a sliced block-ELL matrix on the device: Index Table and Value Table in structure-of-arrays form.
//!
//! Value of component c (row-major in the 3x3 block) at block address a = slot * LANES + lane:
//! `values[(slot * 9 + c) * LANES + lane]`.
//! Lanes are contiguous, so neighboring device invocations and SIMD lanes read neighboring words.

use std::ops::Range;

use super::layout::{LANES, NO_ROW, Placement, SellLayout};
use crate::gpu::{DeviceVec, Executor};

/// Values of a block.
pub const BLOCK: usize = 9;

/// Index of component `c` of the block at `address`.
#[inline(always)]
pub fn value_index(address: u32, c: usize) -> usize {
    let (slot, lane) = (address as usize / LANES, address as usize % LANES);
    (slot * BLOCK + c) * LANES + lane
}

/// A block matrix with a fixed pattern until it is rebuilt.
pub struct SellMatrix {
    /// Own rows.
    pub rows: usize,
    /// Slices of each section (`halo`: rows without and with halo columns; `full`: one per sub-vector).
    pub sections: Vec<Range<u32>>,
    /// See [`SellLayout::row_of_lane`].
    pub row_of_lane: DeviceVec<u32>,
    /// See [`SellLayout::slice_offsets`].
    pub slice_offsets: DeviceVec<u32>,
    /// Index Table.
    pub columns: DeviceVec<u32>,
    /// Value Table.
    pub values: DeviceVec<f32>,
    /// True for the elastic matrix of a cloth: y_i = D_i x_i + sum of A_ij (x_j - x_i) over j != i. The diagonal block
    /// holds D_i, all that acts on absolute velocity. False: y_i = sum of A_ij x_j.
    pub difference: bool,
    /// Stored blocks, without padding.
    pub blocks: usize,
    /// Slots of each section, for byte counts.
    pub section_slots: Vec<usize>,
    /// Blocks of the longest row.
    pub longest_row: usize,
    /// Own rows of all sections but the first, ascending.
    pub(crate) late_rows: Vec<u32>,
    /// Parts of each section that a device can bind; on the cpu executor one per section.
    pub(crate) parts: Vec<Vec<SellPart>>,
    /// Parts of all sections together.
    pub(crate) fill_parts: Vec<SellPart>,
}

/// Consecutive slices and the range of their slots.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SellPart {
    pub(crate) slices: Range<u32>,
    /// Rounded outward to multiples of [`PART_STEP`], at most to the number of slots.
    pub(crate) slots: Range<usize>,
}

/// Slots of a part begin at multiples of this number, so that its columns and values begin at multiples of 64 words.
const PART_STEP: usize = 4;

/// Cuts `section` into parts of at most `slots_max` slots. A single slice may have more; the device then refuses it.
fn parts(slice_offsets: &[u32], section: &Range<u32>, slots_max: usize) -> Vec<SellPart> {
    let mut parts = Vec::new();
    let mut first = section.start;
    while first < section.end {
        let start = slice_offsets[first as usize] as usize / PART_STEP * PART_STEP;
        let fits = |end: u32| slice_offsets[end as usize] as usize <= start + slots_max;
        let mut end = first + 1;
        while end < section.end && fits(end + 1) {
            end += 1;
        }
        parts.push(SellPart { slices: first..end, slots: start..slice_offsets[end as usize] as usize });
        first = end;
    }
    parts
}

impl SellMatrix {
    /// A zero matrix with this layout.
    pub fn new(executor: &Executor, rows: usize, layout: &SellLayout) -> SellMatrix {
        let mut matrix = SellMatrix::empty(executor, rows);
        matrix.allocate(
            executor,
            &layout.row_of_lane,
            &layout.slice_offsets,
            &layout.sections,
            layout.block_address.len(),
        );
        matrix.columns = DeviceVec::upload(executor, &layout.columns);
        matrix
    }

    /// A matrix of `rows` rows without blocks.
    pub(super) fn empty(executor: &Executor, rows: usize) -> SellMatrix {
        SellMatrix {
            rows,
            sections: Vec::new(),
            row_of_lane: DeviceVec::zeros(executor, 0),
            slice_offsets: DeviceVec::zeros(executor, 0),
            columns: DeviceVec::zeros(executor, 0),
            values: DeviceVec::zeros(executor, 0),
            difference: false,
            blocks: 0,
            section_slots: Vec::new(),
            longest_row: 0,
            late_rows: Vec::new(),
            parts: Vec::new(),
            fill_parts: Vec::new(),
        }
    }

    /// Makes room for `placement`. The caller fills columns, then values, padding included. Newly allocated memory is
    /// zero.
    pub(super) fn place(&mut self, executor: &Executor, placement: &Placement) {
        let Placement { row_of_lane, slice_offsets, sections, blocks, .. } = placement;
        self.allocate(executor, row_of_lane, slice_offsets, sections, *blocks);
    }

    fn allocate(
        &mut self,
        executor: &Executor,
        row_of_lane: &[u32],
        slice_offsets: &[u32],
        sections: &[Range<u32>],
        blocks: usize,
    ) {
        let slot = |slice: u32| slice_offsets[slice as usize] as usize;
        let slots_max = match executor {
            Executor::Cpu(_) => usize::MAX / 2,
            Executor::Gpu(gpu) => gpu.window_items(LANES * BLOCK * size_of::<f32>()),
        };
        let slices = slice_offsets.len() as u32 - 1;
        let slots = slot(slices) * LANES;
        if self.columns.is_empty() {
            (self.columns, self.values) =
                (DeviceVec::zeros(executor, slots), DeviceVec::zeros(executor, slots * BLOCK));
        }
        self.columns.resize(executor, slots);
        self.values.resize(executor, slots * BLOCK);
        self.row_of_lane.assign(executor, row_of_lane);
        self.slice_offsets.assign(executor, slice_offsets);
        self.sections = sections.to_vec();
        self.blocks = blocks;
        self.longest_row = slice_offsets.windows(2).map(|pair| (pair[1] - pair[0]) as usize).max().unwrap_or(0);
        self.parts = sections.iter().map(|section| parts(slice_offsets, section, slots_max)).collect();
        self.fill_parts = parts(slice_offsets, &(0..slices), slots_max);
        self.section_slots = sections.iter().map(|s| (slot(s.end) - slot(s.start)) * LANES).collect();
        let first_late = sections.first().map_or(0, |section| section.end as usize) * LANES;
        self.late_rows.clear();
        self.late_rows.extend(row_of_lane[first_late..].iter().copied().filter(|&row| row != NO_ROW));
        self.late_rows.sort_unstable();
        self.late_rows.dedup();
    }

    /// Slots divided by stored blocks; 1 means no padding.
    pub fn padding_ratio(&self) -> f64 {
        self.columns.len() as f64 / self.blocks.max(1) as f64
    }

    /// Slot after the last of each section.
    pub(super) fn section_ends(&self, executor: &Executor) -> Vec<u32> {
        let offsets = self.slice_offsets.host(executor);
        self.sections.iter().map(|section| offsets[section.end as usize]).collect()
    }

    /// Calls `visit(section, row, column, block)` for all blocks, padding included, row by row, in the order of a row's
    /// sum. On a device this copies the whole matrix.
    pub fn for_each_block(&self, executor: &Executor, mut visit: impl FnMut(usize, u32, u32, [f32; BLOCK])) {
        let (offsets, lanes) = (self.slice_offsets.host(executor), self.row_of_lane.host(executor));
        let (columns, values) = (self.columns.host(executor), self.values.host(executor));
        let mut places: Vec<(u32, u32, u32)> = Vec::new();
        for (section, slices) in self.sections.iter().enumerate() {
            let lanes_of = slices.start as usize * LANES..slices.end as usize * LANES;
            let rows = lanes_of.filter(|&lane| lanes[lane] != NO_ROW);
            places.extend(rows.map(|lane| (lanes[lane], section as u32, lane as u32)));
        }
        places.sort_unstable();
        for (row, section, lane) in places {
            let (slice, lane) = (lane as usize / LANES, lane % LANES as u32);
            for slot in offsets[slice]..offsets[slice + 1] {
                let address = slot * LANES as u32 + lane;
                let block = std::array::from_fn(|c| values[value_index(address, c)]);
                visit(section as usize, row, columns[address as usize], block);
            }
        }
    }

    /// Bytes moved by a product with section `section`: values and columns once, the vector entries at least once.
    pub fn section_bytes(&self, section: usize) -> u64 {
        let vectors = if self.difference { 24 } else { 12 };
        (self.section_slots[section] * (BLOCK * 4 + 4) + self.sections[section].len() * LANES * vectors) as u64
    }

    /// Device bytes of all tables.
    pub fn bytes(&self) -> u64 {
        self.row_of_lane.held_bytes()
            + self.slice_offsets.held_bytes()
            + self.columns.held_bytes()
            + self.values.held_bytes()
    }
}

/// The matrix of a step as a sum of two: the elastic matrix with every diagonal block, and the couplings that only
/// contacts make. y = elastic x + contact x, each row in this order, so contacts never move an elastic block.
#[derive(Clone, Copy)]
pub struct SystemMatrix<'a> {
    /// Fixed pattern, in difference form; diagonal blocks hold masses, air drag and the contacts' share.
    pub elastic: &'a SellMatrix,
    /// Off-diagonal contact blocks of the rows with contacts, in the same sections as `elastic`. None without contacts.
    pub contact: Option<&'a SellMatrix>,
}

impl<'a> From<&'a SellMatrix> for SystemMatrix<'a> {
    fn from(elastic: &'a SellMatrix) -> SystemMatrix<'a> {
        SystemMatrix { elastic, contact: None }
    }
}

impl SystemMatrix<'_> {
    /// The matrices, in the order in which a row adds them.
    pub fn parts(&self) -> impl Iterator<Item = &SellMatrix> {
        std::iter::once(self.elastic).chain(self.contact)
    }

    /// Bytes moved by a product with section `section` of both; rows with contacts are read and written once more.
    pub fn section_bytes(&self, section: usize) -> u64 {
        let again = self.contact.map_or(0, |contact| contact.sections[section].len() * LANES * 24);
        self.parts().map(|matrix| matrix.section_bytes(section)).sum::<u64>() + again as u64
    }

    /// Operations of multiplying section `section` of both.
    pub fn section_flops(&self, section: usize) -> u64 {
        self.parts().map(|matrix| matrix.section_slots[section] as u64 * 18).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_cover_a_section_and_fit() {
        let offsets = [0, 3, 9, 14, 20, 21];
        let all = parts(&offsets, &(0..5), 100);
        assert_eq!(all, [SellPart { slices: 0..5, slots: 0..21 }]);
        let some = parts(&offsets, &(1..5), 12);
        let slices: Vec<_> = some.iter().map(|p| p.slices.clone()).collect();
        assert_eq!(slices, [1..2, 2..4, 4..5]);
        assert_eq!(some[1].slots, 8..20);
        assert!(parts(&offsets, &(2..2), 12).is_empty());
    }
}
