//! Index filling [Li et al. 2020, Sec. 3.2.2, steps 1 to 4]. From the elements that touch a row it computes the row's
//! distinct columns in ascending global order, their slots in the sliced block-ELL matrix, and the position of every
//! contribution in its row.
//!
//! Four kernels work on a table with room for every corner of every contribution. This is the upper bound of the
//! paper's step 1, which follows from the row lists. `index_columns` writes the corners' columns, `index_compact` sorts
//! them and merges duplicates, `index_positions` looks the corners up again, `index_place` writes columns to their
//! slots. Before `index_place` the host reads the lengths of the rows and lays out the slices. Elastic tables are
//! filled once, contact tables every step.

use std::ops::Range;

use super::index_fill_cpu::{self, KindInputs};
use super::layout::{Placement, Segment};
use super::sell::SellMatrix;
use crate::forces::{ContactElement, HingeElement, TriangleElement};
use crate::gpu::{Binding, DeviceVec, Executor, GpuExecutor, KernelSource, WINDOW_STEP, gpu_struct};

const TEXT: &str = include_str!("index_fill.wgsl");
static COLUMNS: KernelSource = KernelSource::new::<IndexParams>("assembly/index_fill.wgsl", TEXT, "index_columns");
static COMPACT: KernelSource = KernelSource::new::<IndexParams>("assembly/index_fill.wgsl", TEXT, "index_compact");
static POSITIONS: KernelSource = KernelSource::new::<IndexParams>("assembly/index_fill.wgsl", TEXT, "index_positions");
static PLACE: KernelSource = KernelSource::new::<IndexParams>("assembly/index_fill.wgsl", TEXT, "index_place");

/// Marks a corner without a column.
pub(super) const NO_COLUMN: u32 = u32::MAX;
/// Position of a corner without a column.
pub const NO_POSITION: u16 = u16::MAX;
/// Bit of a row's length: the row has columns of other ranks.
pub(super) const REMOTE: u32 = 1 << 31;
/// Maximum loop turns of one invocation of a kernel (the prelude of all kernels has the rule).
const TURNS_MAX: usize = 60_000;

gpu_struct! {
    struct IndexParams {
        first_row: u32,
        rows: u32,
        table_first: u32,
        own_column: u32,
        own_start: u32,
        own_end: u32,
        columns: u32,
        corners_a: u32,
        corners_b: u32,
        kind: u32,
        stride: u32,
        first_element: u32,
        elements: u32,
        parts: u32,
        lanes: u32,
        padding0: u32,
    }
}

/// A row has more columns than positions can index.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("vertex {local} is coupled to {columns} others; at most {max} fit", max = NO_POSITION - 1)]
pub struct RowTooLong {
    /// Own row.
    pub local: usize,
    /// Number of its columns.
    pub columns: usize,
}

/// The local vertices of a rank, with the ranges that are rows and columns of the system.
#[derive(Clone, Debug)]
pub struct Numbering<'a> {
    /// Own rows among the local vertices.
    pub own: Range<usize>,
    /// Number of local vertices with a column; the vertices after them belong to obstacles.
    pub columns: usize,
    /// Global row of every local vertex with a column. The values are distinct and order the columns of a row.
    pub global_from_local: &'a [u32],
    /// Sub-vectors of the `full` exchange, None in `halo` mode.
    pub sub_vectors: Option<SubVectors<'a>>,
}

/// Cuts of a row at sub-vector boundaries, in `full` mode.
#[derive(Clone, Copy, Debug)]
pub struct SubVectors<'a> {
    /// Global rows of every rank: consecutive ranges from 0.
    pub rows_of: &'a [Range<usize>],
    /// Other ranks in the order in which their sub-vectors arrive.
    pub order: &'a [usize],
}

pub(super) struct IndexRows {
    pub own: Range<usize>,
    pub columns: usize,
    /// True: every row has its diagonal column. False: no row has it.
    pub own_column: bool,
}

