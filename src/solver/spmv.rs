//! Sparse matrix-vector product of one section of a rank's rows [Bell and Garland 2008; Li et al. 2020, Sec. 3.2.2]. It
//! does not depend on ranks: `pipelined` decides when each section is multiplied.

use std::cell::RefCell;

use super::spmv_cpu;
use crate::assembly::sell::BLOCK;
use crate::assembly::{LANES, SellMatrix};
use crate::gpu::{Binding, DeviceVec, Executor, GpuExecutor, KernelSource, gpu_struct};

static SPMV: KernelSource = KernelSource::new::<SpmvParams>("solver/spmv.wgsl", include_str!("spmv.wgsl"), "spmv");
/// Maximum loop turns of one invocation of a kernel (the prelude of all kernels has the rule).
const TURNS_MAX: usize = 60_000;

gpu_struct! {
    struct SpmvParams {
        first_slice: u32,
        lanes: u32,
        first_slot: u32,
        accumulate: u32,
        difference: u32,
        own_start: u32,
        diagonal: u32,
        padding: u32,
    }
}

/// `diagonal` of a section without diagonal blocks: no column is reached.
pub const NO_DIAGONAL: u32 = 1 << 31;

/// The vector that holds the rows' own values; matrices in difference form ([`SellMatrix::difference`]) read it.
#[derive(Clone, Copy)]
pub struct OwnRows<'a> {
    /// xyz per row.
    pub x: &'a DeviceVec<f32>,
    /// Position of row 0 in `x`.
    pub start: usize,
    /// Column of the diagonal block of row 0 in the section, or [`NO_DIAGONAL`].
    pub diagonal: u32,
}

/// The SpMV kernel on one executor.
pub struct Spmv {
    /// Buffer of a device for an x that comes from host memory.
    upload: RefCell<Option<DeviceVec<f32>>>,
}

impl Spmv {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Spmv {
        Spmv { upload: RefCell::new(None) }
    }

    /// y = A x, or y += A x with `accumulate`, for the rows of `section`. `x`: xyz per column, with the own rows from
    /// row `own_start` on; `y`: xyz per own row.
    #[expect(clippy::too_many_arguments, reason = "as `apply_host`, with x on the executor")]
    pub fn apply(
        &self,
        executor: &Executor,
        matrix: &SellMatrix,
        section: usize,
        accumulate: bool,
        x: &DeviceVec<f32>,
        own_start: usize,
        y: &mut DeviceVec<f32>,
    ) {
        let own = OwnRows { x, start: own_start, diagonal: own_start as u32 };
        match executor {
            Executor::Cpu(_) => self.apply_host(executor, matrix, section, accumulate, x.as_slice(), own, y),
            Executor::Gpu(gpu) => multiply(gpu, matrix, section, accumulate, x.binding(), own, y),
        }
    }

    /// As [`Spmv::apply`] with x in host memory, for example a sub-vector in a received message. The cpu executor reads
    /// it in place; a device uploads it.
    #[expect(clippy::too_many_arguments, reason = "the operands of one product")]
    pub fn apply_host(
        &self,
        executor: &Executor,
        matrix: &SellMatrix,
        section: usize,
        accumulate: bool,
        x: &[f32],
        own: OwnRows<'_>,
        y: &mut DeviceVec<f32>,
    ) {
        assert_eq!(y.len(), matrix.rows * 3);
        match executor {
            Executor::Cpu(cpu) => spmv_cpu::spmv(
                cpu,
                matrix.sections[section].clone(),
                accumulate,
                matrix.row_of_lane.as_slice(),
                matrix.slice_offsets.as_slice(),
                matrix.columns.as_slice(),
                matrix.values.as_slice(),
                x,
                matrix.difference.then(|| {
                    let values = own.start * 3..own.start * 3 + matrix.rows * 3;
                    spmv_cpu::Own { x: &own.x.as_slice()[values], diagonal: own.diagonal }
                }),
                y.as_mut_slice(),
            ),
            Executor::Gpu(gpu) => {
                let mut upload = self.upload.borrow_mut();
                let device = match &mut *upload {
                    Some(device) if device.len() == x.len() => device,
                    other => other.insert(DeviceVec::zeros(executor, x.len())),
                };
                device.write_range(executor, 0, x);
                multiply(gpu, matrix, section, accumulate, device.binding(), own, y);
            }
        }
    }
}

fn multiply(
    gpu: &GpuExecutor,
    matrix: &SellMatrix,
    section: usize,
    accumulate: bool,
    x: Binding<'_>,
    own: OwnRows<'_>,
    y: &mut DeviceVec<f32>,
) {
    assert_eq!(y.len(), matrix.rows * 3);
    if matrix.longest_row > TURNS_MAX {
        gpu.stop(format!(
            "a row has {} blocks, the gpu executor takes at most {TURNS_MAX}: use the cpu executor",
            matrix.longest_row
        ));
    }
    for part in &matrix.parts[section] {
        let (first, slots) = (part.slots.start, part.slots.len());
        let bindings = [
            matrix.row_of_lane.binding(),
            matrix.slice_offsets.binding(),
            matrix.columns.window(first * LANES, slots * LANES),
            matrix.values.window(first * LANES * BLOCK, slots * LANES * BLOCK),
            x,
            own.x.binding(),
            y.binding_mut(),
        ];
        let lanes = part.slices.len() * LANES;
        let params = SpmvParams {
            first_slice: part.slices.start,
            lanes: lanes as u32,
            first_slot: first as u32,
            accumulate: accumulate.into(),
            difference: matrix.difference.into(),
            own_start: own.start as u32,
            diagonal: own.diagonal,
            padding: 0,
        };
        gpu.run(&SPMV, &bindings, &params, lanes as u64);
    }
}
