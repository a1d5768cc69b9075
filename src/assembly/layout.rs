//! Layout of a sliced block-ELL matrix (SELL-C-sigma [Kreutzer et al. 2014]): the slice and lane of each row, and the
//! address of each block. P-Cloth pads every row to the longest of the rank [Li et al. 2020, Sec. 3.2.2]; slices of 16
//! rows sorted by length pad about 2 percent instead of 70 (docs/papers.md).

use std::ops::Range;

/// Rows per slice.
pub const LANES: usize = 16;
/// Rows are sorted by length within windows of this many rows. The window is long enough to even out slices and short
/// enough to keep the locality of the row order.
pub const SORT_WINDOW: usize = 256;
/// Lane without a row.
pub const NO_ROW: u32 = u32::MAX;

/// Placement of rows and blocks. Sections are ranges of slices that are multiplied at different times.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SellLayout {
    /// Row of every lane (slice * LANES + lane) or [`NO_ROW`].
    pub row_of_lane: Vec<u32>,
    /// Start of each slice in slots (columns of LANES blocks); one more than slices.
    pub slice_offsets: Vec<u32>,
    /// Column of every lane of every slot; padding repeats a valid column and its values stay zero.
    pub columns: Vec<u32>,
    /// Slices of each section.
    pub sections: Vec<Range<u32>>,
    /// Per stored block, in pattern order: slot * LANES + lane.
    pub block_address: Vec<u32>,
}

/// A contiguous range of one row's columns that belongs to one section.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Segment {
    /// Number of the row in the tables of its columns.
    pub index: u32,
    /// Own row.
    pub row: u32,
    /// Sub-vector of its columns (`full` mode).
    pub part: u32,
    /// Position of its first column in the row.
    pub first: u32,
    /// Number of its columns.
    pub length: u32,
}

/// Lanes of the segments, determined before any column is known.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Placement {
    /// See [`SellLayout::row_of_lane`].
    pub row_of_lane: Vec<u32>,
    /// See [`SellLayout::slice_offsets`].
    pub slice_offsets: Vec<u32>,
    /// See [`SellLayout::sections`].
    pub sections: Vec<Range<u32>>,
    /// Segment of every lane: index ([`NO_ROW`] for none), part, first, length.
    pub lanes: Vec<[u32; 4]>,
    /// Number of columns of all segments.
    pub blocks: usize,
}

impl Placement {
    /// Assigns the segments of each section to lanes: sorted by length within windows of [`SORT_WINDOW`], then cut into
    /// slices.
    pub(super) fn new(sections: &[Vec<Segment>]) -> Placement {
        let mut placement = Placement { slice_offsets: vec![0], ..Default::default() };
        let mut order: Vec<u64> = Vec::new();
        for segments in sections {
            order.clear();
            // Longest first; ties keep their order.
            order.extend(segments.iter().enumerate().map(|(i, s)| u64::from(u32::MAX - s.length) << 32 | i as u64));
            order.chunks_mut(SORT_WINDOW).for_each(<[u64]>::sort_unstable);
            let first_slice = placement.slice_offsets.len() as u32 - 1;
            for slice in order.chunks(LANES) {
                placement.push_slice(slice.iter().map(|&key| segments[key as u32 as usize]));
            }
            placement.sections.push(first_slice..placement.slice_offsets.len() as u32 - 1);
        }
        placement
    }

    fn push_slice(&mut self, segments: impl Iterator<Item = Segment>) {
        let (mut width, end) = (0, self.lanes.len() + LANES);
        for segment in segments {
            width = width.max(segment.length);
            self.blocks += segment.length as usize;
            self.row_of_lane.push(segment.row);
            self.lanes.push([segment.index, segment.part, segment.first, segment.length]);
        }
        self.row_of_lane.resize(end, NO_ROW);
        self.lanes.resize(end, [NO_ROW, 0, 0, 0]);
        self.slice_offsets.push(self.slice_offsets[self.slice_offsets.len() - 1] + width);
    }
}

impl SellLayout {
    /// Two sections for the `halo` exchange: rows with own columns only, then rows that read halo columns. A row keeps
    /// all its blocks together in ascending column order, so its sum does not depend on the section.
    pub fn halo(offsets: &[u32], columns: &[u32], own: Range<usize>) -> SellLayout {
        let mut sections = [Vec::new(), Vec::new()];
        for row in 0..offsets.len() - 1 {
            let range = offsets[row] as usize..offsets[row + 1] as usize;
            let remote = columns[range.clone()].iter().any(|&c| !own.contains(&(c as usize)));
            let (row, length) = (row as u32, range.len() as u32);
            sections[remote as usize].push(Segment { index: row, row, part: 0, first: 0, length });
        }
        Self::place(offsets, columns, &sections, |_, c| c)
    }

