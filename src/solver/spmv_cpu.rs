//! CPU twin of `spmv.wgsl`. Every row adds its blocks in stored (ascending column) order, starting from +0, so padding
//! (zero values) and the lane of a row never change its bits. Fused multiply-add is not used, because some machines
//! lack it and results must not differ between machines.
//!
//! In difference form (`Own` is given) a block off the diagonal multiplies x_j - x_i. An equal displacement of all rows
//! then gives exactly the product of the stored diagonal blocks, however large the other blocks are.

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
    own: Option<Own<'a>>,
}

/// The rows' own values, for products in difference form.
#[derive(Clone, Copy)]
pub(super) struct Own<'a> {
    /// xyz per row of y.
    pub x: &'a [f32],
    /// Column of row 0; row i has its diagonal block in column `diagonal` + i.
    pub diagonal: u32,
}

/// y = A x (or y += A x with `accumulate`) for the rows in `slices`. Bytes: 40 per slot, 12 per row written, and the
/// entries of x once if they stay in cache.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn spmv(
    cpu: &CpuExecutor,
    slices: Range<u32>,
    accumulate: bool,
    row_of_lane: &[u32],
    slice_offsets: &[u32],
    columns: &[u32],
    values: &[f32],
    x: &[f32],
    own: Option<Own<'_>>,
    y: &mut [f32],
) {
    assert!(own.is_none_or(|own| own.x.len() >= y.len()));
    // The gathers below are unchecked in release builds. With debug assertions this finds a column beyond the end of x,
    // which would be an error of the layout.
    debug_assert!(columns.iter().all(|&c| (c as usize + 1) * 3 <= x.len() || slices.is_empty()));
    let tables = Tables { row_of_lane, slice_offsets, columns, values, x, own };
    let rows = Rows(y.as_mut_ptr(), y.len());
    let first = slices.start as usize;
    cpu.for_ranges(slices.len(), 4, |range| {
        let slices = first + range.start..first + range.end;
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the feature is there; the layout's columns and rows are within x and y.
            unsafe {
                match own {
                    None => avx2::multiply::<false>(slices, accumulate, &tables, rows),
                    Some(_) => avx2::multiply::<true>(slices, accumulate, &tables, rows),
                }
            }
            return;
        }
        multiply(slices, accumulate, &tables, rows);
    });
}

