//! A rank's rows as a sliced block-ELL matrix on the device: Index Table and Value Table in structure-of-arrays form.
//!
//! Value of component c (row-major in the 3x3 block) at block address a = slot * LANES + lane:
//! `values[(slot * 9 + c) * LANES + lane]`. Lanes are contiguous, so neighbouring device invocations and SIMD lanes read
//! neighbouring words.

use std::ops::Range;

use super::layout::{LANES, SellLayout};
use crate::gpu::{DeviceVec, Executor};

/// Values of a block.
pub const BLOCK: usize = 9;

/// Index of component `c` of the block at `address`.
#[inline(always)]
pub fn value_index(address: u32, c: usize) -> usize {
    let (slot, lane) = (address as usize / LANES, address as usize % LANES);
    (slot * BLOCK + c) * LANES + lane
}

/// The matrix; its pattern is fixed until it is built anew.
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
    /// Stored blocks, without padding.
    pub blocks: usize,
    /// Slots of each section, for byte counts.
    pub section_slots: Vec<usize>,
    /// Blocks of the longest row.
    pub longest_row: usize,
    /// Per section, parts that a device can bind; one each on the cpu executor.
    pub(crate) parts: Vec<Vec<SellPart>>,
    /// The same for all sections together.
    pub(crate) fill_parts: Vec<SellPart>,
}

/// Consecutive slices, and the slots they are stored in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SellPart {
    pub(crate) slices: Range<u32>,
    /// Rounded outwards to multiples of [`PART_STEP`], as far as there are slots.
    pub(crate) slots: Range<usize>,
}

/// Slots of a part begin at multiples of this: then its columns and values begin at multiples of 64 words.
const PART_STEP: usize = 4;

/// Cuts `section` into parts of at most `slots_max` slots (a single slice may have more: the device then refuses it).
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
        let slot = |slice: u32| layout.slice_offsets[slice as usize] as usize;
        let slots_max = match executor {
            Executor::Cpu(_) => usize::MAX / 2,
            Executor::Gpu(gpu) => gpu.window_items(LANES * BLOCK * size_of::<f32>()),
        };
        SellMatrix {
            rows,
            sections: layout.sections.clone(),
            row_of_lane: DeviceVec::upload(executor, &layout.row_of_lane),
            slice_offsets: DeviceVec::upload(executor, &layout.slice_offsets),
            columns: DeviceVec::upload(executor, &layout.columns),
            values: DeviceVec::zeros(executor, layout.slots() * BLOCK),
            blocks: layout.block_address.len(),
            longest_row: layout.slice_offsets.windows(2).map(|pair| (pair[1] - pair[0]) as usize).max().unwrap_or(0),
            parts: layout.sections.iter().map(|section| parts(&layout.slice_offsets, section, slots_max)).collect(),
            fill_parts: parts(&layout.slice_offsets, &(0..layout.slice_offsets.len() as u32 - 1), slots_max),
            section_slots: layout.sections.iter().map(|s| (slot(s.end) - slot(s.start)) * LANES).collect(),
        }
    }

    /// Bytes that multiplying section `section` moves: values and columns once, the vector entries at least once.
    pub fn section_bytes(&self, section: usize) -> u64 {
        (self.section_slots[section] * (BLOCK * 4 + 4) + self.sections[section].len() * LANES * 12) as u64
    }

    /// Device bytes of all tables.
    pub fn bytes(&self) -> u64 {
        self.row_of_lane.bytes() + self.slice_offsets.bytes() + self.columns.bytes() + self.values.bytes()
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
