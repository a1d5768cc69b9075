//! The sweeps of the Schwarz preconditioner on the native executor, which go along the rows of every chunk. The file
//! holds the blocks of the matrix in the layout that the sweeps multiply. Devices sweep by color instead (`colored`).

use std::ops::Range;

use super::coarse::{Coarse, GroupSums, add_block};
use super::exchange::ExchangeMode;
use super::rank_pattern::RankPattern;
use super::sweep_cpu::{self, Blocks};
use super::vector::{ChunkSums, PcgVectors};
use super::vector_cpu::Shared;
use crate::assembly::sell::{BLOCK, value_index};
use crate::assembly::{SellLayout, SellMatrix};
use crate::gpu::{CpuExecutor, DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::partition::{HaloPlan, RowPartition};

/// Tables of a rank's chunks, and its blocks inside chunks and between them.
pub(super) struct Sweeps {
    chunk_rows: usize,
    rows: usize,
    /// First local row that is owned.
    own_start: usize,
    upper_offsets: Vec<u32>,
    upper_columns: Vec<u16>,
    upper_source: Vec<u32>,
    upper: Vec<f32>,
    diagonal_source: Vec<u32>,
    diagonal: Vec<f32>,
    /// Blocks that couple chunks, in the form of the matrix ([`SellMatrix::difference`]).
    outer: SellMatrix,
    outer_blocks: Vec<OuterBlock>,
    /// Start of each own chunk's blocks to other chunks; one more than chunks.
    outer_offsets: Vec<usize>,
    /// Group of each own chunk.
    groups: Vec<u32>,
    /// Own rows that are pinned, ascending.
    pinned: Vec<u32>,
    residual_sums: Vec<[f64; 2]>,
    product_sums: Vec<[f64; 4]>,
}

/// A block between chunks: its address in the matrix, its address here, its row, its column and the group of the
/// column.
#[derive(Clone, Copy)]
struct OuterBlock {
    source: u32,
    target: u32,
    row: u32,
    column: u32,
    group: u32,
}

impl Sweeps {
    /// Builds the tables for a pattern. `mode` and `queue` are those of the products.
    pub(super) fn new(
        executor: &Executor,
        partition: &RowPartition,
        plan: &HaloPlan,
        mode: ExchangeMode,
        queue: &[QueueNode],
        pattern: RankPattern,
        coarse: &Coarse,
    ) -> Sweeps {
        let (rows, chunk_rows, own_start) = (plan.own.len(), partition.chunk_rows(), plan.own.start);
        let first_chunk = partition.chunks_of(plan.rank).start;
        let (mut upper_offsets, mut upper_columns, mut upper_source) = (vec![0u32], Vec::new(), Vec::new());
        let mut diagonal_source = Vec::with_capacity(rows);
        let (mut outer_rows, mut outer_columns, mut outer_blocks) = (vec![0u32], Vec::new(), Vec::new());
        let mut outer_offsets = vec![0];
        for row in 0..rows {
            let chunk = row / chunk_rows;
            let first = own_start + chunk * chunk_rows;
            let inside = first..(first + chunk_rows).min(plan.own.end);
            for k in pattern.offsets[row] as usize..pattern.offsets[row + 1] as usize {
                let (column, source) = (pattern.columns[k] as usize, pattern.block_address[k]);
                if column == own_start + row {
                    diagonal_source.push(source);
                } else if !inside.contains(&column) {
                    let group = coarse.group(plan.global_from_local[column] as usize / chunk_rows) as u32;
                    let (row, column) = (row as u32, column as u32);
                    outer_columns.push(column);
                    outer_blocks.push(OuterBlock { source, target: 0, row, column, group });
                } else if column > own_start + row {
                    upper_columns.push((column - first) as u16);
                    upper_source.push(source);
                }
            }
            assert_eq!(diagonal_source.len(), row + 1, "row {row} has a diagonal block");
            upper_offsets.push(upper_columns.len() as u32);
            outer_rows.push(outer_columns.len() as u32);
            if (row + 1) % chunk_rows == 0 || row + 1 == rows {
                outer_offsets.push(outer_blocks.len());
            }
        }
        debug_assert_eq!(first_chunk * chunk_rows, plan.global_from_local[own_start] as usize);
        let layout = outer_layout(partition, plan, mode, queue, &outer_rows, &outer_columns);
        for (block, &target) in outer_blocks.iter_mut().zip(&layout.block_address) {
            block.target = target;
        }
        let chunks = rows.div_ceil(chunk_rows);
        Sweeps {
            chunk_rows,
            rows,
            own_start,
            upper: vec![0.0; upper_columns.len() * BLOCK + 3],
            upper_offsets,
            upper_columns,
            upper_source,
            diagonal_source,
            diagonal: vec![0.0; rows * 6],
            outer: SellMatrix::new(executor, rows, &layout),
            outer_blocks,
            outer_offsets,
            groups: (first_chunk..first_chunk + chunks).map(|chunk| coarse.group(chunk) as u32).collect(),
            residual_sums: vec![[0.0; 2]; chunks],
            pinned: Vec::new(),
            product_sums: vec![[0.0; 4]; chunks],
        }
    }

    /// Copies the values of the matrix and sums them by chunk and group.
    pub(super) fn set_values(&mut self, cpu: &CpuExecutor, matrix: &SellMatrix, flags: &[f32]) -> Vec<GroupSums> {
        let values = matrix.values.as_slice();
        self.outer.difference = matrix.difference;
        self.pinned.clear();
        self.pinned.extend((0..self.rows as u32).filter(|&row| flags[(self.own_start + row as usize) * 3] == 0.0));
        let mut entries: Vec<GroupSums> = vec![Vec::new(); self.residual_sums.len()];
        let (upper, diagonal) = (Shared(self.upper.as_mut_ptr()), Shared(self.diagonal.as_mut_ptr()));
        let outer = Shared(self.outer.values.as_mut_slice().as_mut_ptr());
        let tables = &*self;
        cpu.for_ranges_mut(&mut entries, 1, 1, |range, entries| {
            for (chunk, entries) in range.zip(entries) {
                let rows = chunk * tables.chunk_rows..((chunk + 1) * tables.chunk_rows).min(tables.rows);
                let blocks = tables.upper_offsets[rows.start] as usize..tables.upper_offsets[rows.end] as usize;
                // SAFETY: rows and blocks of chunks are disjoint.
                let (upper, diagonal) = unsafe {
                    (
                        upper.part(blocks.start * BLOCK, blocks.len() * BLOCK),
                        diagonal.part(rows.start * 6, rows.len() * 6),
                    )
                };
                let within = tables.take_inner(rows, values, flags, upper, diagonal);
                *entries = vec![(tables.groups[chunk], within)];
                tables.take_outer(chunk, values, flags, outer, entries);
            }
        });
        entries
    }

    /// Copies the blocks inside a chunk; returns their sum over rows that are not pinned. In difference form the blocks
    /// between free rows cancel each other, and a block of a free row in a pinned column counts with a minus.
    fn take_inner(
        &self,
        rows: Range<usize>,
        values: &[f32],
        flags: &[f32],
        upper: &mut [f32],
        diagonal: &mut [f32],
    ) -> [f64; BLOCK] {
        let mut sum = [0.0f64; BLOCK];
        let free = |row: usize| flags[(self.own_start + row) * 3] != 0.0;
        let mut upper = upper.as_chunks_mut::<BLOCK>().0.iter_mut();
        for (row, diagonal) in rows.clone().zip(diagonal.as_chunks_mut::<6>().0) {
            let of = |source: u32| -> [f32; BLOCK] { std::array::from_fn(|c| values[value_index(source, c)]) };
            let block = of(self.diagonal_source[row]);
            *diagonal = [0, 1, 2, 4, 5, 8].map(|c| block[c]);
            let mut of_row = [0.0f32; BLOCK];
            for k in self.upper_offsets[row] as usize..self.upper_offsets[row + 1] as usize {
                let Some(to) = upper.next() else { return sum };
                *to = of(self.upper_source[k]);
                match (free(row), free(rows.start + self.upper_columns[k] as usize)) {
                    (true, true) if !self.outer.difference => {
                        of_row.iter_mut().zip(&*to).for_each(|(sum, v)| *sum += v);
                    }
                    (true, false) if self.outer.difference => (0..BLOCK).for_each(|c| sum[c] -= f64::from(to[c])),
                    (false, true) if self.outer.difference => {
                        (0..BLOCK).for_each(|c| sum[c] -= f64::from(to[c % 3 * 3 + c / 3]));
                    }
                    _ => {}
                }
            }
            if free(row) {
                for c in 0..BLOCK {
                    sum[c] += block[c] as f64 + of_row[c] as f64 + of_row[c % 3 * 3 + c / 3] as f64;
                }
            }
        }
        sum
    }

    /// Copies the blocks between chunk `chunk` and others. `entries`: that of the chunk itself is the first.
    fn take_outer(&self, chunk: usize, values: &[f32], flags: &[f32], outer: Shared, entries: &mut GroupSums) {
        for block in &self.outer_blocks[self.outer_offsets[chunk]..self.outer_offsets[chunk + 1]] {
            let of: [f32; BLOCK] = std::array::from_fn(|c| values[value_index(block.source, c)]);
            for (c, &v) in of.iter().enumerate() {
                // SAFETY: every block has its own address.
                unsafe { outer.part(value_index(block.target, c), 1)[0] = v };
            }
            if flags[(self.own_start + block.row as usize) * 3] == 0.0 {
                continue;
            }
            if self.outer.difference {
                entries[0].1.iter_mut().zip(of).for_each(|(sum, v)| *sum -= f64::from(v));
            }
            if flags[block.column as usize * 3] != 0.0 {
                add_block(entries, block.group, of);
            }
        }
    }

    /// The blocks between chunks, whose product remains to be added after [`Sweeps::sweep`].
    pub(super) fn outer(&self) -> &SellMatrix {
        &self.outer
    }

    /// Runs [`sweep_cpu::sweep`] on the vectors of a solve.
    pub(super) fn sweep(
        &mut self,
        cpu: &CpuExecutor,
        correction: &[f32],
        update: Option<(f32, f32)>,
        inverse_diagonal: &DeviceVec<f32>,
        vectors: &mut PcgVectors,
    ) {
        let PcgVectors { own_start, u, x, r, w, p, s } = vectors;
        let own = *own_start..*own_start + w.len();
        let blocks = Blocks {
            chunk_rows: self.chunk_rows,
            difference: self.outer.difference,
            upper_offsets: &self.upper_offsets,
            upper_columns: &self.upper_columns,
            upper: &self.upper,
            diagonal: &self.diagonal,
            inverse_diagonal: inverse_diagonal.as_slice(),
        };
        sweep_cpu::sweep(
            cpu,
            &blocks,
            update,
            correction,
            w.as_mut_slice(),
            &mut u.as_mut_slice()[own],
            p.as_mut_slice(),
            s.as_mut_slice(),
            x.as_mut_slice(),
            r.as_mut_slice(),
            &mut self.residual_sums,
        );
    }

    /// Computes the sums (r . u, r . r, w . u) per own chunk and the sums of w, three per chunk; zeroes w on pinned
    /// rows.
    pub(super) fn sums(
        &mut self,
        cpu: &CpuExecutor,
        w: &mut DeviceVec<f32>,
        u: &DeviceVec<f32>,
        u_start: usize,
        scalars: &mut Vec<ChunkSums>,
        restricted: &mut Vec<f64>,
    ) {
        let own = u_start..u_start + w.len();
        let (w, u) = (w.as_mut_slice(), &u.as_slice()[own]);
        sweep_cpu::product_sums(cpu, self.chunk_rows, &self.pinned, w, u, &mut self.product_sums);
        scalars.clear();
        scalars.extend(self.residual_sums.iter().zip(&self.product_sums).map(|(r, w)| [r[0], r[1], w[0]]));
        restricted.clear();
        restricted.extend(self.product_sums.iter().flat_map(|sums| &sums[1..]));
    }

    /// Bytes of the tables and of the copy of the matrix.
    pub(super) fn bytes(&self) -> u64 {
        let words = self.upper_offsets.len()
            + self.upper_source.len()
            + self.upper.len()
            + self.diagonal_source.len()
            + self.diagonal.len();
        (words * 4 + self.upper_columns.len() * 2 + self.outer_blocks.len() * size_of::<OuterBlock>()) as u64
            + self.outer.bytes()
    }

    pub(super) fn sweep_flops(&self) -> u64 {
        (self.upper_columns.len() * 54 + self.rows * 100) as u64
    }

    pub(super) fn sweep_bytes(&self) -> u64 {
        (self.upper.len() * 4 + self.upper_columns.len() * 2 + self.rows * (4 + 48 + 192)) as u64
    }
}

/// Layout of the blocks between chunks. The `halo` layout also leaves out rows without such blocks.
pub(super) fn outer_layout(
    partition: &RowPartition,
    plan: &HaloPlan,
    mode: ExchangeMode,
    queue: &[QueueNode],
    offsets: &[u32],
    columns: &[u32],
) -> SellLayout {
    match mode {
        ExchangeMode::Halo => {
            let held: Vec<usize> = (0..offsets.len() - 1).filter(|&r| offsets[r] < offsets[r + 1]).collect();
            let mut dense: Vec<u32> = held.iter().map(|&row| offsets[row]).collect();
            dense.push(columns.len() as u32);
            let mut layout = SellLayout::halo(&dense, columns, plan.own.clone());
            for row in layout.row_of_lane.iter_mut().filter(|row| **row != crate::assembly::NO_ROW) {
                *row = held[*row as usize] as u32;
            }
            layout
        }
        ExchangeMode::Full => {
            let rows_of: Vec<_> = (0..partition.ranks()).map(|rank| partition.rows_of(rank)).collect();
            let order: Vec<usize> = queue.iter().map(|node| node.vector).collect();
            SellLayout::full(offsets, columns, &plan.global_from_local, &rows_of, plan.rank, &order)
        }
    }
}