/// As [`multiply`] with explicit vectors: the same additions and products in the same order, so the same bits.
#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;
    use std::ops::Range;

    use super::{BLOCK, LANES, NO_ROW, Rows, Tables};

    /// Floats of a SIMD vector; a slice is two vectors.
    const WIDTH: usize = 8;

    /// # Safety
    /// The processor has AVX2. Columns of the slices are within x. Rows are within y, and no other thread works on
    /// them.
    #[target_feature(enable = "avx2")]
    pub(super) unsafe fn multiply<const DIFFERENCE: bool>(
        slices: Range<usize>,
        accumulate: bool,
        tables: &Tables,
        y: Rows,
    ) {
        // A gather reads four floats per column; for the last column the fourth would lie beyond the end of x.
        let last = (tables.x.len() / 3).saturating_sub(1) as u32;
        for slice in slices {
            let slots = tables.slice_offsets[slice] as usize..tables.slice_offsets[slice + 1] as usize;
            let lanes = tables.row_of_lane[slice * LANES..].first_chunk::<LANES>();
            let Some(lanes) = lanes else { return };
            let mut start = [[0.0f32; LANES]; 3];
            if accumulate {
                for (lane, &row) in lanes.iter().enumerate().filter(|(_, row)| **row != NO_ROW) {
                    for i in 0..3 {
                        // SAFETY: contract.
                        start[i][lane] = unsafe { *y.0.add(row as usize * 3 + i) };
                    }
                }
            }
            let columns = tables.columns[slots.start * LANES..slots.end * LANES].as_chunks::<LANES>().0;
            let values = tables.values[slots.start * LANES * BLOCK..slots.end * LANES * BLOCK]
                .as_chunks::<{ LANES * BLOCK }>()
                .0;
            let own = if DIFFERENCE { own_values(lanes, tables) } else { ([[0.0; LANES]; 3], [0; LANES]) };
            // SAFETY: contract.
            let sum = unsafe { slice_product::<DIFFERENCE>(columns, values, tables.x, last, &own, &start) };
            for (lane, &row) in lanes.iter().enumerate().filter(|(_, row)| **row != NO_ROW) {
                debug_assert!((row as usize * 3 + 2) < y.1);
                for i in 0..3 {
                    // SAFETY: contract.
                    unsafe { *y.0.add(row as usize * 3 + i) = sum[i][lane] };
                }
            }
        }
    }

    /// x of the rows of a slice, and the columns of their diagonal blocks.
    #[inline]
    fn own_values(lanes: &[u32; LANES], tables: &Tables) -> ([[f32; LANES]; 3], [u32; LANES]) {
        let (mut x, mut columns) = ([[0.0f32; LANES]; 3], [NO_ROW; LANES]);
        let Some(own) = tables.own else { return (x, columns) };
        for (lane, &row) in lanes.iter().enumerate().filter(|(_, row)| **row != NO_ROW) {
            let of_row = &own.x[row as usize * 3..][..3];
            for i in 0..3 {
                x[i][lane] = of_row[i];
            }
            columns[lane] = own.diagonal.wrapping_add(row);
        }
        (x, columns)
    }

    /// Adds the slots of one slice to `start`. `own`: x and diagonal column of every lane.
    ///
    /// # Safety
    /// AVX2; columns are within x, whose last column is `last`.
    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn slice_product<const DIFFERENCE: bool>(
        columns: &[[u32; LANES]],
        values: &[[f32; LANES * BLOCK]],
        x: &[f32],
        last: u32,
        own: &([[f32; LANES]; 3], [u32; LANES]),
        start: &[[f32; LANES]; 3],
    ) -> [[f32; LANES]; 3] {
        // SAFETY: loads and stores of LANES floats each; contract for the gathers.
        unsafe {
            let half = |i: usize, h: usize| _mm256_loadu_ps(start[i].as_ptr().add(h * WIDTH));
            let mut sum = [[half(0, 0), half(0, 1)], [half(1, 0), half(1, 1)], [half(2, 0), half(2, 1)]];
            let last_columns = _mm256_set1_epi32(last as i32);
            let own_half = |i: usize, h: usize| _mm256_loadu_ps(own.0[i].as_ptr().add(h * WIDTH));
            let own_x = [0, 1].map(|h| [own_half(0, h), own_half(1, h), own_half(2, h)]);
            let diagonal = [0, 1].map(|h| _mm256_loadu_si256(own.1.as_ptr().add(h * WIDTH).cast()));
            for (columns, values) in columns.iter().zip(values) {
                let values = values.as_ptr();
                for h in 0..2 {
                    let columns = columns.as_ptr().add(h * WIDTH);
                    let ends = _mm256_cmpeq_epi32(_mm256_loadu_si256(columns.cast()), last_columns);
                    let mut x = if _mm256_testz_si256(ends, ends) != 0 {
                        gather(columns, x.as_ptr())
                    } else {
                        gather_last(columns, x.as_ptr())
                    };
                    if DIFFERENCE {
                        let own_column = _mm256_cmpeq_epi32(_mm256_loadu_si256(columns.cast()), diagonal[h]);
                        let own_column = _mm256_castsi256_ps(own_column);
                        for j in 0..3 {
                            x[j] = _mm256_sub_ps(x[j], _mm256_andnot_ps(own_column, own_x[h][j]));
                        }
                    }
                    for i in 0..3 {
                        for j in 0..3 {
                            let a = _mm256_loadu_ps(values.add((i * 3 + j) * LANES + h * WIDTH));
                            sum[i][h] = _mm256_add_ps(sum[i][h], _mm256_mul_ps(a, x[j]));
                        }
                    }
                }
            }
            let mut out = [[0.0f32; LANES]; 3];
            for i in 0..3 {
                for h in 0..2 {
                    _mm256_storeu_ps(out[i].as_mut_ptr().add(h * WIDTH), sum[i][h]);
                }
            }
            out
        }
    }

    /// xyz of eight columns, one vector per component: eight loads of four floats and a transpose.
    ///
    /// # Safety
    /// AVX2; eight columns, four floats from each of them are within x.
    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn gather(columns: *const u32, x: *const f32) -> [__m256; 3] {
        // SAFETY: contract.
        unsafe {
            // Volatile reads keep the index arithmetic scalar. Otherwise the compiler does it in vector registers, and
            // each extraction of an index costs time.
            let load = |lane: usize| _mm_loadu_ps(x.add(columns.add(lane).read_volatile() as usize * 3));
            // Lanes k and k + 4 share a register.
            let pair = |k: usize| _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(load(k)), load(k + 4));
            transpose([pair(0), pair(1), pair(2), pair(3)])
        }
    }

    /// As [`gather`], reading three floats per column.
    ///
    /// # Safety
    /// AVX2; eight columns within x.
    #[target_feature(enable = "avx2")]
    #[cold]
    unsafe fn gather_last(columns: *const u32, x: *const f32) -> [__m256; 3] {
        // SAFETY: contract.
        unsafe {
            let at = |lane: usize, j: usize| *x.add(*columns.add(lane) as usize * 3 + j);
            let component = |j: usize| {
                _mm256_setr_ps(at(0, j), at(1, j), at(2, j), at(3, j), at(4, j), at(5, j), at(6, j), at(7, j))
            };
            [component(0), component(1), component(2)]
        }
    }

    /// First three columns of the 4x4 matrices in the lower and upper halves.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn transpose([a, b, c, d]: [__m256; 4]) -> [__m256; 3] {
        let (ab_xy, cd_xy) = (_mm256_unpacklo_ps(a, b), _mm256_unpacklo_ps(c, d));
        let (ab_zw, cd_zw) = (_mm256_unpackhi_ps(a, b), _mm256_unpackhi_ps(c, d));
        let x = _mm256_shuffle_ps::<0b01_00_01_00>(ab_xy, cd_xy);
        let y = _mm256_shuffle_ps::<0b11_10_11_10>(ab_xy, cd_xy);
        [x, y, _mm256_shuffle_ps::<0b01_00_01_00>(ab_zw, cd_zw)]
    }
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
        let mut own = ([[0.0f32; LANES]; 3], [NO_ROW; LANES]);
        if let Some(Own { x, diagonal }) = tables.own {
            for (lane, &row) in lanes.iter().enumerate().filter(|(_, row)| **row != NO_ROW) {
                for i in 0..3 {
                    own.0[i][lane] = x[row as usize * 3 + i];
                }
                own.1[lane] = diagonal.wrapping_add(row);
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
                    if tables.own.is_some() && columns[lane] != own.1[lane] {
                        x[j][lane] -= own.0[j][lane];
                    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::assembly::SellLayout;
    use crate::assembly::sell::value_index;

    /// Rows of 1 to 9 blocks, some of which reach the last column, on 77 own rows of 90.
    fn system() -> (SellLayout, Vec<f32>, Vec<f32>) {
        let (mut offsets, mut columns) = (vec![0u32], Vec::new());
        for row in 0..77u32 {
            let mut of_row: Vec<u32> =
                (0..1 + row % 9).map(|k| (row * 7 + k * k * 11) % 90).chain([row, 89 - row % 2]).collect();
            of_row.sort_unstable();
            of_row.dedup();
            columns.extend(of_row);
            offsets.push(columns.len() as u32);
        }
        let layout = SellLayout::halo(&offsets, &columns, 0..80);
        let mut values = vec![0.0; layout.slots() * BLOCK];
        for (k, &address) in layout.block_address.iter().enumerate() {
            for c in 0..BLOCK {
                values[value_index(address, c)] = ((k * 9 + c) as f32 * 0.731).sin();
            }
        }
        (layout, values, (0..270).map(|i| (i as f32 * 0.317).cos()).collect())
    }

    #[test]
    fn explicit_vectors_give_the_bits_of_the_plain_loops() {
        let (layout, values, x) = system();
        let own = Some(Own { x: &x[21..], diagonal: 7 });
        for (accumulate, own) in [(false, None), (true, None), (false, own), (true, own)] {
            let tables = Tables {
                row_of_lane: &layout.row_of_lane,
                slice_offsets: &layout.slice_offsets,
                columns: &layout.columns,
                values: &values,
                x: &x,
                own,
            };
            let (mut plain, mut chosen) = (vec![0.25f32; 77 * 3], vec![0.25f32; 77 * 3]);
            for section in &layout.sections {
                multiply(
                    section.start as usize..section.end as usize,
                    accumulate,
                    &tables,
                    Rows(plain.as_mut_ptr(), plain.len()),
                );
                spmv(
                    &CpuExecutor::new(2),
                    section.clone(),
                    accumulate,
                    &layout.row_of_lane,
                    &layout.slice_offsets,
                    &layout.columns,
                    &values,
                    &x,
                    own,
                    &mut chosen,
                );
            }
            assert!(plain.iter().map(|v| v.to_bits()).eq(chosen.iter().map(|v| v.to_bits())));
            assert!(plain.iter().all(|&v| v != 0.25));
        }
    }

    #[test]
    fn one_row_by_hand() {
        let layout = SellLayout::halo(&[0, 1], &[0], 0..1);
        let mut values = vec![0.0; layout.slots() * BLOCK];
        (0..BLOCK).for_each(|c| values[value_index(0, c)] = c as f32 + 1.0);
        let mut y = [0.0; 3];
        spmv(
            &CpuExecutor::new(1),
            0..1,
            false,
            &layout.row_of_lane,
            &layout.slice_offsets,
            &layout.columns,
            &values,
            &[1.0, 10.0, 100.0],
            None,
            &mut y,
        );
        assert_eq!(y, [321.0, 654.0, 987.0]);
    }

    /// Three rows with masses on the diagonal and couplings of 1e9 between them.
    #[test]
    fn the_difference_form_keeps_translations_exactly() {
        let layout = SellLayout::halo(&[0, 3, 6, 9], &[0, 1, 2, 0, 1, 2, 0, 1, 2], 0..3);
        let mut values = vec![0.0; layout.slots() * BLOCK];
        for (k, &address) in layout.block_address.iter().enumerate() {
            for c in 0..BLOCK {
                let diagonal = k / 3 == k % 3;
                let mass = if c % 4 == 0 { 0.125 * (1 + k / 3) as f32 } else { 0.0 };
                values[value_index(address, c)] = if diagonal { mass } else { -1e9 / (1 + c) as f32 };
            }
        }
        let product = |x: &[f32]| {
            let mut y = [0.0; 9];
            let [sections, ..] = &layout.sections[..] else { panic!("sections") };
            spmv(
                &CpuExecutor::new(1),
                sections.clone(),
                false,
                &layout.row_of_lane,
                &layout.slice_offsets,
                &layout.columns,
                &values,
                x,
                Some(Own { x, diagonal: 0 }),
                &mut y,
            );
            y
        };
        let t = [0.3f32, -7.0, 1e-3];
        let moved: Vec<f32> = (0..9).map(|i| t[i % 3]).collect();
        let expected: [f32; 9] = std::array::from_fn(|i| 0.125 * (1 + i / 3) as f32 * t[i % 3]);
        assert_eq!(product(&moved), expected);
        // One row alone moves: every other row gets its block times the difference.
        let y = product(&[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(y[3..6], [-1e9, -1e9 / 4.0, -1e9 / 7.0]);
        assert_eq!(y[0], 0.125 + 2e9);
    }
}
