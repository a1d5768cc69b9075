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
}

impl SellMatrix {
    /// A zero matrix with this layout.
    pub fn new(executor: &Executor, rows: usize, layout: &SellLayout) -> SellMatrix {
        let slot = |slice: u32| layout.slice_offsets[slice as usize] as usize;
        SellMatrix {
            rows,
            sections: layout.sections.clone(),
            row_of_lane: DeviceVec::upload(executor, &layout.row_of_lane),
            slice_offsets: DeviceVec::upload(executor, &layout.slice_offsets),
            columns: DeviceVec::upload(executor, &layout.columns),
            values: DeviceVec::zeros(executor, layout.slots() * BLOCK),
            blocks: layout.block_address.len(),
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
