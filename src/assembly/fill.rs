//! Value filling [Li et al. 2020, Sec. 3.2.2, step 5] and right-hand side of a rank's rows. One pass fills both,
//! because both read the same element records. The paper adds each element's blocks with atomics. Here each row gathers
//! from its sorted list, which gives the same bits for every rank count (docs/papers.md).

use std::borrow::Cow;

use super::contact_fill::ContactSums;
use super::element_rows::ElementRows;
use super::fill_cpu;
use super::index_fill::{Elements, IndexFill, IndexRows, Kind, Numbering, RowTooLong};
use super::layout::{LANES, Placement};
use super::sell::{BLOCK, SellMatrix};
use crate::forces::fiber::TautFibers;
use crate::forces::{HINGE_RECORD_FLOATS, HingeElement, TRIANGLE_RECORD_FLOATS, TriangleElement};
use crate::gpu::{DeviceVec, Executor, GpuExecutor, GpuStruct, KernelSource, gpu_struct};

pub use super::fill_cpu::inverse_symmetric;
pub(crate) use super::fill_cpu::{BlockRows, FillInputs, add_contacts, add_hinge, add_triangle};

static FILL: KernelSource = KernelSource::new::<FillPass>("assembly/fill.wgsl", include_str!("fill.wgsl"), "fill")
    .with_libraries(&[include_str!("../forces/element.wgsl")])
    .with_structs(&[TriangleElement::LAYOUT]);

/// Inputs that are the same for all rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FillParams {
    /// Acceleration of gravity, m/s^2.
    pub gravity: [f32; 3],
    /// Step length, seconds.
    pub step_s: f32,
    /// Own rows.
    pub rows: u32,
}

gpu_struct! {
    /// Uniforms of one dispatch: the bound ranges, and whether earlier or later dispatches add to the same blocks.
    struct FillPass {
        gravity: [f32; 3],
        step_s: f32,
        rows: u32,
        first_slot: u32,
        slots: u32,
        first_block: u32,
        block_turns: u32,
        first_triangle: u32,
        triangles: u32,
        first_hinge: u32,
        hinges: u32,
        passes: u32,
        contacts: u32,
        padding0: u32,
    }
}
/// FIRST_PASS and LAST_PASS of the shader.
const FIRST_PASS: u32 = 1;
const LAST_PASS: u32 = 2;
/// SHARE of the shader: invocations per row.
const SHARE: usize = 16;
/// Maximum loop turns of one invocation of a kernel (the prelude of all kernels has the rule).
const TURNS_MAX: usize = 60_000;

/// Sources and targets of every row's contributions; fixed until the pattern changes.
pub struct FillTables {
    row_offsets: DeviceVec<u32>,
    block_address: DeviceVec<u32>,
    triangle_offsets: DeviceVec<u32>,
    triangle_entries: DeviceVec<u32>,
    triangle_positions: DeviceVec<[u16; 4]>,
    hinge_offsets: DeviceVec<u32>,
    hinge_entries: DeviceVec<u32>,
    hinge_positions: DeviceVec<[u16; 4]>,
    /// Largest number of blocks and of contributions of a row.
    most_blocks: usize,
    most_contributions: usize,
}

