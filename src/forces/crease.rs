//! Creases: bending beyond the yield curvature moves the angle at rest [Narain et al. 2013].
//!
//! A hinge at the angle theta with the angle at rest theta_p has the elastic curvature kappa = c (theta - theta_p), c =
//! [`HingeElement::curvature_from_angle`]. With the plastic curvature g so far it yields at y = y0 + H g. Where |kappa|
//! is larger, the return map moves it back to the yield surface:
//! ```text
//! dg = (|kappa| - y) / (1 + H)    theta_p += sign(kappa) dg / c    g += dg
//! ```
//! so that |kappa| = y afterwards, however many steps lead there. Once per step, from the state at its end. The
//! stiffness of a hinge that has yielded is k y0 / (y0 + weakening g) (`bend`).

use super::crease_cpu;
use super::element::{FabricTable, HingeElement};
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource, gpu_struct};

gpu_struct! {
    /// Uniform of the kernel.
    struct CreaseParams {
        /// Number of hinges.
        count: u32,
        /// Fills the struct to a multiple of 8 bytes.
        padding: u32,
    }
}

static CREASE: KernelSource =
    KernelSource::new::<CreaseParams>("forces/crease.wgsl", include_str!("crease.wgsl"), "crease")
        .with_libraries(&[include_str!("element.wgsl")])
        .with_structs(&[FabricTable::LAYOUT, HingeElement::LAYOUT]);

/// Applies the return map to the first hinges of `elements` at `positions` (xyz of every local vertex), one for each
/// item of `damage`, which becomes its plastic curvature over its yield curvature.
pub fn apply(
    executor: &Executor,
    fabrics: &DeviceVec<FabricTable>,
    positions: &DeviceVec<f32>,
    elements: &mut DeviceVec<HingeElement>,
    damage: &mut DeviceVec<f32>,
) {
    let hinges = damage.len();
    match executor {
        Executor::Cpu(cpu) => {
            let elements = &mut elements.as_mut_slice()[..hinges];
            crease_cpu::crease(cpu, fabrics.as_slice(), positions.as_slice(), elements, damage.as_mut_slice());
        }
        Executor::Gpu(gpu) => {
            for window in gpu.windows(hinges, size_of::<HingeElement>()) {
                let params = CreaseParams { count: window.len() as u32, padding: 0 };
                let bindings = [
                    fabrics.binding(),
                    positions.binding(),
                    elements.window_mut(window.start, window.len()),
                    damage.window_mut(window.start, window.len()),
                ];
                gpu.run(&CREASE, &bindings, &params, window.len() as u64);
            }
        }
    }
}

/// Plastic curvature over yield curvature of a hinge.
pub fn damage(fabrics: &[FabricTable], element: &HingeElement) -> f32 {
    let fabric = FabricTable::yields_first(element.fabric.map(|of_side| &fabrics[of_side as usize]));
    if fabric.yield_curvature > 0.0 { element.plastic_curvature / fabric.yield_curvature } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shader_and_structs_agree() {
        CREASE.check().unwrap();
    }
}
