//! CPU twin of `spmv.wgsl`. Every row adds its blocks in stored (ascending column) order, starting from +0, so padding
//! (zero values) and the lane a row sits in never change its bits. No fused multiply-add: its absence on some machines
//! must not change results.

use std::ops::Range;

use crate::assembly::sell::BLOCK;
use crate::assembly::{LANES, NO_ROW};
use crate::gpu::CpuExecutor;

/// Output rows that several threads write at disjoint places.
#[derive(Clone, Copy)]
struct Rows(*mut f32, usize);
// SAFETY: a section holds every row at most once (`SellLayout`), and threads work on disjoint slices.
unsafe impl Send for Rows {}
unsafe impl Sync for Rows {}

struct Tables<'a> {
    row_of_lane: &'a [u32],
    slice_offsets: &'a [u32],
    columns: &'a [u32],
    values: &'a [f32],
    x: &'a [f32],
}

/// y = A x (or y += A x with `accumulate`) for the rows in `slices`. Bytes: 40 per slot, 12 per row written, and the
/// entries of x once if they stay in cache.
pub fn spmv(cpu: &CpuExecutor, slices: Range<u32>, accumulate: bool, row_of_lane: &[u32], slice_offsets: &[u32], columns: &[u32], values: &[f32], x: &[f32], y: &mut [f32]) {
    // The gathers below are unchecked; a column past x would be a broken layout, found here once per call at little cost.
    debug_assert!(columns.iter().all(|&c| (c as usize + 1) * 3 <= x.len() || slices.is_empty()));
    let tables = Tables { row_of_lane, slice_offsets, columns, values, x };
    let rows = Rows(y.as_mut_ptr(), y.len());
    let first = slices.start as usize;
    cpu.for_ranges(slices.len(), 4, |range| {
        let slices = first + range.start..first + range.end;
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the feature is there.
            unsafe { multiply_avx2(slices, accumulate, &tables, rows) };
            return;
        }
        multiply(slices, accumulate, &tables, rows);
    });
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn multiply_avx2(slices: Range<usize>, accumulate: bool, tables: &Tables, y: Rows) {
    multiply(slices, accumulate, tables, y);
}

#[inline(always)]
fn multiply(slices: Range<usize>, accumulate: bool, tables: &Tables, y: Rows) {
    for slice in slices {
        let slots = tables.slice_offsets[slice] as usize..tables.slice_offsets[slice + 1] as usize;
        let lanes = &tables.row_of_lane[slice * LANES..(slice + 1) * LANES];
        let mut sum = [[0.0f32; LANES]; 3];
        if accumulate {
            for lane in 0..LANES {
                let row = lanes[lane];
                if row != NO_ROW {
                    for i in 0..3 {
                        // SAFETY: rows of the layout are within y (asserted by the wrapper).
                        sum[i][lane] = unsafe { *y.0.add(row as usize * 3 + i) };
                    }
                }
            }
        }
        let columns = &tables.columns[slots.start * LANES..slots.end * LANES];
        let values = &tables.values[slots.start * LANES * BLOCK..slots.end * LANES * BLOCK];
        for (columns, values) in columns.as_chunks::<LANES>().0.iter().zip(values.as_chunks::<{ LANES * BLOCK }>().0) {
            let mut x = [[0.0f32; LANES]; 3];
            for lane in 0..LANES {
                let at = columns[lane] as usize * 3;
                for j in 0..3 {
                    // SAFETY: columns of the layout are within x (asserted by the wrapper).
                    x[j][lane] = unsafe { *tables.x.get_unchecked(at + j) };
                }
            }
            for i in 0..3 {
                for j in 0..3 {
                    let a = &values[(i * 3 + j) * LANES..(i * 3 + j + 1) * LANES];
                    for lane in 0..LANES {
                        sum[i][lane] += a[lane] * x[j][lane];
                    }
                }
            }
        }
        for lane in 0..LANES {
            let row = lanes[lane];
            if row != NO_ROW {
                for i in 0..3 {
                    debug_assert!((row as usize * 3 + i) < y.1);
                    // SAFETY: see above; no other lane or thread has this row.
                    unsafe { *y.0.add(row as usize * 3 + i) = sum[i][lane] };
                }
            }
        }
    }
}