impl IndexRows {
    /// Start of row `r` in the table. `kinds`: corners and list offsets.
    pub(super) fn start<'a>(&self, r: usize, kinds: impl Iterator<Item = (usize, &'a [u32])>) -> usize {
        let own = if self.own_column { r } else { 0 };
        own + kinds.map(|(corners, offsets)| corners * offsets[r] as usize).sum::<usize>()
    }
}

/// Elements of one kind.
#[derive(Clone, Copy)]
pub(super) enum Elements<'a> {
    Triangles(&'a DeviceVec<TriangleElement>),
    Hinges(&'a DeviceVec<HingeElement>),
    Contacts(&'a DeviceVec<ContactElement>),
}

impl<'a> Elements<'a> {
    fn corners(&self) -> usize {
        if matches!(self, Elements::Triangles(_)) { 3 } else { 4 }
    }

    fn len(&self) -> usize {
        match self {
            Elements::Triangles(elements) => elements.len(),
            Elements::Hinges(elements) => elements.len(),
            Elements::Contacts(elements) => elements.len(),
        }
    }

    fn size(&self) -> usize {
        match self {
            Elements::Triangles(_) => size_of::<TriangleElement>(),
            Elements::Hinges(_) => size_of::<HingeElement>(),
            Elements::Contacts(_) => size_of::<ContactElement>(),
        }
    }

    fn words(&self) -> &'a [u32] {
        match self {
            Elements::Triangles(elements) => bytemuck::cast_slice(elements.as_slice()),
            Elements::Hinges(elements) => bytemuck::cast_slice(elements.as_slice()),
            Elements::Contacts(elements) => bytemuck::cast_slice(elements.as_slice()),
        }
    }

    fn window(&self, range: &Range<usize>) -> Binding<'a> {
        match self {
            Elements::Triangles(elements) => elements.window(range.start, range.len()),
            Elements::Hinges(elements) => elements.window(range.start, range.len()),
            Elements::Contacts(elements) => elements.window(range.start, range.len()),
        }
    }
}

/// Elements of one kind and their row lists.
pub(super) struct Kind<'a> {
    pub elements: Elements<'a>,
    /// Row lists ([`super::ElementRows`]) on the host, and their copies on the executor.
    pub host_offsets: &'a [u32],
    pub offsets: &'a DeviceVec<u32>,
    pub entries: &'a DeviceVec<u32>,
    /// Output: position in its row of every corner of every entry, [`NO_POSITION`] for none.
    pub positions: &'a mut DeviceVec<[u16; 4]>,
}

/// The tables of an index; their memory is reused by the next filling.
pub(super) struct IndexFill {
    table: DeviceVec<u32>,
    lengths: DeviceVec<u32>,
    global_from_local: DeviceVec<u32>,
    part_ends: DeviceVec<u32>,
    lanes: DeviceVec<[u32; 4]>,
    /// Lengths on the host: per row one length for each sub-vector. With a single sub-vector the length carries
    /// [`REMOTE`].
    host_lengths: Vec<u32>,
    parts: usize,
    nothing: DeviceVec<u32>,
}

impl IndexFill {
    pub(super) fn new(executor: &Executor) -> IndexFill {
        let empty = || DeviceVec::zeros(executor, 0);
        IndexFill {
            table: empty(),
            lengths: empty(),
            global_from_local: empty(),
            part_ends: empty(),
            lanes: DeviceVec::zeros(executor, 0),
            host_lengths: Vec::new(),
            parts: 1,
            nothing: empty(),
        }
    }

