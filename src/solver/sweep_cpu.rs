//! One symmetric block Gauss-Seidel sweep inside every chunk of rows, fused with the vector updates before it and the
//! product with the chunk's own blocks after it.
//!
//! With A = L + D + U + R, where L and U hold the blocks inside chunks and R all others, and D' = D / RELAXATION: v =
//! (D' + U)^-1 D' (D' + L)^-1 r, u = SCALE v + z (z: the coarse correction, one vector per chunk), w = (L + D + U) u. A
//! is symmetric, so only U is stored: each row adds the products with its transposed blocks to the rows below it. A
//! chunk's blocks (about 260 bytes per row) are read from memory once and from the second-level cache twice.
//!
//! In difference form (`SellMatrix::difference`) D holds what acts on absolute velocity, and a block couples with
//! u_j - u_i in w. The solves with D' + L and D' + U take the inverses of the whole diagonal blocks in either form.

use std::ops::Range;

use super::vector_cpu::{Shared, dot_tile};
use crate::gpu::CpuExecutor;

/// Over-relaxation of the sweep [Young 1954]; measured in docs/performance.md.
pub(super) const RELAXATION: f32 = 1.5;
/// Factor on the sweep's result in the sum with the coarse correction.
pub(super) const SCALE: f32 = 1.0;
/// Rows that are summed in f32 before the sum goes to f64.
const TILE: usize = 64;
/// Floats of a cache line.
const LINE: usize = 16;

/// The blocks inside chunks, in the order of the own rows.
#[derive(Clone, Copy)]
pub(super) struct Blocks<'a> {
    /// Rows per chunk.
    pub chunk_rows: usize,
    /// The form of the product w.
    pub difference: bool,
    /// Start of each row's blocks above the diagonal; one more than rows.
    pub upper_offsets: &'a [u32],
    /// Column of each block, counted from the chunk's first row, ascending in a row.
    pub upper_columns: &'a [u16],
    /// Nine values per block, row-major, and three more floats at the end.
    pub upper: &'a [f32],
    /// Diagonal blocks: xx, xy, xz, yy, yz, zz.
    pub diagonal: &'a [f32],
    /// Inverses of the diagonal blocks; zero marks a pinned row.
    pub inverse_diagonal: &'a [f32],
}

impl<'a> Blocks<'a> {
    /// Columns of a row's blocks above the diagonal. Their values and at least three more floats, so that 4-wide loads
    /// stay in bounds.
    #[inline(always)]
    fn above(&self, row: usize) -> (&'a [u16], &'a [f32]) {
        let range = self.upper_offsets[row] as usize..self.upper_offsets[row + 1] as usize;
        (&self.upper_columns[range.clone()], &self.upper[range.start * 9..range.end * 9 + 3])
    }
}

/// Prefetch of the chunk after the current one. The backward pass through a chunk finds its blocks in the cache.
/// Meanwhile memory loads the data that the next chunk reads first.
struct Ahead {
    rows: Range<usize>,
    vectors: [Shared; 6],
}

impl Ahead {
    /// Prefetches the data that row number `i` of the chunk reads.
    #[inline(always)]
    fn fetch(&self, blocks: &Blocks, i: usize) {
        let row = self.rows.start + i;
        if row >= self.rows.end {
            return;
        }
        let (_, values) = blocks.above(row);
        values.chunks(LINE).for_each(|line| fetch(line.as_ptr()));
        fetch(blocks.upper_columns[blocks.upper_offsets[row] as usize..].as_ptr());
        fetch(blocks.diagonal[row * 6..].as_ptr());
        fetch(blocks.inverse_diagonal[row * 6..].as_ptr());
        if i.is_multiple_of(LINE / 3) {
            self.vectors.iter().for_each(|vector| fetch(vector.at(row * 3)));
        }
    }
}

