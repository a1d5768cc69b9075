//! CPU twins of `vector.wgsl`: the vector work of a PCG iteration, chunk by chunk.
//!
//! Sums: 16 running f32 lanes over at most TILE rows, then f64. A chunk is the unit of work and of summation, so the
//! result does not depend on threads or ranks.

use crate::gpu::CpuExecutor;

/// Rows per tile; the working set of a tile (nine vectors) stays in the first-level cache.
const TILE: usize = 64;
const SUM_LANES: usize = 16;

/// Sum of a*b over a tile.
#[inline(always)]
pub(super) fn dot_tile(a: &[f32], b: &[f32]) -> f64 {
    let mut lanes = [0.0f32; SUM_LANES];
    let (a, a_rest) = a.as_chunks::<SUM_LANES>();
    let (b, b_rest) = b.as_chunks::<SUM_LANES>();
    for (a, b) in a.iter().zip(b) {
        for l in 0..SUM_LANES {
            lanes[l] += a[l] * b[l];
        }
    }
    for (l, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
        lanes[l] += a * b;
    }
    let mut sum = 0.0f64;
    for lane in lanes {
        sum += lane as f64;
    }
    sum
}

/// u = inverse_diagonal * r for one row.
#[inline(always)]
fn precondition(inverse: &[f32; 6], r: [f32; 3]) -> [f32; 3] {
    let [xx, xy, xz, yy, yz, zz] = *inverse;
    [xx * r[0] + xy * r[1] + xz * r[2], xy * r[0] + yy * r[1] + yz * r[2], xz * r[0] + yz * r[1] + zz * r[2]]
}

/// Disjoint parts of several vectors, one chunk at a time.
#[derive(Clone, Copy)]
pub(super) struct Shared(pub(super) *mut f32);
// SAFETY: `part` is called with the range of the chunk that the thread owns.
unsafe impl Send for Shared {}
unsafe impl Sync for Shared {}

impl Shared {
    /// # Safety
    /// No two live parts overlap and `start + len` is within the vector.
    pub(super) unsafe fn part<'a>(self, start: usize, len: usize) -> &'a mut [f32] {
        // SAFETY: contract.
        unsafe { std::slice::from_raw_parts_mut(self.0.add(start), len) }
    }

    /// Address of value `i`, for prefetches only.
    pub(super) fn at(self, i: usize) -> *const f32 {
        self.0.wrapping_add(i)
    }
}

/// sums[chunk] = (w . u) over the chunk's rows.
pub(super) fn dot(cpu: &CpuExecutor, chunk_rows: usize, w: &[f32], u: &[f32], sums: &mut [f64]) {
    cpu.for_ranges_mut(sums, 1, 1, |range, sums| {
        for (chunk, sum) in range.zip(sums) {
            let end = ((chunk + 1) * chunk_rows * 3).min(w.len());
            let mut at = chunk * chunk_rows * 3;
            *sum = 0.0;
            while at < end {
                let next = (at + TILE * 3).min(end);
                *sum += dot_tile(&w[at..next], &u[at..next]);
                at = next;
            }
        }
    });
}

/// r = b - w (0 on pinned rows), u = inverse_diagonal * r, sums[chunk] = (r . u, r . r).
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn start(
    cpu: &CpuExecutor,
    chunk_rows: usize,
    b: &[f32],
    w: &[f32],
    inverse_diagonal: &[f32],
    r: &mut [f32],
    u: &mut [f32],
    sums: &mut [[f64; 2]],
) {
    let (rows, r, u) = (r.len() / 3, Shared(r.as_mut_ptr()), Shared(u.as_mut_ptr()));
    cpu.for_ranges_mut(sums, 1, 1, |range, sums| {
        for (chunk, sum) in range.zip(sums) {
            *sum = [0.0; 2];
            let end = ((chunk + 1) * chunk_rows).min(rows);
            for first in (chunk * chunk_rows..end).step_by(TILE) {
                let count = TILE.min(end - first);
                // SAFETY: tiles of chunks are disjoint and within the vectors.
                let (r, u) = unsafe { (r.part(first * 3, count * 3), u.part(first * 3, count * 3)) };
                for row in 0..count {
                    let inverse = inverse_of(inverse_diagonal, first + row);
                    for c in 0..3 {
                        r[row * 3 + c] =
                            if inverse[0] == 0.0 { 0.0 } else { b[(first + row) * 3 + c] - w[(first + row) * 3 + c] };
                    }
                    u[row * 3..row * 3 + 3]
                        .copy_from_slice(&precondition(inverse, [r[row * 3], r[row * 3 + 1], r[row * 3 + 2]]));
                }
                sum[0] += dot_tile(r, u);
                sum[1] += dot_tile(r, r);
            }
        }
    });
}

#[inline(always)]
fn inverse_of(inverse_diagonal: &[f32], row: usize) -> &[f32; 6] {
    &inverse_diagonal.as_chunks::<6>().0[row]
}

