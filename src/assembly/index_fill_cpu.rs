//! CPU twin of `index_fill.wgsl`. One pass per row replaces three of the kernels: it collects the distinct columns in a
//! small hash table, sorts them, and looks the corners' positions up in the same table.

use super::index_fill::{IndexRows, NO_COLUMN, NO_POSITION, REMOTE};
use super::layout::{LANES, NO_ROW};
use crate::gpu::CpuExecutor;

/// Contributions of one kind of element.
pub(super) struct KindInputs<'a> {
    pub offsets: &'a [u32],
    pub entries: &'a [u32],
    /// Elements as words: `stride` words each, the vertices first.
    pub words: &'a [u32],
    pub stride: usize,
    pub corners: usize,
    pub positions: &'a mut [[u16; 4]],
}

/// An array that several threads write at disjoint positions.
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

/// The distinct columns of one row: an open-addressed hash table over a list, numbered in order of insertion.
#[derive(Default)]
struct RowSet {
    /// Number of the column plus one, 0 for a free slot. The number of slots is a power of two.
    slots: Vec<u32>,
    /// Columns (local vertices) by number.
    columns: Vec<u32>,
    shift: u32,
    /// Global row and number of every column, ascending after `sort`.
    order: Vec<u64>,
    /// Position of every column, by number, after `sort`.
    positions: Vec<u16>,
}

impl RowSet {
    /// Empties the set and makes room for `bound` columns.
    fn clear(&mut self, bound: usize) {
        let slots = (bound + bound / 4 + 1).next_power_of_two().max(8);
        self.columns.clear();
        self.slots.clear();
        self.slots.resize(slots, 0);
        self.shift = 32 - slots.trailing_zeros();
    }

    /// Number of `column`, which is inserted if it is new.
    #[inline(always)]
    fn insert(&mut self, column: u32) -> u32 {
        let mut at = (column.wrapping_mul(0x9e37_79b1) >> self.shift) as usize;
        loop {
            match self.slots[at] {
                0 => {
                    self.columns.push(column);
                    self.slots[at] = self.columns.len() as u32;
                    return self.slots[at] - 1;
                }
                n if self.columns[n as usize - 1] == column => return n - 1,
                _ => at = (at + 1) & (self.slots.len() - 1),
            }
        }
    }

    /// Orders the columns by global row.
    fn sort(&mut self, global_from_local: &[u32]) {
        let key = |(n, &column): (usize, &u32)| u64::from(global_from_local[column as usize]) << 32 | n as u64;
        self.order.clear();
        self.order.extend(self.columns.iter().enumerate().map(key));
        self.order.sort_unstable();
        self.positions.resize(self.columns.len(), 0);
        for (position, &key) in self.order.iter().enumerate() {
            self.positions[key as u32 as usize] = position as u16;
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
                set.insert((rows.own.start + r) as u32);
            }
            // Positions hold the numbers of the columns until the columns are sorted.
            for (kind, positions) in kinds.iter().zip(&positions) {
                let list = kind.offsets[r] as usize..kind.offsets[r + 1] as usize;
                // SAFETY: contributions of this row, which is visited once.
                let positions = unsafe { positions.part(list.start, list.len()) };
                for (&entry, out) in kind.entries[list].iter().zip(positions) {
                    *out = [NO_POSITION; 4];
                    for (out, column) in out.iter_mut().zip(columns(rows, kind, entry)) {
                        if column != NO_COLUMN {
                            *out = set.insert(column) as u16;
                        }
                    }
                }
            }
            set.sort(global_from_local);
            // SAFETY: rows have disjoint parts of the table.
            let own = unsafe { table.part(start, end - start) };
            own.iter_mut().zip(&set.order).for_each(|(to, &key)| *to = set.columns[key as u32 as usize]);
            measure(rows, &set, part_ends, lengths);
            for (kind, positions) in kinds.iter().zip(&positions) {
                let list = kind.offsets[r] as usize..kind.offsets[r + 1] as usize;
                // SAFETY: as above; the other slice is gone.
                let positions = unsafe { positions.part(list.start, list.len()) };
                for position in positions.as_flattened_mut() {
                    if *position != NO_POSITION {
                        *position = set.positions[usize::from(*position)];
                    }
                }
            }
        }
    });
}

/// Columns of an element's corners, seen from the corner that `entry` names.
#[inline(always)]
fn columns<'a>(rows: &'a IndexRows, kind: &'a KindInputs<'_>, entry: u32) -> impl Iterator<Item = u32> + 'a {
    let at = (entry >> 2) as usize * kind.stride;
    let own = (entry & 3) as usize;
    kind.words[at..at + kind.corners].iter().enumerate().map(move |(corner, &v)| {
        let none = v as usize >= rows.columns || (!rows.own_column && corner == own);
        if none { NO_COLUMN } else { v }
    })
}

fn measure(rows: &IndexRows, set: &RowSet, part_ends: &[u32], lengths: &mut [u32]) {
    if let [length] = lengths {
        let remote = set.columns.iter().any(|&column| !rows.own.contains(&(column as usize)));
        *length = set.columns.len() as u32 | if remote { REMOTE } else { 0 };
        return;
    }
    lengths.fill(0);
    let mut part = 0;
    for key in &set.order {
        while (key >> 32) as u32 >= part_ends[part] {
            part += 1;
        }
        lengths[part] += 1;
    }
}

/// Columns of every lane of the layout, and the addresses of the blocks of rows that store them.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
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
