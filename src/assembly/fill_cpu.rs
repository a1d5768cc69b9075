//! CPU twin of `fill.wgsl`: one row at a time, contributions in ascending element order, triangles before hinges.
//!
//! The matrix is stored in difference form (`SellMatrix::difference`): the blocks of an internal element sum to zero
//! over its corners, so their part of the diagonal block is minus the sum of the other blocks of the row and is not
//! stored.
//! Mass, air drag and contacts act on absolute velocity and remain. In f32 a whole diagonal block loses the mass where
//! stiffness dt^2 / mass passes 1e5.

use super::contact_fill::SUMS;
use super::contact_rows::NO_SLOT;
use super::fill::FillParams;
use super::sell::{BLOCK, value_index};
use crate::forces::fiber::TautFibers;
use crate::forces::{HINGE_RECORD_FLOATS, TRIANGLE_RECORD_FLOATS, TriangleElement};
use crate::gpu::CpuExecutor;
use crate::math::{Mat3, Vec3, Vec4};

/// Inputs of the fill, in the order of the shader's bindings.
pub(crate) struct FillInputs<'a> {
    pub row_offsets: &'a [u32],
    pub block_address: &'a [u32],
    pub triangle_offsets: &'a [u32],
    pub triangle_entries: &'a [u32],
    pub triangle_positions: &'a [[u16; 4]],
    pub hinge_offsets: &'a [u32],
    pub hinge_entries: &'a [u32],
    pub hinge_positions: &'a [[u16; 4]],
    pub elements: &'a [TriangleElement],
    pub triangle_records: &'a [f32],
    pub hinge_records: &'a [f32],
    pub fibers: &'a TautFibers,
    pub masses: &'a [f32],
    /// Negative for a prescribed row, else dt^2 k of its spring, kg.
    pub pinned: &'a [f32],
    /// Per own row its number among the rows with contacts; empty without contacts.
    pub contact_slots: &'a [u32],
    pub contact_sums: &'a [f32],
}

/// A block while contributions are added to it: its rows, of which the fourth entry is not used, so that a row is one
/// vector register. Every entry is summed up on its own, in the order of the shader.
#[derive(Clone, Copy, Default)]
pub(crate) struct BlockRows([Vec4; 3]);

impl BlockRows {
    /// Its entries, row by row.
    #[inline(always)]
    pub(crate) fn entries(&self) -> [f32; BLOCK] {
        let [a, b, c] = self.0;
        [a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z]
    }

    /// Adds a multiple of the identity.
    #[inline(always)]
    pub(crate) fn add_identity(&mut self, factor: f32) {
        self.0[0].x += factor;
        self.0[1].y += factor;
        self.0[2].z += factor;
    }

    /// Adds the symmetric block xx, xy, xz, yy, yz, zz.
    fn add_symmetric(&mut self, [xx, xy, xz, yy, yz, zz]: [f32; 6]) {
        let rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
        self.0.iter_mut().zip(rows).for_each(|(row, [x, y, z])| *row += Vec4::new(x, y, z, 0.0));
    }

    /// Adds left x0' + right x1' + third x2' + identity I.
    #[inline(always)]
    fn add(&mut self, [left, right, third]: [Vec3; 3], [x0, x1, x2]: [Vec3; 3], identity: f32) {
        let (l, m, n) = (left.to_array(), right.to_array(), third.to_array());
        let [p, q, s] = [x0.extend(0.0), x1.extend(0.0), x2.extend(0.0)];
        for i in 0..3 {
            self.0[i] += p * l[i] + q * m[i] + s * n[i];
        }
        self.add_identity(identity);
    }
}

/// Outputs that several threads write at disjoint positions: `values` at the addresses of the own rows' blocks.
struct Values(*mut f32, usize);
// SAFETY: block addresses of different rows are disjoint (`SellLayout` hands every address out once).
unsafe impl Sync for Values {}

