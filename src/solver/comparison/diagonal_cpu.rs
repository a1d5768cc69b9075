//! Loops of `diagonal`, which has no shader.

use crate::assembly::contact_system::NO_SLOT;
use crate::assembly::fill::{
    BlockRows, FillInputs, FillParams, add_contacts, add_hinge, add_triangle, inverse_symmetric,
};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;
use crate::solver::vector_cpu::Shared;

/// Right-hand side and inverted diagonal blocks of every own row, in the order of `assembly::fill`.
pub(super) fn fill_diagonal(
    cpu: &CpuExecutor,
    params: &FillParams,
    inputs: &FillInputs,
    rhs: &mut [f32],
    inverse_diagonal: &mut [f32],
) {
    let rhs = Shared(rhs.as_mut_ptr());
    cpu.for_ranges_mut(inverse_diagonal, 6, 64, |range, inverse| {
        for (row, inverse) in range.zip(inverse.chunks_exact_mut(6)) {
            // The diagonal block, and a scratch block that receives all other contributions.
            let (mut blocks, mut absolute) = ([BlockRows::default(); 2], BlockRows::default());
            let mut force = Vec3::from(params.gravity) * inputs.masses[row];
            let positions = |entry: u32| std::array::from_fn(|corner| u16::from(corner as u32 != entry & 3));
            for i in inputs.triangle_offsets[row] as usize..inputs.triangle_offsets[row + 1] as usize {
                let entry = inputs.triangle_entries[i];
                add_triangle(inputs, entry, positions(entry), &mut blocks, &mut absolute, &mut force);
            }
            for i in inputs.hinge_offsets[row] as usize..inputs.hinge_offsets[row + 1] as usize {
                let entry = inputs.hinge_entries[i];
                add_hinge(inputs, entry, positions(entry), &mut blocks, &mut force);
            }
            let [mut diagonal, _] = blocks;
            diagonal.add_identity(inputs.masses[row]);
            let mut impulse = (force * params.step_s).to_array();
            if let Some(&slot) = inputs.contact_slots.get(row)
                && slot != NO_SLOT
            {
                add_contacts(inputs, slot as usize, [&mut diagonal], &mut impulse);
            }
            // SAFETY: the row's own entries.
            unsafe { rhs.part(row * 3, 3) }.copy_from_slice(&impulse);
            inverse.copy_from_slice(&if inputs.pinned[row] < 0.0 {
                [0.0; 6]
            } else {
                inverse_symmetric(&diagonal.entries())
            });
        }
    });
}
