//! CPU twin of `contact_fill.wgsl`: contributions of a row in ascending order of the contacts.

use super::contact_fill::SUMS;
use super::layout::{LANES, NO_ROW};
use super::sell::{BLOCK, value_index};
use crate::forces::CONTACT_RECORD_FLOATS;
use crate::gpu::CpuExecutor;

/// Output values that several threads write at disjoint places.
struct Values(*mut f32, usize);
// SAFETY: the values of a slice belong to the thread that fills the slice.
unsafe impl Sync for Values {}

impl Values {
    /// # Safety
    /// `index` belongs to a slice of the calling thread.
    unsafe fn set(&self, index: usize, value: f32) {
        debug_assert!(index < self.1);
        // SAFETY: see above.
        unsafe { *self.0.add(index) = value };
    }
}

#[inline(always)]
fn record(records: &[f32], entry: u32) -> &[f32; CONTACT_RECORD_FLOATS] {
    &records.as_chunks::<CONTACT_RECORD_FLOATS>().0[(entry >> 2) as usize]
}

/// Diagonal block (xx, xy, xz, yy, yz, zz) and right-hand side (xyz) of every touched row. Bytes per entry: 4 + 48 read.
pub(super) fn contact_sums(cpu: &CpuExecutor, offsets: &[u32], entries: &[u32], records: &[f32], sums: &mut [f32]) {
    cpu.for_ranges_mut(sums, SUMS, 64, |range, sums| {
        for (row, sums) in range.zip(sums.as_chunks_mut::<SUMS>().0) {
            let mut sum = [0.0; SUMS];
            for &entry in &entries[offsets[row] as usize..offsets[row + 1] as usize] {
                let &[w0, w1, w2, w3, nx, ny, nz, alpha, beta, gx, gy, gz] = record(records, entry);
                let w = [w0, w1, w2, w3][(entry & 3) as usize];
                let s = w * w;
                let scale = s * (alpha - beta);
                let (px, py, pz, identity) = (nx * scale, ny * scale, nz * scale, s * beta);
                sum[0] += px * nx + identity;
                sum[1] += px * ny;
                sum[2] += px * nz;
                sum[3] += py * ny + identity;
                sum[4] += py * nz;
                sum[5] += pz * nz + identity;
                sum[6] += w * gx;
                sum[7] += w * gy;
                sum[8] += w * gz;
            }
            *sums = sum;
        }
    });
}

/// Blocks off the diagonal of every lane; padding becomes zero. Blocks (a, b) and (b, a) get the same products in the same
/// order, so the matrix is symmetric bit for bit. Bytes per entry: 12 + 48 read; 36 per block written.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn contact_blocks(
    cpu: &CpuExecutor,
    offsets: &[u32],
    entries: &[u32],
    positions: &[[u16; 4]],
    records: &[f32],
    lanes: &[[u32; 4]],
    slice_offsets: &[u32],
    values: &mut [f32],
) {
    let values = Values(values.as_mut_ptr(), values.len());
    cpu.for_ranges(slice_offsets.len() - 1, 4, |slices| {
        let mut blocks: Vec<[f32; BLOCK]> = Vec::new();
        for slice in slices {
            let start = slice_offsets[slice];
            let width = (slice_offsets[slice + 1] - start) as usize;
            for lane in 0..LANES {
                let [row, _, first, length] = lanes[slice * LANES + lane];
                blocks.clear();
                blocks.resize(width, [0.0; BLOCK]);
                if row != NO_ROW {
                    let list = offsets[row as usize] as usize..offsets[row as usize + 1] as usize;
                    for (&entry, positions) in entries[list.clone()].iter().zip(&positions[list]) {
                        add(record(records, entry), entry & 3, positions, first, &mut blocks[..length as usize]);
                    }
                }
                for (k, block) in blocks.iter().enumerate() {
                    let at = value_index((start + k as u32) * LANES as u32 + lane as u32, 0);
                    for (c, &value) in block.iter().enumerate() {
                        // SAFETY: slots of this slice.
                        unsafe { values.set(at + c * LANES, value) };
                    }
                }
            }
        }
    });
}

#[inline(always)]
fn add(record: &[f32; CONTACT_RECORD_FLOATS], own: u32, positions: &[u16; 4], first: u32, blocks: &mut [[f32; BLOCK]]) {
    let &[_, _, _, _, nx, ny, nz, alpha, beta, ..] = record;
    for (corner, &position) in positions.iter().enumerate() {
        // Corners without a column and those of other sub-vectors are past the end.
        let Some(block) = blocks.get_mut(u32::from(position).wrapping_sub(first) as usize) else { continue };
        let s = record[own as usize] * record[corner];
        let scale = s * (alpha - beta);
        let (px, py, pz, identity) = (nx * scale, ny * scale, nz * scale, s * beta);
        let (xy, xz, yz) = (px * ny, px * nz, py * nz);
        let added = [px * nx, xy, xz, xy, py * ny, yz, xz, yz, pz * nz];
        block.iter_mut().zip(added).for_each(|(to, value)| *to += value);
        block[0] += identity;
        block[4] += identity;
        block[8] += identity;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two vertices, normal x, alpha 4, beta 1, weights 1 and -1; g = (8, 0, 2).
    const RECORD: [f32; CONTACT_RECORD_FLOATS] = [1.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 4.0, 1.0, 8.0, 0.0, 2.0];

    #[test]
    fn sums_of_two_rows_by_hand() {
        let mut sums = [9.0; 2 * SUMS];
        // The second row gathers the same contact twice, as if there were two.
        let records = [RECORD, RECORD].concat();
        contact_sums(&CpuExecutor::new(1), &[0, 1, 3], &[0, 1, 4 | 1], &records, &mut sums);
        assert_eq!(sums[..SUMS], [4.0, 0.0, 0.0, 1.0, 0.0, 1.0, 8.0, 0.0, 2.0]);
        assert_eq!(sums[SUMS..], [8.0, 0.0, 0.0, 2.0, 0.0, 2.0, -16.0, 0.0, -4.0]);
    }

    #[test]
    fn a_block_by_hand_and_zeros_elsewhere() {
        let mut values = vec![7.0; 2 * LANES * BLOCK];
        let mut lanes = [[NO_ROW, 0, 0, 0]; LANES];
        // A row with one column in a slice two slots wide.
        lanes[3] = [0, 0, 0, 1];
        contact_blocks(
            &CpuExecutor::new(1),
            &[0, 1],
            &[0],
            &[[u16::MAX, 0, u16::MAX, u16::MAX]],
            &RECORD,
            &lanes,
            &[0, 2],
            &mut values,
        );
        for (i, expected) in [-4.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0].into_iter().enumerate() {
            assert_eq!(values[value_index(3, i)], expected);
            values[value_index(3, i)] = 0.0;
        }
        assert!(values.iter().all(|&v| v == 0.0));
    }
}
