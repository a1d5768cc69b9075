//! CPU twin of `index_fill.wgsl`. One pass per row does what three kernels do there: it collects the distinct columns in a
//! small hash table, sorts them, and looks the corners' positions up in the same table.

use super::index_fill::{IndexRows, NO_COLUMN, NO_POSITION, REMOTE};
use super::layout::{LANES, NO_ROW};
use crate::gpu::CpuExecutor;

/// Contributions of one kind of element.
pub(super) struct KindInputs<'a> {
    pub offsets: &'a [u32],
    pub entries: &'a [u32],
    /// Elements as words: `stride` each, the vertices first.
    pub words: &'a [u32],
    pub stride: usize,
    pub corners: usize,
    pub positions: &'a mut [[u16; 4]],
}

/// An array that several threads write at disjoint places.
struct Shared<T>(*mut T, usize);
// SAFETY: every row or lane writes its own items only, and belongs to one thread.
unsafe impl<T: Send> Sync for Shared<T> {}

impl<T> Shared<T> {
    fn new(values: &mut [T]) -> Shared<T> {
        Shared(values.as_mut_ptr(), values.len())
    }

    /// # Safety
    /// No other thread has items of this range.
    #[allow(clippy::mut_from_ref, reason = "disjoint ranges, see the safety contract")]
    unsafe fn part(&self, start: usize, len: usize) -> &mut [T] {
        assert!(start + len <= self.1);
        // SAFETY: within the array, see above.
        unsafe { std::slice::from_raw_parts_mut(self.0.add(start), len) }
    }
}

/// The distinct columns of one row: an open-addressed hash table over the list of their keys.
#[derive(Default)]
struct RowSet {
    /// Number of the column in `keys` plus one, 0 for a free slot; a power of two of slots.
    slots: Vec<u32>,
    /// Global row and local vertex of every column.
    keys: Vec<u64>,
    shift: u32,
}

impl RowSet {
    /// Empties the set, with room for `bound` columns.
    fn clear(&mut self, bound: usize) {
        let slots = (bound * 2).next_power_of_two().max(8);
        self.keys.clear();
        self.slots.clear();
        self.slots.resize(slots, 0);
        self.shift = 32 - slots.trailing_zeros();
    }

    /// The slot of `column`: where it is, or where it would be.
    #[inline(always)]
    fn find(&self, column: u32) -> usize {
        let mut at = (column.wrapping_mul(0x9e37_79b1) >> self.shift) as usize;
        loop {
            match self.slots[at] {
                0 => return at,
                n if self.keys[n as usize - 1] as u32 == column => return at,
                _ => at = (at + 1) & (self.slots.len() - 1),
            }
        }
    }

    #[inline(always)]
    fn insert(&mut self, column: u32, global_from_local: &[u32]) {
        let at = self.find(column);
        if self.slots[at] == 0 {
            self.keys.push(u64::from(global_from_local[column as usize]) << 32 | u64::from(column));
            self.slots[at] = self.keys.len() as u32;
        }
    }

    /// Sorts by global row; then a column's slot holds its position plus one.
    fn sort(&mut self) {
        self.keys.sort_unstable();
        self.slots.fill(0);
        for n in 0..self.keys.len() {
            let at = self.find(self.keys[n] as u32);
            self.slots[at] = n as u32 + 1;
        }
    }
}

