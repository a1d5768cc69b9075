//! The sweeps of the Schwarz preconditioner in the order of colors, for devices. Rows of a chunk that are not coupled
//! share a color and are updated at once. One workgroup sweeps one chunk. The file also sums the blocks of the coarse
//! level.
//!
//! The native twin only checks the kernels. The native executor itself sweeps along the rows (`sweep`), which converges
//! faster and takes less time.

use std::ops::Range;

use super::coarse::{Coarse, GroupSums};
use super::colored_cpu;
use super::rank_pattern::RankPattern;
use super::vector::{CHUNK_THREADS, ChunkSums, LIBRARIES};
use crate::assembly::SellMatrix;
use crate::assembly::sell::BLOCK;
use crate::gpu::{DeviceVec, Executor, GpuExecutor, KernelSource, WINDOW_STEP, gpu_struct};
use crate::partition::{HaloPlan, RowPartition};

const TEXT: &str = include_str!("colored.wgsl");
static TAKE: KernelSource =
    KernelSource::new::<ColoredParams>("solver/colored.wgsl", TEXT, "take").with_libraries(LIBRARIES);
static ENTRY_SUMS: KernelSource =
    KernelSource::new::<ColoredParams>("solver/colored.wgsl", TEXT, "entry_sums").with_libraries(LIBRARIES);
static SWEEP: KernelSource =
    KernelSource::new::<ColoredParams>("solver/colored.wgsl", TEXT, "sweep").with_libraries(LIBRARIES);
static PRODUCT_SUMS: KernelSource =
    KernelSource::new::<ColoredParams>("solver/colored.wgsl", TEXT, "product_sums").with_libraries(LIBRARIES);
/// Sums of a chunk: r . u, r . r, w . u, w.
const SUMS: usize = 6;
/// Values of the sums of blocks of a chunk with one group: of free columns, of pinned columns.
pub(super) const ENTRY: usize = 2 * BLOCK;
/// Source of the padding blocks that fill a chunk's list up to a multiple of [`WINDOW_STEP`].
pub(super) const PADDING: u32 = u32::MAX;
/// Over-relaxation. Larger factors do not pay in the order of colors (docs/performance.md).
pub(super) const RELAXATION: f32 = 1.2;

gpu_struct! {
    struct ColoredParams {
        rows: u32,
        chunk_rows: u32,
        u_first: u32,
        colors: u32,
        relaxation: f32,
        first_chunk: u32,
        chunks: u32,
        first_entry: u32,
        entries: u32,
        first_block: u32,
        blocks: u32,
        first_slot: u32,
        slots: u32,
        difference: u32,
    }
}

/// Pattern of the blocks, as a sweep reads it.
pub(super) struct BlockTables<'a> {
    pub rows: usize,
    pub chunk_rows: usize,
    /// First local row that is owned.
    pub own_start: usize,
    pub relaxation: f32,
    /// Rows of each chunk by color, ascending within a color.
    pub order: &'a [u32],
    /// Per row of `order`: its diagonal block (the blocks of lower colors follow), its first block of a higher color,
    /// the end.
    pub spans: &'a [[u32; 3]],
    /// Local column of every block.
    pub block_columns: &'a [u32],
}

/// Chunks whose blocks a device can bind at once.
struct Batch {
    chunks: Range<usize>,
    blocks: Range<usize>,
    entries: Range<usize>,
}

/// Position of the blocks; see [`BlockTables`].
struct Layout {
    rows: usize,
    chunk_rows: usize,
    own_start: usize,
    order: DeviceVec<u32>,
    spans: DeviceVec<[u32; 3]>,
    block_columns: DeviceVec<u32>,
}

impl Layout {
    fn tables(&self) -> BlockTables<'_> {
        BlockTables {
            rows: self.rows,
            chunk_rows: self.chunk_rows,
            own_start: self.own_start,
            relaxation: RELAXATION,
            order: self.order.as_slice(),
            spans: self.spans.as_slice(),
            block_columns: self.block_columns.as_slice(),
        }
    }
}