/// Prefetches the cache line of `at`. The result does not depend on it.
#[inline(always)]
fn fetch<T>(at: *const T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a prefetch of any address is allowed.
    unsafe {
        std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T1 }>(at.cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = at;
}

/// Working vectors of a chunk.
#[derive(Default)]
struct Scratch {
    /// Residual, then (D' + L)^-1 r.
    y: Vec<[f32; 4]>,
    /// v and u of each row, each padded with a zero.
    vu: Vec<[f32; 8]>,
    w: Vec<[f32; 4]>,
}

/// `update` = (alpha, beta): first p = u + beta p, s = w + beta s, x += alpha p, r -= alpha s (0 on pinned rows). Then
/// u and w from r by the formulas of the file header; sums[chunk] = (r . u, r . r). `coarse`: three values per chunk.
/// Bytes per row of a cloth: about 310 of blocks, 120 of vectors read, 72 written.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn sweep(
    cpu: &CpuExecutor,
    blocks: &Blocks,
    update: Option<(f32, f32)>,
    coarse: &[f32],
    w: &mut [f32],
    u: &mut [f32],
    p: &mut [f32],
    s: &mut [f32],
    x: &mut [f32],
    r: &mut [f32],
    sums: &mut [[f64; 2]],
) {
    let rows = r.len() / 3;
    assert!([w.len(), u.len(), p.len(), s.len(), x.len()].iter().all(|&n| n == rows * 3));
    assert!(blocks.upper_offsets.len() == rows + 1 && coarse.len() == sums.len() * 3);
    assert!(blocks.diagonal.len() == rows * 6 && blocks.inverse_diagonal.len() == rows * 6);
    let vectors = [w, u, p, s, x, r].map(|v| Shared(v.as_mut_ptr()));
    let rows_of = |chunk: usize| (chunk * blocks.chunk_rows).min(rows)..((chunk + 1) * blocks.chunk_rows).min(rows);
    cpu.for_ranges_mut(sums, 1, 1, |range, sums| {
        let mut scratch = Scratch::default();
        for (chunk, sum) in range.clone().zip(sums) {
            let rows = rows_of(chunk);
            let next = if chunk + 1 < range.end { rows_of(chunk + 1) } else { 0..0 };
            let ahead = Ahead { rows: next, vectors };
            // SAFETY: chunks are disjoint and within the vectors.
            let parts = vectors.map(|v| unsafe { v.part(rows.start * 3, rows.len() * 3) });
            let correction = [coarse[chunk * 3], coarse[chunk * 3 + 1], coarse[chunk * 3 + 2]];
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: the feature is there.
                *sum = unsafe { sweep_avx2(blocks, rows, update, correction, parts, &ahead, &mut scratch) };
                continue;
            }
            *sum = match blocks.difference {
                false => sweep_chunk::<Plain, false>(blocks, rows, update, correction, parts, &ahead, &mut scratch),
                true => sweep_chunk::<Plain, true>(blocks, rows, update, correction, parts, &ahead, &mut scratch),
            };
        }
    });
}

/// As [`sweep_chunk`]: the same additions and products in the same order, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn sweep_avx2(
    blocks: &Blocks,
    rows: Range<usize>,
    update: Option<(f32, f32)>,
    correction: [f32; 3],
    parts: [&mut [f32]; 6],
    ahead: &Ahead,
    scratch: &mut Scratch,
) -> [f64; 2] {
    match blocks.difference {
        false => sweep_chunk::<avx2::Vectors, false>(blocks, rows, update, correction, parts, ahead, scratch),
        true => sweep_chunk::<avx2::Vectors, true>(blocks, rows, update, correction, parts, ahead, scratch),
    }
}

