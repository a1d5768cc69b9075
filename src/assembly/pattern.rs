//! Index filling and compacting [Li et al. 2020, Sec. 3.2.2, steps 2 and 3]: the distinct columns of every row, ascending, and
//! for every contribution the positions of its corners among them.
//!
//! Runs when the set of elements changes, not every step: without contacts that is once per run.

use super::element_rows::ElementRows;
use crate::gpu::CpuExecutor;

/// Sparsity pattern of a rank's rows. Columns are local vertex indices (ascending local = ascending global).
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Pattern {
    /// Start of each row's columns; one more than rows.
    pub offsets: Vec<u32>,
    /// Distinct columns of every row, ascending; the row itself is always among them.
    pub columns: Vec<u32>,
    /// Per triangle entry: position in its row of corners 0, 1, 2 (the fourth is unused).
    pub triangle_positions: Vec<[u16; 4]>,
    /// Per hinge entry: position in its row of corners 0..4.
    pub hinge_positions: Vec<[u16; 4]>,
}

/// A row with more columns than positions can name.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("vertex {local} is coupled to {columns} others; at most {max} fit", max = u16::MAX)]
pub struct RowTooLong {
    /// Local row.
    pub local: usize,
    /// Its columns.
    pub columns: usize,
}

impl Pattern {
    /// Pattern of the rows `own` from their triangle and hinge contributions.
    pub fn new(
        cpu: &CpuExecutor,
        own: std::ops::Range<usize>,
        triangles: (&ElementRows, &[[u32; 3]]),
        hinges: (&ElementRows, &[[u32; 4]]),
    ) -> Result<Pattern, RowTooLong> {
        let rows = own.len();
        // Upper bound per row, as the paper allocates: every corner of every contribution, and the row itself.
        let mut bounds = vec![0usize; rows + 1];
        for r in 0..rows {
            bounds[r + 1] = bounds[r] + 1 + 3 * triangles.0.row(r).len() + 4 * hinges.0.row(r).len();
        }
        let mut table = vec![0u32; bounds[rows]];
        let mut lengths = vec![0u32; rows];
        {
            let parts = RowParts::split(&mut table, &bounds);
            cpu.for_ranges_mut(&mut lengths, 1, 256, |range, lengths| {
                for (r, length) in range.zip(lengths) {
                    // SAFETY: every row is visited once, rows have disjoint parts.
                    let columns = unsafe { parts.row(r) };
                    columns[0] = (own.start + r) as u32;
                    let mut n = 1;
                    for &entry in triangles.0.row(r) {
                        columns[n..n + 3].copy_from_slice(&triangles.1[(entry >> 2) as usize]);
                        n += 3;
                    }
                    for &entry in hinges.0.row(r) {
                        columns[n..n + 4].copy_from_slice(&hinges.1[(entry >> 2) as usize]);
                        n += 4;
                    }
                    columns.sort_unstable();
                    *length = compact(columns) as u32;
                }
            });
        }
        if let Some(local) = lengths.iter().position(|&n| n > u16::MAX as u32) {
            return Err(RowTooLong { local, columns: lengths[local] as usize });
        }
        let mut offsets = vec![0u32; rows + 1];
        let mut columns = Vec::with_capacity(lengths.iter().map(|&n| n as usize).sum());
        for r in 0..rows {
            columns.extend_from_slice(&table[bounds[r]..bounds[r] + lengths[r] as usize]);
            offsets[r + 1] = columns.len() as u32;
        }
        drop(table);
        let triangle_positions = positions(&offsets, &columns, triangles.0, triangles.1);
        let hinge_positions = positions(&offsets, &columns, hinges.0, hinges.1);
        Ok(Pattern { offsets, columns, triangle_positions, hinge_positions })
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Columns of row `row`.
    pub fn row(&self, row: usize) -> &[u32] {
        &self.columns[self.offsets[row] as usize..self.offsets[row + 1] as usize]
    }
}

/// Removes duplicates of a sorted slice in place; returns how many are left.
fn compact(columns: &mut [u32]) -> usize {
    let mut kept = 1;
    for i in 1..columns.len() {
        if columns[i] != columns[kept - 1] {
            columns[kept] = columns[i];
            kept += 1;
        }
    }
    kept
}

fn positions<const CORNERS: usize>(
    offsets: &[u32],
    columns: &[u32],
    rows: &ElementRows,
    elements: &[[u32; CORNERS]],
) -> Vec<[u16; 4]> {
    let mut out = vec![[0u16; 4]; rows.entries.len()];
    for r in 0..offsets.len() - 1 {
        let row = &columns[offsets[r] as usize..offsets[r + 1] as usize];
        let entries = rows.offsets[r] as usize..rows.offsets[r + 1] as usize;
        for (entry, out) in rows.entries[entries.clone()].iter().zip(&mut out[entries]) {
            for (corner, v) in elements[(entry >> 2) as usize].iter().enumerate() {
                out[corner] = row.binary_search(v).expect("columns were collected from these elements") as u16;
            }
        }
    }
    out
}

/// Disjoint mutable rows of a table, for writers that visit every row once.
struct RowParts<'a> {
    base: *mut u32,
    bounds: &'a [usize],
}
// SAFETY: rows are disjoint; `row` is unsafe and its callers visit every row once.
unsafe impl Sync for RowParts<'_> {}

impl<'a> RowParts<'a> {
    fn split(table: &'a mut [u32], bounds: &'a [usize]) -> RowParts<'a> {
        RowParts { base: table.as_mut_ptr(), bounds }
    }

    /// # Safety
    /// No two live slices of the same row.
    #[allow(clippy::mut_from_ref, reason = "disjoint rows of one table, see the safety contract")]
    unsafe fn row(&self, r: usize) -> &mut [u32] {
        // SAFETY: bounds are ascending and end at the table's length.
        unsafe { std::slice::from_raw_parts_mut(self.base.add(self.bounds[r]), self.bounds[r + 1] - self.bounds[r]) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn duplicate_columns_are_merged_and_corners_know_their_position() {
        let triangles = [[0, 1, 2], [2, 1, 3]];
        let hinges = [[1, 2, 0, 3]];
        let own = 1..3;
        let (t, h) = (ElementRows::new(own.clone(), &triangles), ElementRows::new(own.clone(), &hinges));
        let p = Pattern::new(&CpuExecutor::new(1), own, (&t, &triangles), (&h, &hinges)).unwrap();
        assert_eq!(p.offsets, [0, 4, 8]);
        assert_eq!(p.columns, [0, 1, 2, 3, 0, 1, 2, 3]);
        assert_eq!(p.triangle_positions[0], [0, 1, 2, 0]);
        assert_eq!(p.triangle_positions[1], [2, 1, 3, 0]);
        assert_eq!(p.hinge_positions, [[1, 2, 0, 3], [1, 2, 0, 3]]);
    }
}