/// Tables of a rank's chunks, and the blocks of its matrix chunk by chunk: first the blocks inside the chunk, with its
/// rows by color, then the blocks that couple the chunk with others, by group.
pub(super) struct Colored {
    layout: Layout,
    colors: usize,
    batches: Vec<Batch>,
    sources: DeviceVec<u32>,
    block_rows: DeviceVec<u32>,
    blocks: DeviceVec<f32>,
    /// See [`SellMatrix::difference`].
    difference: bool,
    color_starts: DeviceVec<u32>,
    /// Range of the blocks of each sum, and the group of their columns.
    entry_ends: DeviceVec<[u32; 2]>,
    entry_groups: Vec<u32>,
    /// Start of each own chunk's sums; one more than chunks.
    entry_starts: Vec<usize>,
    entries: DeviceVec<f32>,
    correction: DeviceVec<f32>,
    sums: DeviceVec<f32>,
}

/// The tables during construction.
#[derive(Default)]
struct Lists {
    sources: Vec<u32>,
    rows: Vec<u32>,
    columns: Vec<u32>,
    order: Vec<u32>,
    spans: Vec<[u32; 3]>,
    entry_ends: Vec<[u32; 2]>,
    entry_groups: Vec<u32>,
}

impl Lists {
    fn push(&mut self, pattern: &RankPattern, row: usize, k: usize) {
        self.sources.push(pattern.block_address[k]);
        self.rows.push(row as u32);
        self.columns.push(pattern.columns[k]);
    }

    fn len(&self) -> u32 {
        self.sources.len() as u32
    }
}

/// Smallest color of each row of `rows` that no earlier row coupled with it has. `inside`: the local columns of a row's
/// blocks inside the chunk.
fn color_rows(pattern: &RankPattern, rows: Range<usize>, inside: &Range<usize>) -> Vec<u32> {
    let mut colors: Vec<u32> = Vec::with_capacity(rows.len());
    // For each color, the row that last found it taken, counted from 1.
    let mut met: Vec<usize> = Vec::new();
    for row in rows {
        let columns = &pattern.columns[pattern.offsets[row] as usize..pattern.offsets[row + 1] as usize];
        for &column in columns.iter().filter(|&&column| inside.contains(&(column as usize))) {
            if let Some(&color) = colors.get(column as usize - inside.start) {
                met[color as usize] = row + 1;
            }
        }
        let color = met.iter().position(|&last| last != row + 1).unwrap_or(met.len());
        if color == met.len() {
            met.push(0);
        }
        colors.push(color as u32);
    }
    colors
}

impl Colored {
    /// Tables for a pattern whose blocks inside chunks are symmetric.
    pub(super) fn new(
        executor: &Executor,
        partition: &RowPartition,
        plan: &HaloPlan,
        pattern: RankPattern,
        coarse: &Coarse,
    ) -> Colored {
        let (rows, chunk_rows, own_start) = (plan.own.len(), partition.chunk_rows(), plan.own.start);
        let chunks = rows.div_ceil(chunk_rows);
        let mut lists = Lists::default();
        let (mut chunk_colors, mut ends) = (Vec::new(), vec![(0, 0)]);
        for chunk in 0..chunks {
            let own = chunk * chunk_rows..((chunk + 1) * chunk_rows).min(rows);
            let inside = own_start + own.start..own_start + own.end;
            let colors = color_rows(&pattern, own.clone(), &inside);
            let group_of = |column: u32| coarse.group(plan.global_from_local[column as usize] as usize / chunk_rows);
            add_chunk(&mut lists, &pattern, own, &inside, &colors, group_of);
            chunk_colors.push(colors);
            ends.push((lists.sources.len(), lists.entry_ends.len()));
        }
        let colors = chunk_colors.iter().flatten().max().map_or(0, |&last| last as usize + 1);
        let mut color_starts = Vec::with_capacity(chunks * (colors + 1));
        for (chunk, of_rows) in chunk_colors.iter().enumerate() {
            let mut counts = vec![0u32; colors];
            of_rows.iter().for_each(|&color| counts[color as usize] += 1);
            let mut start = (chunk * chunk_rows) as u32;
            color_starts.push(start);
            color_starts.extend(counts.iter().map(|count| {
                start += count;
                start
            }));
        }
        Colored {
            layout: Layout {
                rows,
                chunk_rows,
                own_start,
                order: DeviceVec::upload(executor, &lists.order),
                spans: DeviceVec::upload(executor, &lists.spans),
                block_columns: DeviceVec::upload(executor, &lists.columns),
            },
            colors,
            batches: batches(executor, &ends),
            blocks: DeviceVec::zeros(executor, lists.sources.len() * BLOCK),
            difference: false,
            sources: DeviceVec::upload(executor, &lists.sources),
            block_rows: DeviceVec::upload(executor, &lists.rows),
            color_starts: DeviceVec::upload(executor, &color_starts),
            entries: DeviceVec::zeros(executor, lists.entry_ends.len() * ENTRY),
            entry_ends: DeviceVec::upload(executor, &lists.entry_ends),
            entry_groups: lists.entry_groups,
            entry_starts: ends.iter().map(|end| end.1).collect(),
            correction: DeviceVec::zeros(executor, chunks * 3),
            sums: DeviceVec::zeros(executor, chunks * SUMS),
        }
    }

