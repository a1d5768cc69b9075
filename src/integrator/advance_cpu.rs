//! CPU twins of `advance.wgsl`.

use crate::gpu::CpuExecutor;

/// v += dv; x += dt v over the own rows. Bytes per row: 36 read, 24 written.
pub fn advance(cpu: &CpuExecutor, step_s: f32, dv: &[f32], velocities: &mut [f32], positions: &mut [f32]) {
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

/// out[row] = values[i] for the i-th row of `rows`.
pub fn scatter(rows: &[u32], values: &[[f32; 3]], first: usize, out: &mut [f32]) {
    for (&row, value) in rows.iter().zip(values) {
        out[first + row as usize * 3..][..3].copy_from_slice(value);
    }
}