/// Operations of a row on its blocks above the diagonal.
trait RowKernel {
    /// to[column] += sign * block' * v for every block of the row.
    fn scatter(columns: &[u16], values: &[f32], sign: f32, v: [f32; 3], to: &mut [[f32; 4]]);
    /// Sums of block * v and block * u over the blocks of the row: three values each, padded to four.
    fn gather(columns: &[u16], values: &[f32], vu: &[[f32; 8]]) -> [f32; 8];
    /// Sum of block * v over the blocks of the row, padded to four.
    fn gather_v(columns: &[u16], values: &[f32], vu: &[[f32; 8]]) -> [f32; 4];
    /// With d = u[column] - u of the row, for every block of the row: to[column] -= block' * d. Returns the sum of
    /// block * d, padded to four.
    fn couple(columns: &[u16], values: &[f32], u: [f32; 3], vu: &[[f32; 8]], to: &mut [[f32; 4]]) -> [f32; 4];
}

/// Scalar variant, for processors without wide vectors.
struct Plain;

impl RowKernel for Plain {
    #[inline(always)]
    fn scatter(columns: &[u16], values: &[f32], sign: f32, v: [f32; 3], to: &mut [[f32; 4]]) {
        let v = v.map(|v| v * sign);
        for (&column, block) in columns.iter().zip(values.as_chunks::<9>().0) {
            let to = &mut to[column as usize];
            for l in 0..3 {
                to[l] += block[l] * v[0] + block[3 + l] * v[1] + block[6 + l] * v[2];
            }
        }
    }

    #[inline(always)]
    fn gather(columns: &[u16], values: &[f32], vu: &[[f32; 8]]) -> [f32; 8] {
        let mut sums = [[0.0f32; 8]; 3];
        for (&column, block) in columns.iter().zip(values.as_chunks::<9>().0) {
            let known = &vu[column as usize];
            for (row, sum) in sums.iter_mut().enumerate() {
                for l in 0..3 {
                    sum[l] += block[row * 3 + l] * known[l];
                    sum[4 + l] += block[row * 3 + l] * known[4 + l];
                }
            }
        }
        let [a, b, c] = sums;
        let of = |s: &[f32; 8], h: usize| s[h] + s[h + 1] + s[h + 2];
        [of(&a, 0), of(&b, 0), of(&c, 0), 0.0, of(&a, 4), of(&b, 4), of(&c, 4), 0.0]
    }

    #[inline(always)]
    fn gather_v(columns: &[u16], values: &[f32], vu: &[[f32; 8]]) -> [f32; 4] {
        let mut sums = [[0.0f32; 3]; 3];
        for (&column, block) in columns.iter().zip(values.as_chunks::<9>().0) {
            let known = &vu[column as usize];
            for (row, sum) in sums.iter_mut().enumerate() {
                (0..3).for_each(|l| sum[l] += block[row * 3 + l] * known[l]);
            }
        }
        let [a, b, c] = sums.map(|s| s[0] + s[1] + s[2]);
        [a, b, c, 0.0]
    }