    /// Device bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.table.held_bytes()
            + self.lengths.held_bytes()
            + self.global_from_local.held_bytes()
            + self.lanes.held_bytes()
    }

    /// Distinct columns of `count` rows, their lengths, and the positions of the corners.
    ///
    /// # Errors
    /// A row has more columns than positions can index; the error holds its number among the `count` rows.
    pub(super) fn fill(
        &mut self,
        executor: &Executor,
        numbering: &Numbering<'_>,
        rows: &IndexRows,
        count: usize,
        kinds: &mut [Kind<'_>],
    ) -> Result<(), RowTooLong> {
        let part_ends: Vec<u32> = match &numbering.sub_vectors {
            Some(cut) => cut.rows_of.iter().map(|rows| rows.end as u32).collect(),
            None => vec![u32::MAX],
        };
        self.parts = part_ends.len();
        self.part_ends.assign(executor, &part_ends);
        self.global_from_local.assign(executor, &numbering.global_from_local[..numbering.columns]);
        self.table.resize(executor, row_start(rows, kinds, count));
        self.lengths.resize(executor, count * self.parts);
        for kind in kinds.iter_mut() {
            kind.positions.resize(executor, kind.entries.len());
        }
        match executor {
            Executor::Cpu(cpu) => {
                let mut inputs: Vec<KindInputs<'_>> = kinds.iter_mut().map(inputs_of).collect();
                index_fill_cpu::index_rows(
                    cpu,
                    rows,
                    &mut inputs,
                    self.global_from_local.as_slice(),
                    self.part_ends.as_slice(),
                    self.table.as_mut_slice(),
                    self.lengths.as_mut_slice(),
                );
            }
            Executor::Gpu(gpu) => self.fill_on_device(gpu, rows, count, kinds),
        }
        self.host_lengths.resize(count * self.parts, 0);
        self.lengths.read_range(executor, 0, &mut self.host_lengths);
        for local in 0..count {
            let columns = self.length(local);
            if columns >= usize::from(NO_POSITION) {
                return Err(RowTooLong { local, columns });
            }
        }
        Ok(())
    }

    /// Segments of the lanes of the last call of [`IndexFill::place`].
    pub(super) fn lanes(&self) -> &DeviceVec<[u32; 4]> {
        &self.lanes
    }

    /// Columns of row `r`.
    pub(super) fn length(&self, r: usize) -> usize {
        self.host_lengths[r * self.parts..(r + 1) * self.parts].iter().map(|&n| (n & !REMOTE) as usize).sum()
    }

    /// The rows cut into the sections of the exchange mode. `own_row`: own row of every row of the tables. `late`: rows
    /// that always belong to the second section of `halo`.
    pub(super) fn segments(
        &self,
        numbering: &Numbering<'_>,
        count: usize,
        own_row: impl Fn(usize) -> u32,
        late: impl Fn(u32) -> bool,
    ) -> Vec<Vec<Segment>> {
        let Some(cut) = &numbering.sub_vectors else {
            let mut sections = vec![Vec::with_capacity(count), Vec::new()];
            for (index, &length) in self.host_lengths.iter().enumerate().filter(|(_, n)| **n & !REMOTE != 0) {
                let row = own_row(index);
                let second = length & REMOTE != 0 || late(row);
                let (index, length) = (index as u32, length & !REMOTE);
                sections[usize::from(second)].push(Segment { index, row, part: 0, first: 0, length });
            }
            return sections;
        };
        let mut section_of_rank = vec![0; self.parts];
        cut.order.iter().enumerate().for_each(|(i, &rank)| section_of_rank[rank] = i + 1);
        let mut sections = vec![Vec::new(); cut.order.len() + 1];
        for (index, lengths) in self.host_lengths.chunks_exact(self.parts).enumerate() {
            let (row, index, mut first) = (own_row(index), index as u32, 0);
            for (part, length) in lengths.iter().map(|n| n & !REMOTE).enumerate().filter(|(_, n)| *n > 0) {
                let part_number = part as u32;
                sections[section_of_rank[part]].push(Segment { index, row, part: part_number, first, length });
                first += length;
            }
        }
        sections
    }

    /// Writes the columns of `placement` into `matrix`, which has room for them. With `row_offsets` (start of every row
    /// in pattern order) it also writes the address of every block.
    #[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
    pub(super) fn place(
        &mut self,
        executor: &Executor,
        rows: &IndexRows,
        count: usize,
        kinds: &[Kind<'_>],
        placement: &Placement,
        matrix: &mut SellMatrix,
        mut addresses: Option<(&DeviceVec<u32>, &mut DeviceVec<u32>)>,
    ) {
        assert_eq!(addresses.is_some(), rows.own_column);
        self.lanes.assign(executor, &placement.lanes);
        match executor {
            Executor::Cpu(cpu) => index_fill_cpu::index_place(
                cpu,
                |r| row_start(rows, kinds, r),
                self.global_from_local.as_slice(),
                self.part_ends.as_slice(),
                self.table.as_slice(),
                self.lanes.as_slice(),
                matrix.slice_offsets.as_slice(),
                matrix.columns.as_mut_slice(),
                addresses.as_ref().map_or(&[], |(offsets, _)| offsets.as_slice()),
                addresses.as_mut().map_or(&mut [], |(_, addresses)| addresses.as_mut_slice()),
            ),
            Executor::Gpu(gpu) => {
                for window in self.windows(gpu, rows, count, kinds) {
                    let params = IndexParams { lanes: placement.lanes.len() as u32, ..window.params };
                    let (row_offsets, block_address) = match &mut addresses {
                        Some((row_offsets, addresses)) => (row_offsets.binding(), addresses.binding_mut()),
                        // Placeholder that no kernel writes, because no row stores addresses.
                        None => (self.part_ends.binding(), self.nothing.binding_mut()),
                    };
                    let bindings = [
                        kinds[0].offsets.binding(),
                        kinds[kinds.len() - 1].offsets.binding(),
                        self.table.window_mut(window.first, window.len),
                        self.global_from_local.binding(),
                        self.part_ends.binding(),
                        self.lanes.binding(),
                        matrix.slice_offsets.binding(),
                        matrix.columns.binding_mut(),
                        row_offsets,
                        block_address,
                    ];
                    gpu.run(&PLACE, &bindings, &params, u64::from(params.lanes));
                }
            }
        }
    }

    fn fill_on_device(&mut self, gpu: &GpuExecutor, rows: &IndexRows, count: usize, kinds: &mut [Kind<'_>]) {
        if let Some(reason) = too_many_turns(rows, kinds, count) {
            gpu.stop(reason);
            return;
        }
        let windows = self.windows(gpu, rows, count, kinds);
        for window in &windows {
            let (first, len) = (window.first, window.len);
            let last = kinds.len() - 1;
            for pass in passes(gpu, kinds) {
                let kind = &kinds[pass.kind];
                let bindings = [
                    kinds[0].offsets.binding(),
                    kinds[last].offsets.binding(),
                    kind.entries.binding(),
                    kind.elements.window(&pass.elements),
                    self.table.window_mut(first, len),
                ];
                gpu.run(&COLUMNS, &bindings, &pass.params(&window.params, kind), u64::from(window.params.rows));
            }
            let bindings = [
                kinds[0].offsets.binding(),
                kinds[last].offsets.binding(),
                self.table.window_mut(first, len),
                self.global_from_local.binding(),
                self.part_ends.binding(),
                self.lengths.binding_mut(),
            ];
            gpu.run(&COMPACT, &bindings, &window.params, u64::from(window.params.rows));
            for pass in passes(gpu, kinds) {
                let (a, b) = (kinds[0].offsets, kinds[last].offsets);
                let kind = &mut kinds[pass.kind];
                let params = pass.params(&window.params, kind);
                let bindings = [
                    a.binding(),
                    b.binding(),
                    kind.entries.binding(),
                    kind.elements.window(&pass.elements),
                    self.table.window_mut(first, len),
                    self.global_from_local.binding(),
                    self.lengths.binding_mut(),
                    kind.positions.binding_mut(),
                ];
                gpu.run(&POSITIONS, &bindings, &params, u64::from(window.params.rows));
            }
        }
    }

    /// Consecutive rows whose parts of the table can be bound together. The device refuses a single row that is too
    /// large.
    fn windows(&self, gpu: &GpuExecutor, rows: &IndexRows, count: usize, kinds: &[Kind<'_>]) -> Vec<Window> {
        let most = gpu.window_items(size_of::<u32>());
        let corners = |k: usize| kinds.get(k).map_or(0, |kind| kind.elements.corners() as u32);
        let mut windows = Vec::new();
        let mut first_row = 0;
        while first_row < count {
            let first = row_start(rows, kinds, first_row) / WINDOW_STEP * WINDOW_STEP;
            let fits = |end: usize| row_start(rows, kinds, end) <= first + most;
            // Largest end that fits; starts ascend.
            let (mut end, mut past) = (first_row + 1, count + 1);
            while past - end > 1 {
                let middle = end.midpoint(past);
                if fits(middle) { end = middle } else { past = middle }
            }
            let len = row_start(rows, kinds, end) - first;
            let params = IndexParams {
                first_row: first_row as u32,
                rows: (end - first_row) as u32,
                table_first: first as u32,
                own_column: rows.own_column.into(),
                own_start: rows.own.start as u32,
                own_end: rows.own.end as u32,
                columns: rows.columns as u32,
                corners_a: corners(0),
                corners_b: corners(1),
                kind: 0,
                stride: 0,
                first_element: 0,
                elements: 0,
                parts: self.parts as u32,
                lanes: 0,
                padding0: 0,
            };
            windows.push(Window { first, len, params });
            first_row = end;
        }
        windows
    }
}

/// Part of the table that is bound together.
struct Window {
    first: usize,
    len: usize,
    params: IndexParams,
}

/// Elements that are bound together.
struct Pass {
    kind: usize,
    elements: Range<usize>,
}

impl Pass {
    fn params(&self, window: &IndexParams, kind: &Kind<'_>) -> IndexParams {
        IndexParams {
            kind: self.kind as u32,
            stride: (kind.elements.size() / size_of::<u32>()) as u32,
            first_element: self.elements.start as u32,
            elements: self.elements.len() as u32,
            ..*window
        }
    }
}

fn passes(gpu: &GpuExecutor, kinds: &[Kind<'_>]) -> Vec<Pass> {
    let of_kind = |kind: usize| {
        let elements = kinds[kind].elements;
        gpu.windows(elements.len(), elements.size()).map(move |elements| Pass { kind, elements })
    };
    (0..kinds.len()).flat_map(of_kind).collect()
}

fn inputs_of<'a>(kind: &'a mut Kind<'_>) -> KindInputs<'a> {
    KindInputs {
        offsets: kind.offsets.as_slice(),
        entries: kind.entries.as_slice(),
        words: kind.elements.words(),
        stride: kind.elements.size() / size_of::<u32>(),
        corners: kind.elements.corners(),
        positions: kind.positions.as_mut_slice(),
    }
}

fn row_start(rows: &IndexRows, kinds: &[Kind<'_>], r: usize) -> usize {
    rows.start(r, kinds.iter().map(|kind| (kind.elements.corners(), kind.host_offsets)))
}

/// The refusal, if one row has too many contributions for a single invocation.
fn too_many_turns(rows: &IndexRows, kinds: &[Kind<'_>], count: usize) -> Option<String> {
    let items = |r: usize| row_start(rows, kinds, r + 1) - row_start(rows, kinds, r);
    let longest = (0..count).max_by_key(|&r| items(r))?;
    if u32::try_from(row_start(rows, kinds, count)).is_err() {
        return Some("the elements of this worker are too many for 32-bit tables: use more workers".into());
    }
    // Heap sort: two descents of at most log2 levels per item; positions: a binary search per corner.
    let levels = items(longest).max(2).ilog2() as usize + 1;
    if items(longest) * 2 * (levels + 2) <= TURNS_MAX {
        return None;
    }
    let list = |kind: &Kind<'_>| kind.host_offsets[longest + 1] - kind.host_offsets[longest];
    let elements: u32 = kinds.iter().map(list).sum();
    Some(format!("a vertex belongs to {elements} elements, more than the gpu executor takes: use the cpu executor"))
}
