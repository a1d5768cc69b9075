//! Element lists of rows: the elements that contribute to a row and the row's corner in each, in ascending element
//! order.

use crate::gpu::DeviceVec;

/// Contributions of one kind of element (triangles or hinges) to a rank's own rows.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ElementRows {
    /// Start of each row's list in `entries`; one more than rows.
    pub offsets: Vec<u32>,
    /// Element and the row's corner in it, packed as `element << 2 | corner`.
    pub entries: Vec<u32>,
}

/// [`ElementRows`] in the executor's memory.
#[derive(Clone, Copy)]
pub struct RowLists<'a> {
    /// See [`ElementRows::offsets`].
    pub offsets: &'a DeviceVec<u32>,
    /// See [`ElementRows::entries`].
    pub entries: &'a DeviceVec<u32>,
}

impl ElementRows {
    /// Largest element number that fits an entry.
    pub const ELEMENTS_MAX: usize = 1 << 30;

    /// Lists of the rows `own` (local indices) over `elements`, each given by its corner vertices (local indices).
    pub fn new<const CORNERS: usize>(own: std::ops::Range<usize>, elements: &[[u32; CORNERS]]) -> ElementRows {
        assert!(elements.len() < Self::ELEMENTS_MAX, "too many elements on one rank");
        let row = |v: u32| (v as usize).checked_sub(own.start).filter(|&r| r < own.len());
        let mut offsets = vec![0u32; own.len() + 1];
        for r in elements.iter().flatten().filter_map(|&v| row(v)) {
            offsets[r + 1] += 1;
        }
        for r in 0..own.len() {
            offsets[r + 1] += offsets[r];
        }
        let mut next = offsets.clone();
        let mut entries = vec![0u32; offsets[own.len()] as usize];
        for (e, corners) in elements.iter().enumerate() {
            for (corner, &v) in corners.iter().enumerate() {
                if let Some(r) = row(v) {
                    entries[next[r] as usize] = (e as u32) << 2 | corner as u32;
                    next[r] += 1;
                }
            }
        }
        ElementRows { offsets, entries }
    }

    /// Entries of row `row`.
    pub fn row(&self, row: usize) -> &[u32] {
        &self.entries[self.offsets[row] as usize..self.offsets[row + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_triangles_share_an_edge_and_only_own_rows_are_listed() {
        let rows = ElementRows::new(1..4, &[[0, 1, 2], [2, 1, 3]]);
        assert_eq!(rows.offsets, [0, 2, 4, 5]);
        assert_eq!(rows.row(0), [1, 4 | 1]);
        assert_eq!(rows.row(1), [2, 4]);
        assert_eq!(rows.row(2), [4 | 2]);
    }
}