    #[inline(always)]
    fn couple(columns: &[u16], values: &[f32], u: [f32; 3], vu: &[[f32; 8]], to: &mut [[f32; 4]]) -> [f32; 4] {
        let mut sums = [[0.0f32; 3]; 3];
        for (&column, block) in columns.iter().zip(values.as_chunks::<9>().0) {
            let (known, to) = (&vu[column as usize], &mut to[column as usize]);
            let d: [f32; 3] = std::array::from_fn(|l| known[4 + l] - u[l]);
            for (row, sum) in sums.iter_mut().enumerate() {
                (0..3).for_each(|l| sum[l] += block[row * 3 + l] * d[l]);
            }
            for l in 0..3 {
                to[l] -= block[l] * d[0] + block[3 + l] * d[1] + block[6 + l] * d[2];
            }
        }
        let [a, b, c] = sums.map(|s| s[0] + s[1] + s[2]);
        [a, b, c, 0.0]
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;

    use super::RowKernel;

    /// Used only inside functions that require AVX2.
    pub(super) struct Vectors;

    impl RowKernel for Vectors {
        #[inline(always)]
        fn scatter(columns: &[u16], values: &[f32], sign: f32, v: [f32; 3], to: &mut [[f32; 4]]) {
            assert!(values.len() >= columns.len() * 9 + 3);
            // SAFETY: four floats from each row of a block lie within `values`; vectors of the baseline.
            unsafe {
                let [a, b, c] = v.map(|v| _mm_set1_ps(v * sign));
                for (k, &column) in columns.iter().enumerate() {
                    let block = values.as_ptr().add(k * 9);
                    let at = |row: usize| _mm_loadu_ps(block.add(row * 3));
                    let to = to[column as usize].as_mut_ptr();
                    let sum = _mm_add_ps(_mm_mul_ps(at(0), a), _mm_mul_ps(at(1), b));
                    let sum = _mm_add_ps(sum, _mm_mul_ps(at(2), c));
                    _mm_storeu_ps(to, _mm_add_ps(_mm_loadu_ps(to), sum));
                }
            }
        }

        #[inline(always)]
        fn gather(columns: &[u16], values: &[f32], vu: &[[f32; 8]]) -> [f32; 8] {
            assert!(values.len() >= columns.len() * 9 + 3);
            // SAFETY: as above; the caller has AVX2.
            unsafe {
                let mut sums = [_mm256_setzero_ps(); 3];
                for (k, &column) in columns.iter().enumerate() {
                    let known = _mm256_loadu_ps(vu[column as usize].as_ptr());
                    let block = values.as_ptr().add(k * 9);
                    for (row, sum) in sums.iter_mut().enumerate() {
                        // The fourth value is multiplied by zero.
                        let values = _mm_loadu_ps(block.add(row * 3));
                        let values = _mm256_set_m128(values, values);
                        *sum = _mm256_add_ps(*sum, _mm256_mul_ps(values, known));
                    }
                }
                let [a, b, c] = sums;
                let (ab, ab_high) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
                let (cc, cc_high) = (_mm256_unpacklo_ps(c, c), _mm256_unpackhi_ps(c, c));
                let x = _mm256_shuffle_ps::<0b01_00_01_00>(ab, cc);
                let y = _mm256_shuffle_ps::<0b11_10_11_10>(ab, cc);
                let z = _mm256_shuffle_ps::<0b01_00_01_00>(ab_high, cc_high);
                let mut out = [0.0; 8];
                _mm256_storeu_ps(out.as_mut_ptr(), _mm256_add_ps(_mm256_add_ps(x, y), z));
                out
            }
        }

        #[inline(always)]
        fn gather_v(columns: &[u16], values: &[f32], vu: &[[f32; 8]]) -> [f32; 4] {
            assert!(values.len() >= columns.len() * 9 + 3);
            // SAFETY: as in `scatter`.
            unsafe {
                let mut sums = [_mm_setzero_ps(); 3];
                for (k, &column) in columns.iter().enumerate() {
                    let known = _mm_loadu_ps(vu[column as usize].as_ptr());
                    let block = values.as_ptr().add(k * 9);
                    for (row, sum) in sums.iter_mut().enumerate() {
                        // The fourth value is multiplied by zero.
                        *sum = _mm_add_ps(*sum, _mm_mul_ps(_mm_loadu_ps(block.add(row * 3)), known));
                    }
                }
                add_components(sums)
            }
        }

        #[inline(always)]
        fn couple(columns: &[u16], values: &[f32], u: [f32; 3], vu: &[[f32; 8]], to: &mut [[f32; 4]]) -> [f32; 4] {
            assert!(values.len() >= columns.len() * 9 + 3);
            // SAFETY: as in `scatter`.
            unsafe {
                let u = _mm_setr_ps(u[0], u[1], u[2], 0.0);
                let mut sums = [_mm_setzero_ps(); 3];
                for (k, &column) in columns.iter().enumerate() {
                    // The fourth component is zero.
                    let d = _mm_sub_ps(_mm_loadu_ps(vu[column as usize].as_ptr().add(4)), u);
                    let block = values.as_ptr().add(k * 9);
                    let rows = [0, 3, 6].map(|at| _mm_loadu_ps(block.add(at)));
                    for (sum, row) in sums.iter_mut().zip(rows) {
                        *sum = _mm_add_ps(*sum, _mm_mul_ps(row, d));
                    }
                    let [x, y, z] = [
                        _mm_shuffle_ps::<0b00_00_00_00>(d, d),
                        _mm_shuffle_ps::<0b01_01_01_01>(d, d),
                        _mm_shuffle_ps::<0b10_10_10_10>(d, d),
                    ];
                    let [a, b, c] = rows;
                    let sum = _mm_add_ps(_mm_mul_ps(a, x), _mm_mul_ps(b, y));
                    let sum = _mm_add_ps(sum, _mm_mul_ps(c, z));
                    let to = to[column as usize].as_mut_ptr();
                    _mm_storeu_ps(to, _mm_sub_ps(_mm_loadu_ps(to), sum));
                }
                add_components(sums)
            }
        }
    }

    /// Sums of the first three components of each vector, and a zero.
    #[inline(always)]
    fn add_components(sums: [__m128; 3]) -> [f32; 4] {
        // SAFETY: arrays of four floats.
        let [a, b, c]: [[f32; 4]; 3] = unsafe { std::mem::transmute(sums) };
        let of = |s: [f32; 4]| s[0] + s[1] + s[2];
        [of(a), of(b), of(c), 0.0]
    }
}

#[inline(always)]
fn sweep_chunk<K: RowKernel, const DIFFERENCE: bool>(
    blocks: &Blocks,
    rows: Range<usize>,
    update: Option<(f32, f32)>,
    correction: [f32; 3],
    [w, u, p, s, x, r]: [&mut [f32]; 6],
    ahead: &Ahead,
    scratch: &mut Scratch,
) -> [f64; 2] {
    let inverses = &blocks.inverse_diagonal.as_chunks::<6>().0[rows.clone()];
    if let Some((alpha, beta)) = update {
        for i in 0..r.len() {
            p[i] = u[i] + beta * p[i];
            s[i] = w[i] + beta * s[i];
            x[i] += alpha * p[i];
            r[i] -= alpha * s[i];
        }
        for (inverse, r) in inverses.iter().zip(r.as_chunks_mut::<3>().0) {
            if inverse[0] == 0.0 {
                *r = [0.0; 3];
            }
        }
    }
    scratch.y.clear();
    scratch.y.extend(r.as_chunks::<3>().0.iter().map(|&[x, y, z]| [x, y, z, 0.0]));
    forward::<K>(blocks, rows.clone(), inverses, &mut scratch.y);
    scratch.vu.clear();
    scratch.vu.resize(rows.len(), [0.0; 8]);
    scratch.w.clear();
    scratch.w.resize(rows.len(), [0.0; 4]);
    backward::<K, DIFFERENCE>(blocks, rows, inverses, correction, ahead, scratch);
    for ((w, u), (new_w, new_vu)) in
        w.as_chunks_mut::<3>().0.iter_mut().zip(u.as_chunks_mut::<3>().0).zip(scratch.w.iter().zip(&scratch.vu))
    {
        *w = [new_w[0], new_w[1], new_w[2]];
        *u = [new_vu[4], new_vu[5], new_vu[6]];
    }
    let mut sum = [0.0; 2];
    for (r, u) in r.chunks(TILE * 3).zip(u.chunks(TILE * 3)) {
        sum[0] += dot_tile(r, u);
        sum[1] += dot_tile(r, r);
    }
    sum
}

/// y = (D' + L)^-1 y.
#[inline(always)]
fn forward<K: RowKernel>(blocks: &Blocks, rows: Range<usize>, inverses: &[[f32; 6]], y: &mut [[f32; 4]]) {
    for (i, row) in rows.enumerate() {
        let [a, b, c] = relaxed(&inverses[i], &y[i]);
        y[i] = [a, b, c, 0.0];
        let (columns, values) = blocks.above(row);
        K::scatter(columns, values, -1.0, [a, b, c], y);
    }
}

/// Computes v, u and w of every row, from the last to the first.
#[inline(always)]
fn backward<K: RowKernel, const DIFFERENCE: bool>(
    blocks: &Blocks,
    rows: Range<usize>,
    inverses: &[[f32; 6]],
    correction: [f32; 3],
    ahead: &Ahead,
    scratch: &mut Scratch,
) {
    let Scratch { y, vu, w } = scratch;
    let last = rows.len().saturating_sub(1);
    for (i, row) in rows.enumerate().rev() {
        ahead.fetch(blocks, last - i);
        let (columns, values) = blocks.above(row);
        let sums = match DIFFERENCE {
            false => K::gather(columns, values, vu),
            true => {
                let [x, y, z, _] = K::gather_v(columns, values, vu);
                [x, y, z, 0.0, 0.0, 0.0, 0.0, 0.0]
            }
        };
        let change = relaxed(&inverses[i], &[sums[0], sums[1], sums[2], 0.0]);
        let mut out = [0.0f32; 8];
        if inverses[i][0] != 0.0 {
            for c in 0..3 {
                out[c] = y[i][c] - change[c];
                out[4 + c] = SCALE * out[c] + correction[c];
            }
        }
        vu[i] = out;
        let (a, b, c) = (out[4], out[5], out[6]);
        let own = times(&blocks.diagonal.as_chunks::<6>().0[row], &[a, b, c, 0.0]);
        if DIFFERENCE {
            let coupled = K::couple(columns, values, [a, b, c], vu, w);
            for c in 0..3 {
                w[i][c] += coupled[c] + own[c];
            }
            continue;
        }
        for c in 0..3 {
            w[i][c] += sums[4 + c] + own[c];
        }
        K::scatter(columns, values, 1.0, [a, b, c], w);
    }
}

/// RELAXATION * inverse * v.
#[inline(always)]
fn relaxed(inverse: &[f32; 6], v: &[f32; 4]) -> [f32; 3] {
    times(inverse, v).map(|v| v * RELAXATION)
}

#[inline(always)]
fn times(block: &[f32; 6], v: &[f32; 4]) -> [f32; 3] {
    let [xx, xy, xz, yy, yz, zz] = *block;
    [xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2], xz * v[0] + yz * v[1] + zz * v[2]]
}