    /// Copies the values of `matrix` and sums them by chunk and group. `flags`: a local vector, zero on pinned rows.
    /// Bytes per row of a cloth: about 1,600.
    pub(super) fn set_values(
        &mut self,
        executor: &Executor,
        matrix: &SellMatrix,
        flags: &DeviceVec<f32>,
    ) -> Vec<GroupSums> {
        self.difference = matrix.difference;
        match executor {
            Executor::Cpu(_) => {
                let blocks = self.blocks.as_mut_slice();
                colored_cpu::take(matrix.values.as_slice(), self.sources.as_slice(), blocks);
                colored_cpu::entry_sums(
                    blocks,
                    self.block_rows.as_slice(),
                    &self.layout.tables(),
                    self.entry_ends.as_slice(),
                    flags.as_slice(),
                    matrix.difference,
                    self.entries.as_mut_slice(),
                );
            }
            Executor::Gpu(gpu) => {
                for batch in 0..self.batches.len() {
                    self.take_batch(gpu, batch, matrix, flags);
                }
            }
        }
        let entries = self.entries.read(executor);
        let of_chunk = |entries: Range<usize>, sums: &[f32]| {
            let sums = sums.as_chunks::<ENTRY>().0[entries.clone()].iter();
            let free = sums.clone().map(|sums| std::array::from_fn(|c| f64::from(sums[c])));
            let mut groups: GroupSums = self.entry_groups[entries].iter().copied().zip(free).collect();
            if self.difference {
                // The first entry is that of the chunk itself, whose own blocks cancel.
                let mut coupled = [0.0; BLOCK];
                for (number, sums) in sums.enumerate() {
                    for c in 0..BLOCK {
                        let free = if number == 0 { 0.0 } else { f64::from(sums[c]) };
                        coupled[c] += free + f64::from(sums[BLOCK + c]);
                    }
                }
                groups[0].1.iter_mut().zip(coupled).for_each(|(sum, v)| *sum -= v);
            }
            groups
        };
        self.entry_starts.windows(2).map(|ends| of_chunk(ends[0]..ends[1], &entries)).collect()
    }

    fn take_batch(&mut self, gpu: &GpuExecutor, batch: usize, matrix: &SellMatrix, flags: &DeviceVec<f32>) {
        use crate::assembly::LANES;
        let params = self.params(batch);
        let Batch { blocks, entries, .. } = &self.batches[batch];
        let (first, len) = (blocks.start, blocks.len());
        for part in &matrix.fill_parts {
            let params =
                ColoredParams { first_slot: part.slots.start as u32, slots: part.slots.len() as u32, ..params };
            let values = part.slots.start * LANES * BLOCK..part.slots.end * LANES * BLOCK;
            let bindings = [
                matrix.values.window(values.start, values.len()),
                self.sources.window(first, len),
                self.blocks.window_mut(first * BLOCK, len * BLOCK),
            ];
            gpu.run(&TAKE, &bindings, &params, len as u64);
        }
        let bindings = [
            self.blocks.window(first * BLOCK, len * BLOCK),
            self.block_rows.window(first, len),
            self.layout.block_columns.window(first, len),
            self.entry_ends.binding(),
            flags.binding(),
            self.entries.binding_mut(),
        ];
        gpu.run(&ENTRY_SUMS, &bindings, &params, entries.len() as u64 * CHUNK_THREADS);
    }