impl Values {
    /// # Safety
    /// `index` belongs to a block of the row that this thread fills.
    unsafe fn set(&self, index: usize, value: f32) {
        debug_assert!(index < self.1);
        // SAFETY: see above.
        unsafe { *self.0.add(index) = value };
    }
}

/// Fills the Value Table, the right-hand side dt*f (xyz per row) and the inverted diagonal blocks (xx, xy, xz, yy, yz,
/// zz). A zero inverse marks a pinned row for the solver. Bytes per row of a cloth: about 1.2 KB of records read
/// (neighboring rows share them in cache), 36 per block, 12 and 24 written.
pub(super) fn fill(
    cpu: &CpuExecutor,
    params: &FillParams,
    inputs: &FillInputs,
    values: &mut [f32],
    rhs: &mut [f32],
    inverse_diagonal: &mut [f32],
) {
    let shared = Values(values.as_mut_ptr(), values.len());
    let rhs_shared = Values(rhs.as_mut_ptr(), rhs.len());
    cpu.for_ranges_mut(inverse_diagonal, 6, 64, |range, inverse| {
        let mut blocks: Vec<BlockRows> = Vec::new();
        for (row, inverse) in range.zip(inverse.chunks_exact_mut(6)) {
            let first = inputs.row_offsets[row] as usize;
            let length = inputs.row_offsets[row + 1] as usize - first;
            blocks.clear();
            blocks.resize(length, BlockRows::default());
            let mut absolute = BlockRows::default();
            let mut force = Vec3::from(params.gravity) * inputs.masses[row];
            let mut diagonal = 0;
            for i in inputs.triangle_offsets[row] as usize..inputs.triangle_offsets[row + 1] as usize {
                let (entry, positions) = (inputs.triangle_entries[i], inputs.triangle_positions[i]);
                diagonal = positions[(entry & 3) as usize] as usize;
                add_triangle(inputs, entry, positions, &mut blocks, &mut absolute, &mut force);
            }
            for i in inputs.hinge_offsets[row] as usize..inputs.hinge_offsets[row + 1] as usize {
                add_hinge(inputs, inputs.hinge_entries[i], inputs.hinge_positions[i], &mut blocks, &mut force);
            }
            let mass_and_spring = inputs.masses[row] + inputs.pinned[row].max(0.0);
            blocks[diagonal].add_identity(mass_and_spring);
            absolute.add_identity(mass_and_spring);
            let mut impulse = (force * params.step_s).to_array();
            if let Some(&slot) = inputs.contact_slots.get(row)
                && slot != NO_SLOT
            {
                add_contacts(inputs, slot as usize, [&mut blocks[diagonal], &mut absolute], &mut impulse);
            }
            let whole = std::mem::replace(&mut blocks[diagonal], absolute);
            for (k, block) in blocks.iter().enumerate() {
                for (c, value) in block.entries().into_iter().enumerate() {
                    // SAFETY: addresses of this row's blocks.
                    unsafe { shared.set(value_index(inputs.block_address[first + k], c), value) };
                }
            }
            for (c, value) in impulse.into_iter().enumerate() {
                // SAFETY: the row's own entries.
                unsafe { rhs_shared.set(row * 3 + c, value) };
            }
            inverse.copy_from_slice(&if inputs.pinned[row] < 0.0 {
                [0.0; 6]
            } else {
                inverse_symmetric(&whole.entries())
            });
        }
    });
}

/// Adds the sums of the contacts of row `slot` among the rows with contacts to each of `diagonals`.
pub(crate) fn add_contacts<const N: usize>(
    inputs: &FillInputs,
    slot: usize,
    diagonals: [&mut BlockRows; N],
    impulse: &mut [f32; 3],
) {
    let [xx, xy, xz, yy, yz, zz, x, y, z] = inputs.contact_sums.as_chunks::<SUMS>().0[slot];
    for diagonal in diagonals {
        diagonal.add_symmetric([xx, xy, xz, yy, yz, zz]);
    }
    impulse.iter_mut().zip([x, y, z]).for_each(|(to, value)| *to += value);
}

