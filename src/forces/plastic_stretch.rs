//! Plastic stretching: stretches beyond the yield strain move the shape of a triangle at rest, and damage weakens it.
//!
//! A triangle has a symmetric rest stretch U of its material plane, the identity at first. Its elastic deformation is
//! F U^-1, which the corner weights of its element contain: w' = w U^-1, so that no other kernel knows of U. With the
//! principal stretches l_i of F U^-1, the strains e_i = ln l_i, and the plastic strain g so far, it yields where a
//! |e_i| exceeds y = y0 + H g. The return map moves both strains back to the yield surface:
//! ```text
//! T = y0 + H (g + sum_i d_i)    d_i = max(|e_i| - T, 0)    g += sum_i d_i
//! U <- (U A^2 U)^(1/2)    A = the stretch exp(sign(e_i) d_i) along the direction of l_i
//! ```
//! Logarithms of stretches along one direction add up, so the result does not depend on the number of steps. The square
//! root drops the rotation of the plastic part, so that warp and weft keep their directions. No principal value of U
//! leaves [1/3, 3]; a triangle that is there is elastic. Once per step, from the state at its end.
//!
//! Damage is plastic strain over yield strain, plus the largest plastic curvature over yield curvature of the hinges of
//! the triangle: a crease weakens the cloth beside it [Narain et al. 2013]. The stiffness is divided by 1 + weakening *
//! damage.

use super::element::{FabricTable, TriangleElement};
use super::plastic_stretch_cpu;
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource, gpu_struct};

/// Hinge of the side of a triangle that has none.
pub const NO_HINGE: u32 = u32::MAX;

gpu_struct! {
    /// Shape of a triangle at rest, and what has changed it.
    pub struct PlasticTriangle {
        /// As [`TriangleElement::weights_u`] before anything yielded.
        pub weights_u: [f32; 2],
        /// As [`TriangleElement::weights_v`] before anything yielded.
        pub weights_v: [f32; 2],
        /// Rest stretch: uu, vv, uv.
        pub stretch: [f32; 3],
        /// Plastic strain so far, every change counted positive.
        pub plastic_strain: f32,
        /// Local hinges of its sides; [`NO_HINGE`] at a border.
        pub hinges: [u32; 3],
        /// Fills the struct to a multiple of 16 bytes.
        pub padding: u32,
    }
}

impl PlasticTriangle {
    /// A triangle that has not yielded.
    pub fn new(element: &TriangleElement, hinges: [u32; 3]) -> PlasticTriangle {
        PlasticTriangle {
            weights_u: element.weights_u,
            weights_v: element.weights_v,
            stretch: [1.0, 1.0, 0.0],
            plastic_strain: 0.0,
            hinges,
            padding: 0,
        }
    }

    /// Rest stretch uu, vv, uv and plastic strain.
    pub fn state(&self) -> [f32; 4] {
        let [uu, vv, uv] = self.stretch;
        [uu, vv, uv, self.plastic_strain]
    }

    /// Sets what [`PlasticTriangle::state`] gives.
    pub fn set_state(&mut self, state: [f32; 4]) {
        let [uu, vv, uv, plastic_strain] = state;
        (self.stretch, self.plastic_strain) = ([uu, vv, uv], plastic_strain);
    }
}

gpu_struct! {
    /// Uniform of the kernel.
    struct PlasticParams {
        /// Number of triangles.
        count: u32,
        /// 1 = the return map is applied, 0 = the elements are brought in line with what is known.
        moves: u32,
    }
}

static PLASTIC_STRETCH: KernelSource = KernelSource::new::<PlasticParams>(
    "forces/plastic_stretch.wgsl",
    include_str!("plastic_stretch.wgsl"),
    "plastic_stretch",
)
.with_libraries(&[include_str!("element.wgsl")])
.with_structs(&[FabricTable::LAYOUT, TriangleElement::LAYOUT, PlasticTriangle::LAYOUT]);

/// Applies the return map to all triangles at `positions` (xyz of every local vertex), if they `move`, and sets weights
/// and damage of `elements`. `hinge_damage`: plastic curvature over yield curvature of every hinge.
pub fn apply(
    executor: &Executor,
    moves: bool,
    fabrics: &DeviceVec<FabricTable>,
    positions: &DeviceVec<f32>,
    hinge_damage: &DeviceVec<f32>,
    plastic: &mut DeviceVec<PlasticTriangle>,
    elements: &mut DeviceVec<TriangleElement>,
) {
    assert_eq!(plastic.len(), elements.len());
    match executor {
        Executor::Cpu(cpu) => plastic_stretch_cpu::plastic_stretch(
            cpu,
            moves,
            fabrics.as_slice(),
            positions.as_slice(),
            hinge_damage.as_slice(),
            plastic.as_mut_slice(),
            elements.as_mut_slice(),
        ),
        Executor::Gpu(gpu) => {
            for window in gpu.windows(elements.len(), size_of::<TriangleElement>()) {
                let params = PlasticParams { count: window.len() as u32, moves: u32::from(moves) };
                let bindings = [
                    fabrics.binding(),
                    positions.binding(),
                    hinge_damage.binding(),
                    plastic.window_mut(window.start, window.len()),
                    elements.window_mut(window.start, window.len()),
                ];
                gpu.run(&PLASTIC_STRETCH, &bindings, &params, window.len() as u64);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shader_and_structs_agree() {
        PLASTIC_STRETCH.check().unwrap();
    }
}
