//! Value filling of contacts: per touched row the sum of their diagonal blocks and of their right-hand sides, which the
//! elastic fill takes over, and the blocks off the diagonal, which go to a matrix of their own.

use super::contact_fill_cpu;
use super::layout::LANES;
use super::sell::{BLOCK, SellMatrix};
use crate::forces::CONTACT_RECORD_FLOATS;
use crate::gpu::{Binding, DeviceVec, Executor, GpuExecutor, KernelSource, gpu_struct};

const TEXT: &str = include_str!("contact_fill.wgsl");
static CONTACT_SUMS: KernelSource =
    KernelSource::new::<ContactFillParams>("assembly/contact_fill.wgsl", TEXT, "contact_sums");
static CONTACT_BLOCKS: KernelSource =
    KernelSource::new::<ContactFillParams>("assembly/contact_fill.wgsl", TEXT, "contact_blocks");

/// Values per touched row: diagonal block xx, xy, xz, yy, yz, zz; right-hand side xyz.
pub const SUMS: usize = 9;
/// SHARE of the shader.
const SHARE: usize = 4;
/// Loop turns that one invocation of a kernel may take (the rule is in the prelude of all kernels).
const TURNS_MAX: usize = 60_000;

gpu_struct! {
    struct ContactFillParams {
        rows: u32,
        first_record: u32,
        records: u32,
        first_pass: u32,
        first_lane: u32,
        lanes: u32,
        first_slot: u32,
        first_block: u32,
        block_turns: u32,
        padding0: u32,
        padding1: u32,
        padding2: u32,
    }
}

/// What contacts add to the diagonal blocks and the right-hand side of the elastic system.
#[derive(Clone, Copy)]
pub struct ContactSums<'a> {
    /// Per own row: its number among the touched rows, or [`super::contact_system::NO_SLOT`].
    pub slots: &'a DeviceVec<u32>,
    /// [`SUMS`] values per touched row.
    pub sums: &'a DeviceVec<f32>,
}

/// The contributions that touched rows gather.
pub(super) struct ContactLists<'a> {
    pub offsets: &'a DeviceVec<u32>,
    pub entries: &'a DeviceVec<u32>,
    /// Contributions of the row that has most.
    pub most: usize,
}

/// Fills `sums`.
pub(super) fn apply_sums(
    executor: &Executor,
    lists: &ContactLists<'_>,
    records: &DeviceVec<f32>,
    sums: &mut DeviceVec<f32>,
) {
    match executor {
        Executor::Cpu(cpu) => {
            let (offsets, entries) = (lists.offsets.as_slice(), lists.entries.as_slice());
            contact_fill_cpu::contact_sums(cpu, offsets, entries, records.as_slice(), sums.as_mut_slice());
        }
        Executor::Gpu(gpu) => {
            if blocks_per_pass(gpu, lists).is_none() {
                return;
            }
            let rows = (sums.len() / SUMS) as u32;
            for (pass, bound) in passes(gpu, rows, records) {
                let bindings = [lists.offsets.binding(), lists.entries.binding(), bound, sums.binding_mut()];
                gpu.run(&CONTACT_SUMS, &bindings, &pass, u64::from(rows));
            }
        }
    }
}

/// Fills the values of `matrix`, padding included. `positions`: of the corners of every entry; `lanes`: segment of
/// every lane of the matrix.
pub(super) fn apply_blocks(
    executor: &Executor,
    lists: &ContactLists<'_>,
    positions: &DeviceVec<[u16; 4]>,
    records: &DeviceVec<f32>,
    lanes: &DeviceVec<[u32; 4]>,
    matrix: &mut SellMatrix,
) {
    match executor {
        Executor::Cpu(cpu) => contact_fill_cpu::contact_blocks(
            cpu,
            lists.offsets.as_slice(),
            lists.entries.as_slice(),
            positions.as_slice(),
            records.as_slice(),
            lanes.as_slice(),
            matrix.slice_offsets.as_slice(),
            matrix.values.as_mut_slice(),
        ),
        Executor::Gpu(gpu) => blocks_on_device(gpu, lists, positions, records, lanes, matrix),
    }
}

fn blocks_on_device(
    gpu: &GpuExecutor,
    lists: &ContactLists<'_>,
    positions: &DeviceVec<[u16; 4]>,
    records: &DeviceVec<f32>,
    lanes: &DeviceVec<[u32; 4]>,
    matrix: &mut SellMatrix,
) {
    let Some(blocks_max) = blocks_per_pass(gpu, lists) else { return };
    let turns = matrix.longest_row.div_ceil(SHARE);
    let rows = (lists.offsets.len() - 1) as u32;
    for (pass, bound) in passes(gpu, rows, records) {
        for part in &matrix.fill_parts {
            for first_turn in (0..turns).step_by(blocks_max) {
                let params = ContactFillParams {
                    first_lane: part.slices.start * LANES as u32,
                    lanes: (part.slices.len() * LANES) as u32,
                    first_slot: part.slots.start as u32,
                    first_block: (first_turn * SHARE) as u32,
                    block_turns: (turns - first_turn).min(blocks_max) as u32,
                    ..pass
                };
                let bindings = [
                    lists.offsets.binding(),
                    lists.entries.binding(),
                    positions.binding(),
                    bound,
                    lanes.binding(),
                    matrix.slice_offsets.binding(),
                    matrix.values.window_mut(part.slots.start * LANES * BLOCK, part.slots.len() * LANES * BLOCK),
                ];
                gpu.run(&CONTACT_BLOCKS, &bindings, &params, u64::from(params.lanes) * SHARE as u64);
            }
        }
    }
}

/// Blocks that one invocation may fill; stops the device if a row has too many contributions.
fn blocks_per_pass(gpu: &GpuExecutor, lists: &ContactLists<'_>) -> Option<usize> {
    // Turns of one block: a look at every contribution, nine components of those that count, reading and writing.
    let turns_per_block = lists.most * (1 + BLOCK) + 2 * BLOCK + 1;
    let blocks_max = TURNS_MAX / turns_per_block;
    if blocks_max == 0 {
        let most = lists.most;
        gpu.stop(format!("a vertex has {most} contacts, more than the gpu executor takes: use the cpu executor"));
        return None;
    }
    Some(blocks_max)
}

/// The records in parts that the device can bind, in ascending order.
fn passes<'a>(
    gpu: &GpuExecutor,
    rows: u32,
    records: &'a DeviceVec<f32>,
) -> impl Iterator<Item = (ContactFillParams, Binding<'a>)> {
    gpu.windows(records.len() / CONTACT_RECORD_FLOATS, CONTACT_RECORD_FLOATS * size_of::<f32>()).map(move |window| {
        let pass = ContactFillParams {
            rows,
            first_record: window.start as u32,
            records: window.len() as u32,
            first_pass: (window.start == 0).into(),
            first_lane: 0,
            lanes: 0,
            first_slot: 0,
            first_block: 0,
            block_turns: 0,
            padding0: 0,
            padding1: 0,
            padding2: 0,
        };
        (pass, records.window(window.start * CONTACT_RECORD_FLOATS, window.len() * CONTACT_RECORD_FLOATS))
    })
}