impl FillTables {
    /// The tables of the elastic elements (corners are local vertices) and the zero matrix that they fill. This is the
    /// Index Table of a run, filled once. The row lists belong to the rows `numbering.own`.
    ///
    /// # Errors
    /// A vertex is coupled to more vertices than a row can hold.
    pub fn new(
        executor: &Executor,
        numbering: &Numbering<'_>,
        triangles: (&ElementRows, &DeviceVec<TriangleElement>),
        hinges: (&ElementRows, &DeviceVec<HingeElement>),
    ) -> Result<(FillTables, SellMatrix), RowTooLong> {
        let count = numbering.own.len();
        let upload = |words: &[u32]| DeviceVec::upload(executor, words);
        let (triangle_offsets, triangle_entries) = (upload(&triangles.0.offsets), upload(&triangles.0.entries));
        let (hinge_offsets, hinge_entries) = (upload(&hinges.0.offsets), upload(&hinges.0.entries));
        let (mut triangle_positions, mut hinge_positions) =
            (DeviceVec::zeros(executor, 0), DeviceVec::zeros(executor, 0));
        let rows = IndexRows { own: numbering.own.clone(), columns: numbering.columns, own_column: true };
        let mut kinds = [
            Kind {
                elements: Elements::Triangles(triangles.1),
                host_offsets: &triangles.0.offsets,
                offsets: &triangle_offsets,
                entries: &triangle_entries,
                positions: &mut triangle_positions,
            },
            Kind {
                elements: Elements::Hinges(hinges.1),
                host_offsets: &hinges.0.offsets,
                offsets: &hinge_offsets,
                entries: &hinge_entries,
                positions: &mut hinge_positions,
            },
        ];
        let mut index = IndexFill::new(executor);
        index.fill(executor, numbering, &rows, count, &mut kinds)?;
        let mut offsets = vec![0u32; count + 1];
        for row in 0..count {
            offsets[row + 1] = offsets[row] + index.length(row) as u32;
        }
        let placement = Placement::new(&index.segments(numbering, count, |row| row as u32, |_| false));
        let mut matrix = SellMatrix::empty(executor, count);
        matrix.difference = true;
        matrix.place(executor, &placement);
        let row_offsets = upload(&offsets);
        let mut block_address = DeviceVec::zeros(executor, placement.blocks);
        let addresses = Some((&row_offsets, &mut block_address));
        index.place(executor, &rows, count, &kinds, &placement, &mut matrix, addresses);
        let length = |offsets: &[u32], row: usize| (offsets[row + 1] - offsets[row]) as usize;
        let contributions = |row| length(&triangles.0.offsets, row) + length(&hinges.0.offsets, row);
        let tables = FillTables {
            most_blocks: (0..count).map(|row| length(&offsets, row)).max().unwrap_or(0),
            most_contributions: (0..count).map(contributions).max().unwrap_or(0),
            row_offsets,
            block_address,
            triangle_offsets,
            triangle_entries,
            triangle_positions,
            hinge_offsets,
            hinge_entries,
            hinge_positions,
        };
        Ok((tables, matrix))
    }

    /// Local columns of all blocks of `matrix`, row by row, ascending. From a device they are copied.
    pub fn local_columns(&self, executor: &Executor, matrix: &SellMatrix, numbering: &Numbering<'_>) -> Vec<u32> {
        let columns = matrix.columns.host(executor);
        let addresses = self.block_address.host(executor);
        let Some(cut) = &numbering.sub_vectors else {
            return addresses.iter().map(|&address| columns[address as usize]).collect();
        };
        // Sections are sub-vectors: the own one first, then the others in the order of arrival. Columns are positions
        // in them.
        let own = numbering.global_from_local[numbering.own.start] as usize;
        let starts =
            cut.rows_of.iter().filter(|rows| rows.contains(&own)).chain(cut.order.iter().map(|&r| &cut.rows_of[r]));
        let starts: Vec<usize> = starts.map(|rows| rows.start).collect();
        let section_ends: Vec<u32> = matrix.section_ends(executor);
        let local =
            |global: u32| numbering.global_from_local[..numbering.columns].partition_point(|&g| g < global) as u32;
        addresses
            .iter()
            .map(|&address| {
                let section = section_ends.partition_point(|&end| end <= address / LANES as u32);
                local(starts[section] as u32 + columns[address as usize])
            })
            .collect()
    }

    /// Start of every own row's blocks, and the address of every block. From a device they are copied.
    pub fn blocks(&self, executor: &Executor) -> (Cow<'_, [u32]>, Cow<'_, [u32]>) {
        (self.row_offsets.host(executor), self.block_address.host(executor))
    }

