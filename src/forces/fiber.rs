//! Strain limits: a fiber in a triangle that resists stretch beyond the limits of its fabric.
//!
//! A direction d (material space) of a principal stretch out of the limits [a, b] gets the stress
//! ```text
//! S = s(e) d d'    e = (|F d|^2 - L^2) / 2    L = the limit, a or b
//! s(e) = K e |e| / (2 B) up to |e| = B, then linear with the slope K (`fiber_cpu::fiber_stress`)
//! ```
//! A triangle that is within its limits is seen where its velocity leads it within the step, to first order; one that
//! is not is linearized where it is, so that a limit that holds a weight does not let go when the velocity wavers.
//! Forces and their slopes are continuous, and the limit needs no multiplier that a state would have to remember.
//! `stretch` adds S to the stress of the triangle: forces, and the stiffness that tension gives across it. The
//! stiffness along d is K (F d)(F d)' d d', positive semidefinite and of rank one, which a triangle record has no place
//! for. It is the slope at e, but at least 0.3 of the largest one. Here it is a record like that of a hinge (layout:
//! `bend`) whose gradients are w_a F d at corner a of the triangle, w_a = u_a d_u + v_a d_v, and zero at the fourth
//! corner. Where both principal stretches are out of the limits, the larger slope is there in all directions instead,
//! which the triangle record holds. Limits of warp, weft and shear by themselves need no fiber: d is a direction of the
//! fabric there, and their stiffness adds to that of warp, weft and shear in the triangle record. The strain of shear
//! beyond its limit is (|x_u . x_v| - sin(limit) |x_u| |x_v|) / 2.

use std::sync::atomic::{AtomicU8, Ordering};

use super::element::{FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams, TriangleElement};
use super::stretch::Stretch;
use super::stretch_cpu;
use crate::gpu::{DeviceVec, Executor, GpuStruct, KernelSource};

static FIBER: KernelSource = KernelSource::new::<StepParams>("forces/fiber.wgsl", include_str!("fiber.wgsl"), "fiber")
    .with_libraries(&[include_str!("element.wgsl"), include_str!("limit.wgsl")])
    .with_structs(&[FabricTable::LAYOUT, TriangleElement::LAYOUT]);

/// The place of a triangle's fiber in the list of hinges: a hinge without stiffness of its own. Its fourth corner is
/// the first one again.
pub fn element(triangle: &TriangleElement) -> HingeElement {
    let [a, b, c] = triangle.vertices;
    HingeElement {
        vertices: [a, b, c, a],
        shape: 0.0,
        curvature_from_angle: 0.0,
        rest_angle: 0.0,
        plastic_curvature: 0.0,
        bias: [0.0; 2],
        fabric: [triangle.fabric; 2],
    }
}

/// Which fibers of a rank resist anything. Native code passes over the others, which are most, without a look at their
/// records; those are zero. A device reads all records.
#[derive(Debug, Default)]
pub struct TautFibers {
    /// Place of the first fiber among the hinges.
    first: usize,
    /// Not 0 where a fiber resists; empty on a device.
    taut: Vec<AtomicU8>,
}

impl TautFibers {
    /// `count` fibers from the place `first` among the hinges on, all slack.
    pub fn new(executor: &Executor, first: usize, count: usize) -> TautFibers {
        let count = if executor.native().is_some() { count } else { 0 };
        TautFibers { first, taut: (0..count).map(|_| AtomicU8::new(0)).collect() }
    }

    /// True if the hinge at a place is a fiber that resists nothing.
    #[inline(always)]
    pub(crate) fn is_slack(&self, hinge: usize) -> bool {
        // Every flag is written by one thread, and read after the pass.
        self.taut.get(hinge.wrapping_sub(self.first)).is_some_and(|taut| taut.load(Ordering::Relaxed) == 0)
    }
}

/// Fills the records of `elements`, `triangle_records`, and those of their fibers: those of `records` from the first
/// fiber on, on a device a multiple of [`crate::gpu::WINDOW_STEP`]; others may follow. Native code does both in one
/// pass over the triangles.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shaders' bindings")]
pub fn apply(
    executor: &Executor,
    stretch: &Stretch,
    params: &StepParams,
    fabrics: &DeviceVec<FabricTable>,
    elements: &DeviceVec<TriangleElement>,
    positions: &DeviceVec<f32>,
    velocities: &DeviceVec<f32>,
    triangle_records: &mut DeviceVec<f32>,
    taut: &TautFibers,
    records: &mut DeviceVec<f32>,
) {
    let first = taut.first;
    let range = first * HINGE_RECORD_FLOATS..(first + elements.len()) * HINGE_RECORD_FLOATS;
    assert!(range.end <= records.len(), "a record per triangle from the first one on");
    match executor {
        Executor::Cpu(cpu) => stretch_cpu::stretch_and_fibers(
            cpu,
            params,
            fabrics.as_slice(),
            elements.as_slice(),
            positions.as_slice(),
            velocities.as_slice(),
            triangle_records.as_mut_slice(),
            &mut records.as_mut_slice()[range],
            &taut.taut,
        ),
        Executor::Gpu(gpu) => {
            stretch.apply(executor, params, fabrics, elements, positions, velocities, triangle_records);
            for window in gpu.windows(elements.len(), HINGE_RECORD_FLOATS * 4) {
                let (start, count) = (window.start, window.len());
                let bindings = [
                    fabrics.binding(),
                    elements.window(start, count),
                    positions.binding(),
                    velocities.binding(),
                    records.window_mut((first + start) * HINGE_RECORD_FLOATS, count * HINGE_RECORD_FLOATS),
                ];
                gpu.run(&FIBER, &bindings, &StepParams { count: count as u32, ..*params }, count as u64);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shader_and_structs_agree() {
        FIBER.check().unwrap();
    }
}
