//! CPU twin of `advance.wgsl`.

use crate::gpu::CpuExecutor;

/// v += dv; x += dt v over the own rows. Bytes per row: 36 read, 24 written.
pub(super) fn advance(cpu: &CpuExecutor, step_s: f32, dv: &[f32], velocities: &mut [f32], positions: &mut [f32]) {
    cpu.for_ranges_mut(velocities, 3, 4096, |range, v| {
        for (v, dv) in v.iter_mut().zip(&dv[range.start * 3..range.end * 3]) {
            *v += dv;
        }
    });
    cpu.for_ranges_mut(positions, 3, 4096, |range, x| {
        for (x, v) in x.iter_mut().zip(&velocities[range.start * 3..range.end * 3]) {
            *x += step_s * v;
        }
    });
}