/// One fused vector pass of an iteration [Chronopoulos and Gear 1989]:
/// p = u + beta p; s = w + beta s; x += alpha p; r -= alpha s; u = inverse_diagonal * r; sums[chunk] = (r . u, r . r).
/// Pinned rows (zero inverse) keep r = u = 0. Bytes per row: 96 read, 60 written.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn update(
    cpu: &CpuExecutor,
    chunk_rows: usize,
    alpha: f32,
    beta: f32,
    w: &[f32],
    inverse_diagonal: &[f32],
    u: &mut [f32],
    p: &mut [f32],
    s: &mut [f32],
    x: &mut [f32],
    r: &mut [f32],
    sums: &mut [[f64; 2]],
) {
    let rows = r.len() / 3;
    assert!([w.len(), u.len(), p.len(), s.len(), x.len()].iter().all(|&n| n == rows * 3));
    let vectors = [u, p, s, x, r].map(|v| Shared(v.as_mut_ptr()));
    cpu.for_ranges_mut(sums, 1, 1, |range, sums| {
        for (chunk, sum) in range.zip(sums) {
            let chunk = chunk * chunk_rows..((chunk + 1) * chunk_rows).min(rows);
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: the feature is there; chunks are disjoint and within the vectors.
                *sum = unsafe { update_avx2(chunk, alpha, beta, w, inverse_diagonal, vectors) };
                continue;
            }
            // SAFETY: chunks are disjoint and within the vectors.
            *sum = unsafe { update_chunk(chunk, alpha, beta, w, inverse_diagonal, vectors) };
        }
    });
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn update_avx2(
    chunk: std::ops::Range<usize>,
    alpha: f32,
    beta: f32,
    w: &[f32],
    inverse_diagonal: &[f32],
    vectors: [Shared; 5],
) -> [f64; 2] {
    // SAFETY: contract of the caller.
    unsafe { update_chunk(chunk, alpha, beta, w, inverse_diagonal, vectors) }
}

/// # Safety
/// `chunk` is within the vectors and no other thread works on it.
#[inline(always)]
unsafe fn update_chunk(
    chunk: std::ops::Range<usize>,
    alpha: f32,
    beta: f32,
    w: &[f32],
    inverse_diagonal: &[f32],
    vectors: [Shared; 5],
) -> [f64; 2] {
    let mut sum = [0.0f64; 2];
    for first in chunk.clone().step_by(TILE) {
        let count = TILE.min(chunk.end - first);
        // SAFETY: contract.
        let [u, p, s, x, r] = vectors.map(|v| unsafe { v.part(first * 3, count * 3) });
        let w = &w[first * 3..(first + count) * 3];
        for i in 0..count * 3 {
            p[i] = u[i] + beta * p[i];
            s[i] = w[i] + beta * s[i];
            x[i] += alpha * p[i];
            r[i] -= alpha * s[i];
        }
        let inverses = &inverse_diagonal.as_chunks::<6>().0[first..first + count];
        for ((inverse, r), u) in inverses.iter().zip(r.as_chunks_mut::<3>().0).zip(u.as_chunks_mut::<3>().0) {
            if inverse[0] == 0.0 {
                *r = [0.0; 3];
            }
            *u = precondition(inverse, *r);
        }
        sum[0] += dot_tile(r, u);
        sum[1] += dot_tile(r, r);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dot_of_two_chunks_by_hand() {
        let (w, u) = ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0], [1.0; 9]);
        let mut sums = [0.0; 2];
        dot(&CpuExecutor::new(1), 2, &w, &u, &mut sums);
        assert_eq!(sums, [21.0, 24.0]);
    }

    #[test]
    fn update_by_hand_and_a_pinned_row_stays_at_rest() {
        let cpu = CpuExecutor::new(1);
        let w = [2.0; 6];
        let inverse = [0.5, 0.0, 0.0, 0.25, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let (mut u, mut p, mut s, mut x, mut r) = ([1.0; 6], [1.0; 6], [0.0; 6], [0.0; 6], [10.0; 6]);
        let mut sums = [[0.0; 2]];
        update(&cpu, 2, 2.0, 3.0, &w, &inverse, &mut u, &mut p, &mut s, &mut x, &mut r, &mut sums);
        assert_eq!(p, [4.0; 6]);
        assert_eq!(s, [2.0; 6]);
        assert_eq!(x, [8.0; 6]);
        assert_eq!(r, [6.0, 6.0, 6.0, 0.0, 0.0, 0.0]);
        assert_eq!(u, [3.0, 1.5, 6.0, 0.0, 0.0, 0.0]);
        assert_eq!(sums, [[63.0, 108.0]]);
    }

    #[test]
    fn threads_do_not_change_a_bit() {
        let n = 5000;
        let value = |i: usize, k: f32| ((i as f32) * k).sin();
        let run = |threads| {
            let cpu = CpuExecutor::new(threads);
            let v = |k: f32| (0..n * 3).map(|i| value(i, k)).collect::<Vec<f32>>();
            let inverse: Vec<f32> = (0..n).flat_map(|i| [1.0 + value(i, 0.3).abs(), 0.1, 0.0, 1.0, 0.2, 2.0]).collect();
            let (w, mut u, mut p, mut s, mut x, mut r) = (v(0.1), v(0.2), v(0.3), v(0.4), v(0.5), v(0.6));
            let mut sums = vec![[0.0; 2]; n.div_ceil(333)];
            update(&cpu, 333, 0.7, 0.2, &w, &inverse, &mut u, &mut p, &mut s, &mut x, &mut r, &mut sums);
            (sums, u, x)
        };
        assert!(run(1) == run(3));
    }
}
