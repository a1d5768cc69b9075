//! CPU twin of `colored.wgsl`.
//!
//! A = L + D + U + R: L and U couple a row with rows of its chunk that have a lower and a higher color, and R holds all
//! other blocks. With D' = D / relaxation, u = (D' + U)^-1 D' (D' + L)^-1 r + z. z is the coarse correction, one vector
//! per chunk, zero on pinned rows.

use super::colored::{BlockTables, ENTRY};
use crate::assembly::sell::{BLOCK, value_index};

/// Copies the blocks of the matrix; padding blocks stay zero.
pub(super) fn take(values: &[f32], sources: &[u32], blocks: &mut [f32]) {
    for (&source, block) in sources.iter().zip(blocks.as_chunks_mut::<BLOCK>().0) {
        if source != super::colored::PADDING {
            *block = std::array::from_fn(|c| values[value_index(source, c)]);
        }
    }
}

/// Two sums of the blocks of rows that are not pinned (`flags` of local rows: zero where pinned), nine values each per
/// entry. The first one is over columns that are not pinned; with `difference`, without the blocks off the diagonal
/// inside the chunk, which cancel each other. The second one is over pinned columns.
pub(super) fn entry_sums(
    blocks: &[f32],
    block_rows: &[u32],
    tables: &BlockTables<'_>,
    entry_ends: &[[u32; 2]],
    flags: &[f32],
    difference: bool,
    entries: &mut [f32],
) {
    let free = |row: usize| flags[row * 3] != 0.0;
    for (&[start, end], entry) in entry_ends.iter().zip(entries.as_chunks_mut::<ENTRY>().0) {
        *entry = [0.0; ENTRY];
        for k in start as usize..end as usize {
            let (row, column) = (block_rows[k] as usize, tables.block_columns[k] as usize);
            if !free(tables.own_start + row) {
                continue;
            }
            let own = column.wrapping_sub(tables.own_start);
            let inside = own < tables.rows && own / tables.chunk_rows == row / tables.chunk_rows;
            let to = match free(column) {
                false => BLOCK,
                true if !difference || !inside || own == row => 0,
                true => continue,
            };
            entry[to..].iter_mut().zip(&blocks[k * BLOCK..(k + 1) * BLOCK]).for_each(|(sum, v)| *sum += v);
        }
    }
}

/// Computes u by the formula of the file header; sums[chunk] = (r . u, r . r, ..). `u`: a local vector.
pub(super) fn sweep(
    blocks: &[f32],
    tables: &BlockTables<'_>,
    inverse_diagonal: &[f32],
    correction: &[f32],
    r: &[f32],
    u: &mut [f32],
    sums: &mut [f32],
) {
    let inverses = inverse_diagonal.as_chunks::<6>().0;
    let first = tables.own_start * 3;
    for (chunk, sums) in sums.as_chunks_mut::<6>().0.iter_mut().enumerate() {
        let rows = chunk * tables.chunk_rows..((chunk + 1) * tables.chunk_rows).min(tables.rows);
        for i in rows.clone() {
            let (row, [start, above, _]) = (tables.order[i] as usize, tables.spans[i]);
            let product = row_product(blocks, tables, start + 1..above, u);
            let rest = std::array::from_fn(|c| r[row * 3 + c] - product[c]);
            u[first + row * 3..][..3].copy_from_slice(&relaxed(tables.relaxation, &inverses[row], rest));
        }
        for i in rows.clone().rev() {
            let (row, [_, above, end]) = (tables.order[i] as usize, tables.spans[i]);
            let product = row_product(blocks, tables, above..end, u);
            let change = relaxed(tables.relaxation, &inverses[row], product);
            u[first + row * 3..][..3].iter_mut().zip(change).for_each(|(u, change)| *u -= change);
        }
        let (mut ru, mut rr) = (0.0f64, 0.0f64);
        for row in rows {
            for c in 0..3 {
                let (r, u) = (r[row * 3 + c], &mut u[first + row * 3 + c]);
                if inverses[row][0] != 0.0 {
                    *u += correction[chunk * 3 + c];
                }
                ru += r as f64 * *u as f64;
                rr += r as f64 * r as f64;
            }
        }
        (sums[0], sums[1]) = (ru as f32, rr as f32);
    }
}

/// w = 0 on pinned rows; sums[chunk] = (.., .., w . u, sums of x, y, z of w). `u`: a local vector.
pub(super) fn product_sums(
    tables: &BlockTables<'_>,
    inverse_diagonal: &[f32],
    w: &mut [f32],
    u: &[f32],
    sums: &mut [f32],
) {
    let own = &u[tables.own_start * 3..];
    for (chunk, sums) in sums.as_chunks_mut::<6>().0.iter_mut().enumerate() {
        let rows = chunk * tables.chunk_rows..((chunk + 1) * tables.chunk_rows).min(tables.rows);
        let (mut wu, mut sum) = (0.0f64, [0.0f64; 3]);
        for row in rows {
            for c in 0..3 {
                let w = &mut w[row * 3 + c];
                if inverse_diagonal[row * 6] == 0.0 {
                    *w = 0.0;
                }
                wu += *w as f64 * own[row * 3 + c] as f64;
                sum[c] += *w as f64;
            }
        }
        sums[2] = wu as f32;
        sums[3..].iter_mut().zip(sum).for_each(|(to, sum)| *to = sum as f32);
    }
}

/// Sum of block * u over blocks `range` of a row.
fn row_product(blocks: &[f32], tables: &BlockTables<'_>, range: std::ops::Range<u32>, u: &[f32]) -> [f32; 3] {
    let mut sum = [0.0f32; 3];
    for k in range.start as usize..range.end as usize {
        let (x, block) = (&u[tables.block_columns[k] as usize * 3..][..3], &blocks[k * BLOCK..][..BLOCK]);
        for c in 0..3 {
            sum[c] += block[c * 3] * x[0] + block[c * 3 + 1] * x[1] + block[c * 3 + 2] * x[2];
        }
    }
    sum
}

/// relaxation * inverse * v.
fn relaxed(relaxation: f32, inverse: &[f32; 6], v: [f32; 3]) -> [f32; 3] {
    let [xx, xy, xz, yy, yz, zz] = *inverse;
    [
        relaxation * (xx * v[0] + xy * v[1] + xz * v[2]),
        relaxation * (xy * v[0] + yy * v[1] + yz * v[2]),
        relaxation * (xz * v[0] + yz * v[1] + zz * v[2]),
    ]
}