/// Columns, lengths and positions of all rows. Per contribution about 40 bytes read and 24 written.
pub(super) fn index_rows(
    cpu: &CpuExecutor,
    rows: &IndexRows,
    kinds: &mut [KindInputs<'_>],
    global_from_local: &[u32],
    part_ends: &[u32],
    table: &mut [u32],
    lengths: &mut [u32],
) {
    let table = Shared::new(table);
    let positions: Vec<Shared<[u16; 4]>> = kinds.iter_mut().map(|kind| Shared::new(kind.positions)).collect();
    let kinds = &*kinds;
    let parts = part_ends.len();
    cpu.for_ranges_mut(lengths, parts, 64, |range, lengths| {
        let mut set = RowSet::default();
        for (r, lengths) in range.zip(lengths.chunks_exact_mut(parts)) {
            let start = rows.start(r, kinds.iter().map(|kind| (kind.corners, kind.offsets)));
            let end = rows.start(r + 1, kinds.iter().map(|kind| (kind.corners, kind.offsets)));
            set.clear(end - start);
            if rows.own_column {
                set.insert((rows.own.start + r) as u32, global_from_local);
            }
            for kind in kinds {
                for &entry in &kind.entries[kind.offsets[r] as usize..kind.offsets[r + 1] as usize] {
                    for column in columns(rows, kind, entry).filter(|&v| v != NO_COLUMN) {
                        set.insert(column, global_from_local);
                    }
                }
            }
            set.sort();
            // SAFETY: rows have disjoint parts of the table, and every row is visited once.
            let own = unsafe { table.part(start, end - start) };
            own.iter_mut().zip(&set.keys).for_each(|(to, &key)| *to = key as u32);
            measure(rows, &set.keys, part_ends, lengths);
            for (kind, positions) in kinds.iter().zip(&positions) {
                let list = kind.offsets[r] as usize..kind.offsets[r + 1] as usize;
                // SAFETY: contributions of this row.
                let positions = unsafe { positions.part(list.start, list.len()) };
                for (&entry, out) in kind.entries[list].iter().zip(positions) {
                    *out = [NO_POSITION; 4];
                    for (out, column) in out.iter_mut().zip(columns(rows, kind, entry)) {
                        if column != NO_COLUMN {
                            *out = (set.slots[set.find(column)] - 1) as u16;
                        }
                    }
                }
            }
        }
    });
}

/// Columns of an element's corners, seen from its corner in `entry`.
#[inline(always)]
fn columns<'a>(rows: &'a IndexRows, kind: &'a KindInputs<'_>, entry: u32) -> impl Iterator<Item = u32> + 'a {
    let at = (entry >> 2) as usize * kind.stride;
    let own = (entry & 3) as usize;
    kind.words[at..at + kind.corners].iter().enumerate().map(move |(corner, &v)| {
        let none = v as usize >= rows.columns || (!rows.own_column && corner == own);
        if none { NO_COLUMN } else { v }
    })
}

fn measure(rows: &IndexRows, keys: &[u64], part_ends: &[u32], lengths: &mut [u32]) {
    if let [length] = lengths {
        let remote = keys.iter().any(|&key| !rows.own.contains(&(key as u32 as usize)));
        *length = keys.len() as u32 | if remote { REMOTE } else { 0 };
        return;
    }
    lengths.fill(0);
    let mut part = 0;
    for key in keys {
        while (key >> 32) as u32 >= part_ends[part] {
            part += 1;
        }
        lengths[part] += 1;
    }
}

/// Columns of every lane of the layout, and the address of every block where rows keep them.
pub(super) fn index_place(
    cpu: &CpuExecutor,
    row_start: impl Fn(usize) -> usize + Sync,
    global_from_local: &[u32],
    part_ends: &[u32],
    table: &[u32],
    lanes: &[[u32; 4]],
    slice_offsets: &[u32],
    sell_columns: &mut [u32],
    row_offsets: &[u32],
    block_address: &mut [u32],
) {
    let (sell_columns, addresses) = (Shared::new(sell_columns), Shared::new(block_address));
    cpu.for_ranges(slice_offsets.len() - 1, 8, |slices| {
        for slice in slices {
            let slots = slice_offsets[slice] as usize..slice_offsets[slice + 1] as usize;
            // SAFETY: the slots of a slice are its own.
            let out = unsafe { sell_columns.part(slots.start * LANES, slots.len() * LANES) };
            for lane in 0..LANES {
                let [row, part, first, length] = lanes[slice * LANES + lane];
                if row == NO_ROW {
                    (0..slots.len()).for_each(|k| out[k * LANES + lane] = 0);
                    continue;
                }
                let base = row_start(row as usize) + first as usize;
                let below = part.checked_sub(1).map_or(0, |part| part_ends[part as usize]);
                let mut column = 0;
                for k in 0..slots.len() {
                    if k < length as usize {
                        column = table[base + k];
                        if part_ends.len() > 1 {
                            column = global_from_local[column as usize] - below;
                        }
                        if !row_offsets.is_empty() {
                            let at = (row_offsets[row as usize] + first) as usize + k;
                            // SAFETY: blocks of this row.
                            unsafe { addresses.part(at, 1)[0] = ((slots.start + k) * LANES + lane) as u32 };
                        }
                    }
                    // Padding repeats the last column.
                    out[k * LANES + lane] = column;
                }
            }
        }
    });
}
