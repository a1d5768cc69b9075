//! CPU twin of `bend.wgsl`: one hinge record per interior edge.
//!
//! Energy k/2 (theta - rest)^2 of the dihedral angle with the stiffness of the fabric at the hinge's curvature and
//! direction [Wang et al. 2011]; the Jacobian keeps the rank-one part k g g^T, g = grad theta, which is positive
//! semidefinite.

use super::element::{FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams, vertex};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;

/// Altitude of a side, in mean altitudes of both sides at rest, below which it counts as collapsed. The gradient of the
/// angle grows as 1 / altitude, and k g g^T as its square, until single precision cannot solve the system any more;
/// there k falls with the square of the altitude.
const COLLAPSED: f32 = 0.02;
/// Spacing of the curvature samples of the bending table, 1/m.
const CURVATURE_SPACING: f32 = 5.0;

/// Dihedral angle of the hinge (edge start, edge end, opposite 0, opposite 1) and its gradient; flat = 0. A hinge with
/// a degenerate triangle has angle and gradient zero.
pub fn dihedral_angle(x: [Vec3; 4]) -> (f32, [Vec3; 4]) {
    let e = x[1] - x[0];
    let (d0, d1) = (x[2] - x[0], x[3] - x[0]);
    let (n0, n1) = (e.cross(d0), d1.cross(e));
    let (l2, n0_2, n1_2) = (e.length_squared(), n0.length_squared(), n1.length_squared());
    if !(l2 > 0.0 && n0_2 > 0.0 && n1_2 > 0.0) {
        return (0.0, [Vec3::ZERO; 4]);
    }
    let length = l2.sqrt();
    let angle = (n0.cross(n1).dot(e) / length).atan2(n0.dot(n1));
    let (g2, g3) = (n0 * (-length / n0_2), n1 * (-length / n1_2));
    let (t0, t1) = (d0.dot(e) / l2, d1.dot(e) / l2);
    let g0 = -(g2 * (1.0 - t0) + g3 * (1.0 - t1));
    let g1 = -(g2 * t0 + g3 * t1);
    (angle, [g0, g1, g2, g3])
}

/// Bending stiffness (N m) of one side at a curvature (1/m) and direction.
fn bending_stiffness(fabric: &FabricTable, curvature: f32, bias: f32) -> f32 {
    let along = (curvature.abs() / CURVATURE_SPACING).min(4.0);
    let column = (along as u32).min(3) as usize;
    let a = along - column as f32;
    let row = (bias as u32).min(1) as usize;
    let b = bias - row as f32;
    let at = |r: usize, c: usize| fabric.bending[r * 5 + c];
    let low = at(row, column) * (1.0 - a) + at(row, column + 1) * a;
    let high = at(row + 1, column) * (1.0 - a) + at(row + 1, column + 1) * a;
    (low * (1.0 - b) + high * b).max(0.0)
}

/// Torsion stiffness of a hinge at an angle, N m: the weaker of its two sides.
fn hinge_stiffness(fabrics: &[FabricTable], element: &HingeElement, angle: f32) -> f32 {
    let curvature = element.curvature_from_angle * angle;
    let side = |s: usize| bending_stiffness(&fabrics[element.fabric[s] as usize], curvature, element.bias[s]);
    let stiffness = element.shape * side(0).min(side(1));
    if element.plastic_curvature > 0.0 {
        let fabric = FabricTable::yields_first(element.fabric.map(|of_side| &fabrics[of_side as usize]));
        return stiffness * fabric.weakened(element.plastic_curvature);
    }
    stiffness
}

/// Energy of a hinge with the stiffness frozen at `frozen_angle`, joules (for tests).
pub fn bend_energy(fabrics: &[FabricTable], element: &HingeElement, frozen_angle: f32, angle: f32) -> f64 {
    let offset = (angle - element.rest_angle) as f64;
    0.5 * hinge_stiffness(fabrics, element, frozen_angle) as f64 * offset * offset
}

/// Fills `records` (16 floats per hinge; layout in `bend`). Bytes per hinge: 48 element + 96 state read, 64 written.
pub(super) fn bend(
    cpu: &CpuExecutor,
    params: &StepParams,
    fabrics: &[FabricTable],
    elements: &[HingeElement],
    positions: &[f32],
    velocities: &[f32],
    records: &mut [f32],
) {
    cpu.for_ranges_mut(records, HINGE_RECORD_FLOATS, 64, |range, out| {
        for (element, record) in elements[range].iter().zip(out.chunks_exact_mut(HINGE_RECORD_FLOATS)) {
            let (angle, g) = dihedral_angle(element.vertices.map(|v| vertex(positions, v)));
            let v = element.vertices.map(|v| vertex(velocities, v));
            let steep = g[2].length_squared().max(g[3].length_squared());
            let floor_m = COLLAPSED / element.curvature_from_angle;
            let collapse = steep * (floor_m * floor_m);
            let stiffness = hinge_stiffness(fabrics, element, angle);
            let k = if collapse > 1.0 { stiffness / collapse } else { stiffness };
            let damping =
                0.5 * (fabrics[element.fabric[0] as usize].damping_s + fabrics[element.fabric[1] as usize].damping_s);
            let rate = g[0].dot(v[0]) + g[1].dot(v[1]) + g[2].dot(v[2]) + g[3].dot(v[3]);
            let moment = k * (angle - element.rest_angle) + (params.ahead_s + damping) * k * rate;
            let h = params.step_s * (params.step_s + damping) * k;
            record.copy_from_slice(&[
                g[0].x, g[0].y, g[0].z, h, //
                g[1].x, g[1].y, g[1].z, moment, //
                g[2].x, g[2].y, g[2].z, 0.0, //
                g[3].x, g[3].y, g[3].z, 0.0,
            ]);
        }
    });
}
