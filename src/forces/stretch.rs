//! Stretch and air elements [Wang et al. 2011; Narain et al. 2012]: positions and velocities -> triangle records.
//!
//! A record holds everything that the three corners' forces and the nine 3x3 blocks are made of; 96 bytes instead of 396:
//! ```text
//! [ 0.. 4) x_u, h*warp        [12..16) h*S+_vv, air normal, air tangent, air force x / 3
//! [ 4.. 8) x_v, h*cross       [16..20) P_u, air force y / 3
//! [ 8..12) h*weft, h*shear/4, h*S+_uu, h*S+_uv      [20..24) P_v, air force z / 3
//! ```
//! h = (dt^2 + dt*damping) * area, S+ = positive part of the stress, P = stress gradient with the dt K v and damping terms.
//! Force on corner a: -(u_a P_u + v_a P_v) + air/3 with u_a, v_a the corner weights.
//! Does not sum over elements and does not know which rank owns a vertex.

use super::element::{FabricTable, StepParams, TRIANGLE_RECORD_FLOATS, TriangleElement};
use super::stretch_cpu;
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource};

static STRETCH: KernelSource =
    KernelSource::new::<StepParams>("forces/stretch.wgsl", include_str!("stretch.wgsl"), "stretch")
        .with_libraries(&[include_str!("element.wgsl"), include_str!("limit.wgsl")])
        .with_structs(&[FabricTable::LAYOUT, TriangleElement::LAYOUT]);

/// The stretch kernel on one executor.
pub struct Stretch {}

impl Stretch {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Stretch {
        Stretch {}
    }

    /// Fills `records` from the state of `elements`. `positions`, `velocities`: xyz of every local vertex.
    #[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
    pub fn apply(
        &self,
        executor: &Executor,
        params: &StepParams,
        fabrics: &DeviceVec<FabricTable>,
        elements: &DeviceVec<TriangleElement>,
        positions: &DeviceVec<f32>,
        velocities: &DeviceVec<f32>,
        records: &mut DeviceVec<f32>,
    ) {
        assert_eq!(records.len(), elements.len() * TRIANGLE_RECORD_FLOATS);
        match executor {
            Executor::Cpu(cpu) => stretch_cpu::stretch(
                cpu,
                params,
                fabrics.as_slice(),
                elements.as_slice(),
                positions.as_slice(),
                velocities.as_slice(),
                records.as_mut_slice(),
            ),
            Executor::Gpu(gpu) => {
                for window in gpu.windows(elements.len(), TRIANGLE_RECORD_FLOATS * 4) {
                    let (first, count) = (window.start, window.len());
                    let bindings = [
                        fabrics.binding(),
                        elements.window(first, count),
                        positions.binding(),
                        velocities.binding(),
                        records.window_mut(first * TRIANGLE_RECORD_FLOATS, count * TRIANGLE_RECORD_FLOATS),
                    ];
                    gpu.run(&STRETCH, &bindings, &StepParams { count: count as u32, ..*params }, count as u64);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shader_and_structs_agree() {
        STRETCH.check().unwrap();
    }
}