/// Adds the contribution of one corner of a triangle to its row: blocks at `positions` of the corners, the sum of the
/// blocks that do not sum to zero (air) to `absolute`, and the force.
pub(crate) fn add_triangle(
    inputs: &FillInputs,
    entry: u32,
    positions: [u16; 4],
    blocks: &mut [BlockRows],
    absolute: &mut BlockRows,
    force: &mut Vec3,
) {
    let (e, a) = ((entry >> 2) as usize, (entry & 3) as usize);
    let r = &inputs.triangle_records[e * TRIANGLE_RECORD_FLOATS..][..TRIANGLE_RECORD_FLOATS];
    let weights = inputs.elements[e].corner_weights();
    let (xu, xv) = (Vec3::new(r[0], r[1], r[2]), Vec3::new(r[4], r[5], r[6]));
    let (warp, cross, weft, shear) = (r[3], r[7], r[8], r[9]);
    let (suu, suv, svv) = (r[10], r[11], r[12]);
    let [ua, va] = weights[a];
    *force -= Vec3::new(r[16], r[17], r[18]) * ua + Vec3::new(r[20], r[21], r[22]) * va;
    *force += Vec3::new(r[15], r[19], r[23]);
    let normal = xu.cross(xv);
    let n = normal * (1.0 / normal.length().max(1e-30));
    absolute.add([Vec3::ZERO, Vec3::ZERO, n * (3.0 * (r[13] - r[14]))], [xu, xv, n], 3.0 * r[14]);
    for b in 0..3 {
        let [ub, vb] = weights[b];
        let (uu, uv, vu, vv) = (ua * ub, ua * vb, va * ub, va * vb);
        // sum of: uu (warp xu xu' + shear xv xv') + vv (weft xv xv' + shear xu xu')
        //       + uv (cross xu xv' + shear xv xu') + vu (cross xv xu' + shear xu xv') + (..) I + air
        let left = xu * (uu * warp + vv * shear) + xv * (uv * shear + vu * cross);
        let right = xu * (uv * cross + vu * shear) + xv * (uu * shear + vv * weft);
        let air = n * (r[13] - r[14]);
        let identity = uu * suu + (uv + vu) * suv + vv * svv + r[14];
        blocks[positions[b] as usize].add([left, right, air], [xu, xv, n], identity);
    }
}

/// As [`add_triangle`] for a hinge.
pub(crate) fn add_hinge(
    inputs: &FillInputs,
    entry: u32,
    positions: [u16; 4],
    blocks: &mut [BlockRows],
    force: &mut Vec3,
) {
    let (e, a) = ((entry >> 2) as usize, (entry & 3) as usize);
    if inputs.fibers.is_slack(e) {
        return;
    }
    let r = &inputs.hinge_records[e * HINGE_RECORD_FLOATS..][..HINGE_RECORD_FLOATS];
    let g = |corner: usize| Vec3::new(r[corner * 4], r[corner * 4 + 1], r[corner * 4 + 2]);
    let (stiffness, moment) = (r[3], r[7]);
    // Of a slack thread of a seam. Nothing is added to sums that begin at +0.
    if stiffness == 0.0 && moment == 0.0 {
        return;
    }
    let ga = g(a);
    *force -= ga * moment;
    let scaled = (ga * stiffness).to_array();
    for b in 0..4 {
        let gb = g(b).extend(0.0);
        let block = &mut blocks[positions[b] as usize];
        for i in 0..3 {
            block.0[i] += gb * scaled[i];
        }
    }
}

/// Inverse of a symmetric positive definite 3x3 block as xx, xy, xz, yy, yz, zz.
pub fn inverse_symmetric(block: &[f32; BLOCK]) -> [f32; 6] {
    let m = Mat3::from_cols_array(block);
    let inverse = m.inverse();
    let (x, y, z) = (inverse.x_axis, inverse.y_axis, inverse.z_axis);
    [x.x, x.y, x.z, y.y, y.z, z.z]
}