/// After the product with R was added to w: w = 0 on the `pinned` rows (ascending), sums[chunk] = (w . u, sums of x, y,
/// z of w). Bytes per row: 24.
pub(super) fn product_sums(
    cpu: &CpuExecutor,
    chunk_rows: usize,
    pinned: &[u32],
    w: &mut [f32],
    u: &[f32],
    sums: &mut [[f64; 4]],
) {
    let rows = w.len() / 3;
    let shared = Shared(w.as_mut_ptr());
    cpu.for_ranges_mut(sums, 1, 1, |range, sums| {
        for (chunk, sum) in range.zip(sums) {
            let rows = chunk * chunk_rows..((chunk + 1) * chunk_rows).min(rows);
            // SAFETY: chunks are disjoint and within the vector.
            let w = unsafe { shared.part(rows.start * 3, rows.len() * 3) };
            let from = pinned.partition_point(|&row| (row as usize) < rows.start);
            for &row in pinned[from..].iter().take_while(|&&row| (row as usize) < rows.end) {
                w[(row as usize - rows.start) * 3..][..3].fill(0.0);
            }
            *sum = [0.0; 4];
            for (w, u) in w.chunks(TILE * 3).zip(u[rows.start * 3..rows.end * 3].chunks(TILE * 3)) {
                // In f64: internal forces cancel in these sums.
                for w in w.as_chunks::<3>().0 {
                    for c in 0..3 {
                        sum[1 + c] += f64::from(w[c]);
                    }
                }
                sum[0] += dot_tile(w, u);
            }
        }
    });
}
