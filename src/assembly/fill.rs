//! Value filling [Li et al. 2020, Sec. 3.2.2, step 5] and right-hand side of a rank's rows, in one pass because both read the
//! same element records. The paper adds with atomics per element; here each row gathers from its sorted list, which gives the
//! same bits for every rank count (docs/papers.md).

use bytemuck::{Pod, Zeroable};

use super::element_rows::ElementRows;
use super::fill_cpu::{self, FillInputs};
use super::layout::SellLayout;
use super::pattern::Pattern;
use super::sell::SellMatrix;
use crate::forces::TriangleElement;
use crate::gpu::{DeviceVec, Executor};

pub use super::fill_cpu::inverse_symmetric;

/// Uniform of the fill.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct FillParams {
    /// Acceleration of gravity, m/s^2.
    pub gravity: [f32; 3],
    /// Step length, seconds.
    pub step_s: f32,
    /// Own rows.
    pub rows: u32,
    /// Fills the struct to a multiple of 16 bytes.
    pub padding: [u32; 3],
}

/// Where the contributions of every row come from and go to; fixed until the pattern changes.
pub struct FillTables {
    row_offsets: DeviceVec<u32>,
    block_address: DeviceVec<u32>,
    triangle_offsets: DeviceVec<u32>,
    triangle_entries: DeviceVec<u32>,
    triangle_positions: DeviceVec<[u16; 4]>,
    hinge_offsets: DeviceVec<u32>,
    hinge_entries: DeviceVec<u32>,
    hinge_positions: DeviceVec<[u16; 4]>,
}

impl FillTables {
    /// Uploads the tables.
    pub fn new(executor: &Executor, pattern: &Pattern, layout: &SellLayout, triangles: &ElementRows, hinges: &ElementRows) -> FillTables {
        FillTables {
            row_offsets: DeviceVec::upload(executor, &pattern.offsets),
            block_address: DeviceVec::upload(executor, &layout.block_address),
            triangle_offsets: DeviceVec::upload(executor, &triangles.offsets),
            triangle_entries: DeviceVec::upload(executor, &triangles.entries),
            triangle_positions: DeviceVec::upload(executor, &pattern.triangle_positions),
            hinge_offsets: DeviceVec::upload(executor, &hinges.offsets),
            hinge_entries: DeviceVec::upload(executor, &hinges.entries),
            hinge_positions: DeviceVec::upload(executor, &pattern.hinge_positions),
        }
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

/// The fill kernel on one executor.
pub struct Fill {}

impl Fill {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Fill {
        Fill {}
    }

    /// Fills `matrix`, `rhs` (xyz per own row) and `inverse_diagonal` (6 per own row; zero for pinned rows).
    pub fn apply(&self, executor: &Executor, params: &FillParams, tables: &FillTables, elements: &DeviceVec<TriangleElement>, triangle_records: &DeviceVec<f32>, hinge_records: &DeviceVec<f32>, masses: &DeviceVec<f32>, pinned: &DeviceVec<u32>, matrix: &mut SellMatrix, rhs: &mut DeviceVec<f32>, inverse_diagonal: &mut DeviceVec<f32>) {
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
                    masses: masses.as_slice(),
                    pinned: pinned.as_slice(),
                };
                fill_cpu::fill(cpu, params, &inputs, matrix.values.as_mut_slice(), rhs.as_mut_slice(), inverse_diagonal.as_mut_slice());
            }
        }
    }
}
