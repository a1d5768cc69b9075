//! Right-hand side and inverse diagonal blocks of a step whose matrix is not stored. The bits equal those of
//! `assembly::fill`. Native only.

use super::diagonal_cpu;
use super::element_matrix::ElementMatrix;
use crate::assembly::contact_fill::ContactSums;
use crate::assembly::fill::{FillInputs, FillParams};
use crate::forces::fiber::TautFibers;
use crate::gpu::{DeviceVec, Executor};

/// Fills `rhs` (xyz per own row) and `inverse_diagonal` (6 per own row; zero for pinned rows). `contacts` are added to
/// the rows that they touch.
pub fn fill_diagonal(
    executor: &Executor,
    params: &FillParams,
    matrix: &ElementMatrix<'_>,
    pinned: &DeviceVec<f32>,
    contacts: Option<ContactSums<'_>>,
    rhs: &mut DeviceVec<f32>,
    inverse_diagonal: &mut DeviceVec<f32>,
) {
    let cpu = match executor {
        Executor::Cpu(cpu) => cpu,
        Executor::Gpu(gpu) => {
            gpu.stop("products without a stored matrix need the cpu executor".to_string());
            return;
        }
    };
    let inputs = FillInputs {
        row_offsets: &[],
        block_address: &[],
        triangle_offsets: matrix.triangle_lists.offsets.as_slice(),
        triangle_entries: matrix.triangle_lists.entries.as_slice(),
        triangle_positions: &[],
        hinge_offsets: matrix.hinge_lists.offsets.as_slice(),
        hinge_entries: matrix.hinge_lists.entries.as_slice(),
        hinge_positions: &[],
        elements: matrix.triangles.as_slice(),
        triangle_records: matrix.triangle_records.as_slice(),
        hinge_records: matrix.hinge_records.as_slice(),
        // It has hinge records of all kinds, and reads them all.
        fibers: &TautFibers::default(),
        masses: matrix.masses.as_slice(),
        pinned: pinned.as_slice(),
        contact_slots: contacts.map_or(&[], |contacts| contacts.slots.as_slice()),
        contact_sums: contacts.map_or(&[], |contacts| contacts.sums.as_slice()),
    };
    diagonal_cpu::fill_diagonal(cpu, params, &inputs, rhs.as_mut_slice(), inverse_diagonal.as_mut_slice());
}
