//! CPU twin of `inertia.wgsl`.

use crate::gpu::CpuExecutor;

/// rhs -= m dv over the own rows. Bytes per row: 28 read, 12 written.
pub(super) fn inertia(cpu: &CpuExecutor, masses: &[f32], dv: &[f32], rhs: &mut [f32]) {
    cpu.for_ranges_mut(rhs, 3, 4096, |range, rhs| {
        let (dv, _) = dv[range.start * 3..range.end * 3].as_chunks::<3>();
        for ((rhs, dv), &mass) in rhs.as_chunks_mut::<3>().0.iter_mut().zip(dv).zip(&masses[range]) {
            for axis in 0..3 {
                rhs[axis] -= mass * dv[axis];
            }
        }
    });
}