    /// Computes u from r and the coarse correction (three values per own chunk), and the sums r . u and r . r. Bytes
    /// per row of a cloth: about 600.
    pub(super) fn sweep(
        &mut self,
        executor: &Executor,
        inverse_diagonal: &DeviceVec<f32>,
        correction: &[f32],
        r: &DeviceVec<f32>,
        u: &mut DeviceVec<f32>,
    ) {
        self.correction.write_range(executor, 0, correction);
        match executor {
            Executor::Cpu(_) => {
                let tables = self.layout.tables();
                colored_cpu::sweep(
                    self.blocks.as_slice(),
                    &tables,
                    inverse_diagonal.as_slice(),
                    correction,
                    r.as_slice(),
                    u.as_mut_slice(),
                    self.sums.as_mut_slice(),
                );
            }
            Executor::Gpu(gpu) => {
                for batch in 0..self.batches.len() {
                    let params = self.params(batch);
                    let Batch { chunks, blocks, .. } = &self.batches[batch];
                    let bindings = [
                        self.blocks.window(blocks.start * BLOCK, blocks.len() * BLOCK),
                        self.layout.block_columns.window(blocks.start, blocks.len()),
                        self.color_starts.binding(),
                        self.layout.order.binding(),
                        self.layout.spans.binding(),
                        inverse_diagonal.binding(),
                        self.correction.binding(),
                        r.binding(),
                        u.binding_mut(),
                        self.sums.binding_mut(),
                    ];
                    gpu.run(&SWEEP, &bindings, &params, chunks.len() as u64 * CHUNK_THREADS);
                }
            }
        }
    }

    /// Sums w . u and w over every chunk and zeroes w on pinned rows. Returns all sums: (r . u, r . r, w . u) per own
    /// chunk, and the sums of w, three per chunk. They are NaN after a fault of the device.
    pub(super) fn sums(
        &mut self,
        executor: &Executor,
        inverse_diagonal: &DeviceVec<f32>,
        w: &mut DeviceVec<f32>,
        u: &DeviceVec<f32>,
        scalars: &mut Vec<ChunkSums>,
        restricted: &mut Vec<f64>,
    ) {
        match executor {
            Executor::Cpu(_) => {
                let tables = self.layout.tables();
                let inverse = inverse_diagonal.as_slice();
                let sums = self.sums.as_mut_slice();
                colored_cpu::product_sums(&tables, inverse, w.as_mut_slice(), u.as_slice(), sums);
            }
            Executor::Gpu(gpu) => {
                let (params, chunks) = (self.params(0), (self.sums.len() / SUMS) as u64);
                let bindings = [inverse_diagonal.binding(), w.binding_mut(), u.binding(), self.sums.binding_mut()];
                gpu.run(&PRODUCT_SUMS, &bindings, &params, chunks * CHUNK_THREADS);
            }
        }
        let mut sums = self.sums.read(executor);
        if executor.take_fault().is_some() {
            sums.fill(f32::NAN);
        }
        let sums = sums.as_chunks::<SUMS>().0;
        scalars.clear();
        scalars.extend(sums.iter().map(|s| [s[0], s[1], s[2]].map(f64::from)));
        restricted.clear();
        restricted.extend(sums.iter().flat_map(|s| &s[3..]).map(|&v| f64::from(v)));
    }

    /// Device bytes of the tables and of the copy of the matrix.
    pub(super) fn bytes(&self) -> u64 {
        self.sources.bytes()
            + self.block_rows.bytes()
            + self.layout.block_columns.bytes()
            + self.blocks.bytes()
            + self.layout.order.bytes()
            + self.layout.spans.bytes()
            + self.color_starts.bytes()
            + self.entry_ends.bytes()
            + self.entries.bytes()
            + self.correction.bytes()
            + self.sums.bytes()
    }

    pub(super) fn sweep_flops(&self) -> u64 {
        (self.layout.block_columns.len() * 18 + self.layout.rows * 100) as u64
    }

    pub(super) fn sweep_bytes(&self) -> u64 {
        (self.layout.block_columns.len() * (BLOCK * 4 + 4) + self.layout.rows * 100) as u64
    }

    /// Color of every own row. Native executor only.
    #[cfg(test)]
    pub(super) fn colors_of_rows(&self) -> Vec<u32> {
        let starts = self.color_starts.as_slice().chunks(self.colors + 1);
        let mut colors = vec![0; self.layout.rows];
        for (color, range) in starts.flat_map(|of_chunk| of_chunk.windows(2).enumerate()) {
            self.layout.order.as_slice()[range[0] as usize..range[1] as usize]
                .iter()
                .for_each(|&row| colors[row as usize] = color as u32);
        }
        colors
    }