    /// Device bytes.
    pub fn bytes(&self) -> u64 {
        self.row_offsets.bytes()
            + self.block_address.bytes()
            + self.triangle_offsets.bytes()
            + self.triangle_entries.bytes()
            + self.triangle_positions.bytes()
            + self.hinge_offsets.bytes()
            + self.hinge_entries.bytes()
            + self.hinge_positions.bytes()
    }
}

/// Consecutive elements whose records one dispatch binds.
struct Pass {
    triangles: std::ops::Range<usize>,
    hinges: std::ops::Range<usize>,
}

/// All triangles, then all hinges, in as few passes as the records allow. The order in which a block adds them never
/// changes.
fn passes(gpu: &GpuExecutor, triangles: usize, hinges: usize) -> Vec<Pass> {
    let mut triangle_parts: Vec<_> = gpu.windows(triangles, TRIANGLE_RECORD_FLOATS * 4).collect();
    let mut hinge_parts: Vec<_> = gpu.windows(hinges, HINGE_RECORD_FLOATS * 4).collect();
    // The last triangles and the first hinges may share a pass.
    let shared = Pass { triangles: triangle_parts.pop().unwrap_or(0..0), hinges: hinge_parts.remove(0) };
    let before = triangle_parts.into_iter().map(|triangles| Pass { triangles, hinges: 0..0 });
    let after = hinge_parts.into_iter().map(|hinges| Pass { triangles: 0..0, hinges });
    before.chain([shared]).chain(after).collect()
}

/// The fill kernel on one executor.
pub struct Fill {
    /// A device binds this buffer in place of the sums of contacts if there are none.
    no_slots: DeviceVec<u32>,
    no_sums: DeviceVec<f32>,
}

impl Fill {
    /// Prepares the kernel.
    pub fn new(executor: &Executor) -> Fill {
        Fill { no_slots: DeviceVec::zeros(executor, 0), no_sums: DeviceVec::zeros(executor, 0) }
    }

    /// Fills `matrix`, `rhs` (xyz per own row) and `inverse_diagonal` (6 per own row; zero for pinned rows). `contacts`
    /// are added to the diagonal blocks and the right-hand side of the rows that they touch.
    #[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
    pub fn apply(
        &self,
        executor: &Executor,
        params: &FillParams,
        tables: &FillTables,
        elements: &DeviceVec<TriangleElement>,
        triangle_records: &DeviceVec<f32>,
        hinge_records: &DeviceVec<f32>,
        fibers: &TautFibers,
        masses: &DeviceVec<f32>,
        pinned: &DeviceVec<f32>,
        contacts: Option<ContactSums<'_>>,
        matrix: &mut SellMatrix,
        rhs: &mut DeviceVec<f32>,
        inverse_diagonal: &mut DeviceVec<f32>,
    ) {
        let touched = contacts.is_some();
        let contacts = contacts.unwrap_or(ContactSums { slots: &self.no_slots, sums: &self.no_sums });
        match executor {
            Executor::Cpu(cpu) => {
                let inputs = FillInputs {
                    row_offsets: tables.row_offsets.as_slice(),
                    block_address: tables.block_address.as_slice(),
                    triangle_offsets: tables.triangle_offsets.as_slice(),
                    triangle_entries: tables.triangle_entries.as_slice(),
                    triangle_positions: tables.triangle_positions.as_slice(),
                    hinge_offsets: tables.hinge_offsets.as_slice(),
                    hinge_entries: tables.hinge_entries.as_slice(),
                    hinge_positions: tables.hinge_positions.as_slice(),
                    elements: elements.as_slice(),
                    triangle_records: triangle_records.as_slice(),
                    hinge_records: hinge_records.as_slice(),
                    fibers,
                    masses: masses.as_slice(),
                    pinned: pinned.as_slice(),
                    contact_slots: contacts.slots.as_slice(),
                    contact_sums: contacts.sums.as_slice(),
                };
                let (rhs, inverse_diagonal) = (rhs.as_mut_slice(), inverse_diagonal.as_mut_slice());
                fill_cpu::fill(cpu, params, &inputs, matrix.values.as_mut_slice(), rhs, inverse_diagonal);
            }
            Executor::Gpu(gpu) => apply_on_device(
                gpu,
                params,
                tables,
                elements,
                triangle_records,
                hinge_records,
                masses,
                pinned,
                touched,
                contacts,
                matrix,
                rhs,
                inverse_diagonal,
            ),
        }
    }
}