    /// One section per rank for the `full` exchange: the blocks A_ij of row block i [Li et al. 2020, Eq. 5], first the
    /// own one, then the others in the order `order`. Columns are indices into sub-vector j. The own section holds
    /// every row, so its product initializes the result.
    pub fn full(
        offsets: &[u32],
        columns: &[u32],
        global_from_local: &[u32],
        rows_of: &[Range<usize>],
        rank: usize,
        order: &[usize],
    ) -> SellLayout {
        let mut sections = vec![Vec::new(); order.len() + 1];
        let mut section_of_rank = vec![0; rows_of.len()];
        for (i, &j) in order.iter().enumerate() {
            section_of_rank[j] = i + 1;
        }
        for row in 0..offsets.len() - 1 {
            let mut k = offsets[row];
            while k < offsets[row + 1] {
                let global = global_from_local[columns[k as usize] as usize] as usize;
                let owner = rows_of.partition_point(|r| r.end <= global);
                let first = k;
                while k < offsets[row + 1]
                    && (global_from_local[columns[k as usize] as usize] as usize) < rows_of[owner].end
                {
                    k += 1;
                }
                let (row, part, length) = (row as u32, owner as u32, k - first);
                let first = first - offsets[row as usize];
                sections[section_of_rank[owner]].push(Segment { index: row, row, part, first, length });
            }
        }
        debug_assert!(section_of_rank[rank] == 0, "the own sub-vector comes first, without a stage");
        Self::place(offsets, columns, &sections, |part, c| {
            global_from_local[c as usize] - rows_of[part as usize].start as u32
        })
    }

    fn place(
        offsets: &[u32],
        columns: &[u32],
        sections: &[Vec<Segment>],
        renumber: impl Fn(u32, u32) -> u32,
    ) -> SellLayout {
        let Placement { row_of_lane, slice_offsets, sections, lanes, .. } = Placement::new(sections);
        let mut block_address = vec![0; columns.len()];
        let mut placed = vec![0; slice_offsets[slice_offsets.len() - 1] as usize * LANES];
        for (slice, lanes) in lanes.chunks_exact(LANES).enumerate() {
            let slots = slice_offsets[slice]..slice_offsets[slice + 1];
            for (lane, &[row, part, first, length]) in lanes.iter().enumerate() {
                // The first lane always holds a row; lanes without one repeat its column.
                let [row, part, first, length] = if row == NO_ROW { lanes[0] } else { [row, part, first, length] };
                let at = (offsets[row as usize] + first) as usize;
                for (k, slot) in slots.clone().enumerate() {
                    let address = slot * LANES as u32 + lane as u32;
                    let within = k < length as usize;
                    placed[address as usize] = renumber(part, columns[if within { at + k } else { at }]);
                    if within && lanes[lane][0] != NO_ROW {
                        block_address[at + k] = address;
                    }
                }
            }
        }
        SellLayout { row_of_lane, slice_offsets, columns: placed, sections, block_address }
    }

    /// Number of stored block slots, padding included.
    pub fn slots(&self) -> usize {
        self.columns.len()
    }

    /// Slots divided by stored blocks; 1 means no padding.
    pub fn padding_ratio(&self) -> f64 {
        self.slots() as f64 / self.block_address.len().max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halo_layout_separates_rows_and_addresses_every_block_once() {
        // Own rows are local 1..4 of a chain of 5; rows 0 and 2 read halo columns 0 and 4.
        let (offsets, columns) = ([0, 3, 6, 9], [0, 1, 2, 1, 2, 3, 2, 3, 4]);
        let layout = SellLayout::halo(&offsets, &columns, 1..4);
        assert_eq!(layout.sections, [0..1, 1..2]);
        assert_eq!(layout.row_of_lane[0], 1);
        assert_eq!(&layout.row_of_lane[LANES..LANES + 2], [0, 2]);
        assert_eq!(layout.slice_offsets, [0, 3, 6]);
        let mut addresses = layout.block_address.clone();
        for (block, &address) in layout.block_address.iter().enumerate() {
            assert_eq!(layout.columns[address as usize], columns[block]);
        }
        addresses.sort_unstable();
        addresses.dedup();
        assert_eq!(addresses.len(), columns.len());
    }

    #[test]
    fn full_layout_numbers_columns_within_their_sub_vector() {
        let (offsets, columns) = ([0, 3, 6], [0, 1, 2, 1, 2, 3]);
        // Global rows 0..6 over three ranks; rank 1 owns 2..4; local 0..4 = global 1..5.
        let layout = SellLayout::full(&offsets, &columns, &[1, 2, 3, 4], &[0..2, 2..4, 4..6], 1, &[2, 0]);
        assert_eq!(layout.sections.len(), 3);
        let first = |s: usize| layout.columns[layout.slice_offsets[layout.sections[s].start as usize] as usize * LANES];
        assert_eq!(first(0), 0);
        assert_eq!(first(1), 0, "column 4 is row 0 of sub-vector 2");
        assert_eq!(first(2), 1, "column 1 is row 1 of sub-vector 0");
        assert_eq!(layout.row_of_lane[LANES], 1);
        assert_eq!(layout.row_of_lane[2 * LANES], 0);
    }

    #[test]
    fn sorting_within_windows_keeps_padding_small() {
        // Every tenth row has contacts, as in a folded cloth.
        let lengths: Vec<u32> =
            (0..4096).map(|r: u32| if r.wrapping_mul(2654435761) >> 28 < 2 { 16 + r % 4 } else { 13 }).collect();
        let mut offsets = vec![0u32];
        for n in &lengths {
            offsets.push(offsets[offsets.len() - 1] + n);
        }
        let columns = vec![0; offsets[lengths.len()] as usize];
        assert!(SellLayout::halo(&offsets, &columns, 0..4096).padding_ratio() < 1.05);
    }
}