    fn params(&self, batch: usize) -> ColoredParams {
        let Batch { chunks, blocks, entries } = &self.batches[batch];
        ColoredParams {
            rows: self.layout.rows as u32,
            chunk_rows: self.layout.chunk_rows as u32,
            u_first: self.layout.own_start as u32,
            colors: self.colors as u32,
            relaxation: RELAXATION,
            first_chunk: chunks.start as u32,
            chunks: chunks.len() as u32,
            first_entry: entries.start as u32,
            entries: entries.len() as u32,
            first_block: blocks.start as u32,
            blocks: blocks.len() as u32,
            first_slot: 0,
            slots: 0,
            difference: self.difference.into(),
        }
    }
}

/// Appends the rows `own` of a chunk by color, and then the blocks of the chunk that couple it with others, by group.
fn add_chunk(
    lists: &mut Lists,
    pattern: &RankPattern,
    own: Range<usize>,
    inside: &Range<usize>,
    colors: &[u32],
    group_of: impl Fn(u32) -> usize,
) {
    let mut order: Vec<usize> = own.clone().collect();
    order.sort_by_key(|&row| colors[row - own.start]);
    let color_of = |column: u32| colors[column as usize - inside.start];
    let first_block = lists.len();
    let mut outer: Vec<(usize, usize, usize)> = Vec::new();
    for &row in &order {
        let blocks = pattern.offsets[row] as usize..pattern.offsets[row + 1] as usize;
        let within = |k: &usize| inside.contains(&(pattern.columns[*k] as usize));
        let (own_column, own_color) = (inside.start + row - own.start, colors[row - own.start]);
        let start = lists.len();
        let diagonal = blocks.clone().find(|&k| pattern.columns[k] as usize == own_column);
        lists.push(pattern, row, diagonal.unwrap_or_else(|| panic!("row {row} has a diagonal block")));
        let below = |k: &usize| color_of(pattern.columns[*k]) < own_color;
        blocks.clone().filter(within).filter(below).for_each(|k| lists.push(pattern, row, k));
        let above_start = lists.len();
        let above = |k: &usize| color_of(pattern.columns[*k]) > own_color;
        blocks.clone().filter(within).filter(above).for_each(|k| lists.push(pattern, row, k));
        lists.order.push(row as u32);
        lists.spans.push([start, above_start, lists.len()]);
        outer.extend(blocks.filter(|k| !within(k)).map(|k| (group_of(pattern.columns[k]), row, k)));
    }
    let add_entry = |lists: &mut Lists, group: usize, start: u32| {
        lists.entry_ends.push([start, lists.len()]);
        lists.entry_groups.push(group as u32);
    };
    add_entry(lists, group_of(inside.start as u32), first_block);
    outer.sort_unstable();
    for of_group in outer.chunk_by(|a, b| a.0 == b.0) {
        let start = lists.len();
        of_group.iter().for_each(|&(_, row, k)| lists.push(pattern, row, k));
        add_entry(lists, of_group[0].0, start);
    }
    let padding = lists.sources.len().next_multiple_of(WINDOW_STEP);
    lists.sources.resize(padding, PADDING);
    lists.rows.resize(padding, own.start as u32);
    lists.columns.resize(padding, inside.start as u32);
}

/// Cuts the chunks so that the blocks of each part can be bound. `ends`: blocks and sums before each chunk, and their
/// totals at the end.
fn batches(executor: &Executor, ends: &[(usize, usize)]) -> Vec<Batch> {
    let most = match executor {
        Executor::Cpu(_) => usize::MAX,
        Executor::Gpu(gpu) => gpu.window_items(BLOCK * size_of::<f32>()),
    };
    let chunks = ends.len() - 1;
    let mut batches = Vec::new();
    let mut first = 0;
    while first < chunks {
        let fits = |end: usize| ends[end].0 - ends[first].0 <= most;
        let mut end = first + 1;
        while end < chunks && fits(end + 1) {
            end += 1;
        }
        if let (false, Executor::Gpu(gpu)) = (fits(end), executor) {
            gpu.stop(format!(
                "the preconditioner schwarz binds the {} blocks of a chunk of rows, at most {most} fit: use jacobi",
                ends[end].0 - ends[first].0
            ));
        }
        batches.push(Batch {
            chunks: first..end,
            blocks: ends[first].0..ends[end].0,
            entries: ends[first].1..ends[end].1,
        });
        first = end;
    }
    batches
}