#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
fn apply_on_device(
    gpu: &GpuExecutor,
    params: &FillParams,
    tables: &FillTables,
    elements: &DeviceVec<TriangleElement>,
    triangle_records: &DeviceVec<f32>,
    hinge_records: &DeviceVec<f32>,
    masses: &DeviceVec<f32>,
    pinned: &DeviceVec<f32>,
    touched: bool,
    contacts: ContactSums<'_>,
    matrix: &mut SellMatrix,
    rhs: &mut DeviceVec<f32>,
    inverse_diagonal: &mut DeviceVec<f32>,
) {
    // An invocation goes through its row's contributions once for the force and once for each block that it fills.
    let contributions = tables.most_contributions;
    let blocks_max = TURNS_MAX.saturating_sub(contributions) / (contributions + 2 * BLOCK);
    if blocks_max == 0 {
        gpu.stop(format!("a vertex belongs to {contributions} triangles and hinges, the gpu executor takes at most {}: use the cpu executor", TURNS_MAX / 2 - BLOCK));
        return;
    }
    let turns = tables.most_blocks.div_ceil(SHARE);
    let passes = passes(gpu, elements.len(), hinge_records.len() / HINGE_RECORD_FLOATS);
    for part in &matrix.fill_parts {
        for (index, pass) in passes.iter().enumerate() {
            for first_turn in (0..turns).step_by(blocks_max) {
                let uniform = FillPass {
                    gravity: params.gravity,
                    step_s: params.step_s,
                    rows: params.rows,
                    first_slot: part.slots.start as u32,
                    slots: part.slots.len() as u32,
                    first_block: (first_turn * SHARE) as u32,
                    block_turns: (turns - first_turn).min(blocks_max) as u32,
                    first_triangle: pass.triangles.start as u32,
                    triangles: pass.triangles.len() as u32,
                    first_hinge: pass.hinges.start as u32,
                    hinges: pass.hinges.len() as u32,
                    passes: if index == 0 { FIRST_PASS } else { 0 }
                        | if index + 1 == passes.len() { LAST_PASS } else { 0 },
                    contacts: touched.into(),
                    padding0: 0,
                };
                let bindings = [
                    tables.row_offsets.binding(),
                    tables.block_address.binding(),
                    tables.triangle_offsets.binding(),
                    tables.triangle_entries.binding(),
                    tables.triangle_positions.binding(),
                    tables.hinge_offsets.binding(),
                    tables.hinge_entries.binding(),
                    tables.hinge_positions.binding(),
                    elements.window(pass.triangles.start, pass.triangles.len()),
                    triangle_records.window(
                        pass.triangles.start * TRIANGLE_RECORD_FLOATS,
                        pass.triangles.len() * TRIANGLE_RECORD_FLOATS,
                    ),
                    hinge_records
                        .window(pass.hinges.start * HINGE_RECORD_FLOATS, pass.hinges.len() * HINGE_RECORD_FLOATS),
                    masses.binding(),
                    pinned.binding(),
                    contacts.slots.binding(),
                    contacts.sums.binding(),
                    matrix.values.window_mut(part.slots.start * LANES * BLOCK, part.slots.len() * LANES * BLOCK),
                    rhs.binding_mut(),
                    inverse_diagonal.binding_mut(),
                ];
                gpu.run(&FILL, &bindings, &uniform, u64::from(params.rows) * SHARE as u64);
            }
        }
    }
}
