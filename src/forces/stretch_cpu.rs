//! CPU twin of `stretch.wgsl`: one triangle record per triangle.
//!
//! Piecewise-linear anisotropic membrane: Green strain E = (F^T F - I)/2 with F = [x_u x_v], stress from a stiffness
//! that is interpolated in the measured table [Wang et al. 2011]. The stiffness is frozen within a step (its own
//! derivative is not in the Jacobian).

use std::sync::atomic::{AtomicU8, Ordering};

use super::element::{FabricTable, HINGE_RECORD_FLOATS, StepParams, TRIANGLE_RECORD_FLOATS, TriangleElement, vertex};
use super::fiber_cpu::{Limit, deformation, fiber_record, limit};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;

/// Stiffness (warp, cross, weft, shear; N/m) at the Green strain (uu, vv, uv), clamped so that it is positive
/// semidefinite.
pub fn stretch_stiffness(fabric: &FabricTable, strain: [f32; 3]) -> [f32; 4] {
    let [uu, vv, uv] = strain;
    // Largest principal value of 2E and its direction.
    let (mean, half) = (uu + vv, uu - vv);
    let radius = (half * half + 4.0 * uv * uv).sqrt();
    let largest = mean + radius;
    let stretch = (1.0 + largest).max(0.0).sqrt() - 1.0;
    let weight = (stretch * 6.0).clamp(0.0, 1.0);
    let angle = if radius > 0.0 { 0.5 * (2.0 * uv).abs().atan2(half) } else { 0.0 };
    let position = (angle * (8.0 / std::f32::consts::PI)).clamp(0.0, 4.0);
    let row = (position as u32).min(3) as usize;
    let along = position - row as f32;
    let mut k = [0.0; 4];
    for i in 0..4 {
        let strained = fabric.stretching[1 + row][i] * (1.0 - along) + fabric.stretching[2 + row][i] * along;
        k[i] = fabric.stretching[0][i] * (1.0 - weight) + strained * weight;
    }
    let (warp, weft, shear) = (k[0].max(0.0), k[2].max(0.0), k[3].max(0.0));
    let bound = 0.99 * (warp * weft).sqrt();
    [warp, k[1].clamp(-bound, bound), weft, shear]
}

/// Strain energy of a triangle with frozen stiffness, joules (for tests and reports).
pub fn stretch_energy(element: &TriangleElement, stiffness: [f32; 4], positions: [Vec3; 3]) -> f64 {
    let [xu, xv] = deformation(element, positions).map(|x| x.as_dvec3());
    let (uu, vv, uv) = (0.5 * (xu.dot(xu) - 1.0), 0.5 * (xv.dot(xv) - 1.0), 0.5 * xu.dot(xv));
    let k = stiffness.map(f64::from);
    0.5 * element.area_m2 as f64 * (k[0] * uu * uu + k[2] * vv * vv + 2.0 * k[1] * uu * vv + k[3] * uv * uv)
}

/// Positive semidefinite part of [[uu, uv], [uv, vv]].
#[inline(always)]
fn positive_part(uu: f32, uv: f32, vv: f32) -> [f32; 3] {
    let (mean, half) = (0.5 * (uu + vv), 0.5 * (uu - vv));
    let radius = (half * half + uv * uv).sqrt();
    let (largest, smallest) = (mean + radius, mean - radius);
    if smallest >= 0.0 {
        [uu, uv, vv]
    } else if largest <= 0.0 {
        [0.0; 3]
    } else {
        // largest * q q^T with q q^T = (S - smallest I) / (largest - smallest)
        let scale = largest / (2.0 * radius);
        [(uu - smallest) * scale, uv * scale, (vv - smallest) * scale]
    }
}

/// Fills `records` (24 floats per triangle; layout in `stretch`). Bytes per triangle: 48 element + 72 state read, 96
/// written.
pub(super) fn stretch(
    cpu: &CpuExecutor,
    params: &StepParams,
    fabrics: &[FabricTable],
    elements: &[TriangleElement],
    positions: &[f32],
    velocities: &[f32],
    records: &mut [f32],
) {
    cpu.for_ranges_mut(records, TRIANGLE_RECORD_FLOATS, 64, |range, out| {
        for (element, record) in elements[range].iter().zip(out.chunks_exact_mut(TRIANGLE_RECORD_FLOATS)) {
            let (now, rate) = motion(element, positions, velocities);
            stretch_record(params, &fabrics[element.fabric as usize], element, now, rate, record);
        }
    });
}

/// As [`stretch`] for cloth with strain limits, and the records of its fibers, `fibers` (16 floats per triangle; layout
/// in `fiber`), with a flag in `taut` for each that is not zero. 64 bytes more are written per fiber that is taut or
/// was in the pass before.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shaders' bindings")]
pub(super) fn stretch_and_fibers(
    cpu: &CpuExecutor,
    params: &StepParams,
    fabrics: &[FabricTable],
    elements: &[TriangleElement],
    positions: &[f32],
    velocities: &[f32],
    records: &mut [f32],
    fibers: &mut [f32],
    taut: &[AtomicU8],
) {
    let widths = [TRIANGLE_RECORD_FLOATS, HINGE_RECORD_FLOATS];
    cpu.for_range_pairs_mut([records, fibers], widths, 64, |range, [records, fibers]| {
        let records = records.chunks_exact_mut(widths[0]).zip(fibers.chunks_exact_mut(widths[1]));
        for ((element, taut), (record, fiber)) in elements[range.clone()].iter().zip(&taut[range]).zip(records) {
            let (now, rate) = motion(element, positions, velocities);
            let limit = stretch_record(params, &fabrics[element.fabric as usize], element, now, rate, record);
            let is_taut = limit.fiber > 0.0;
            if is_taut {
                fiber_record(params, element, &limit, [now, rate.of_shape], fiber);
            } else if taut.load(Ordering::Relaxed) != 0 {
                fiber.fill(0.0);
            }
            taut.store(u8::from(is_taut), Ordering::Relaxed);
        }
    });
}

/// How the corners of a triangle move.
#[derive(Clone, Copy)]
struct Rate {
    /// The rate of its deformation, 1/s.
    of_shape: [Vec3; 2],
    /// Sum of the velocities of its corners, m/s.
    sum: Vec3,
}

/// Deformation of a triangle and how it moves.
#[inline(always)]
fn motion(element: &TriangleElement, positions: &[f32], velocities: &[f32]) -> ([Vec3; 2], Rate) {
    let [a, b, c] = element.vertices;
    let v = [vertex(velocities, a), vertex(velocities, b), vertex(velocities, c)];
    let now = deformation(element, [vertex(positions, a), vertex(positions, b), vertex(positions, c)]);
    (now, Rate { of_shape: deformation(element, v), sum: v[0] + v[1] + v[2] })
}

/// Fills the record of a triangle, and returns what strain limits add to it.
#[inline(always)]
fn stretch_record(
    params: &StepParams,
    fabric: &FabricTable,
    element: &TriangleElement,
    [xu, xv]: [Vec3; 2],
    rate: Rate,
    record: &mut [f32],
) -> Limit {
    let (dt, area) = (params.step_s, element.area_m2);
    let Rate { of_shape: [wu, wv], sum } = rate;
    let (uu, vv, uv) = (0.5 * (xu.dot(xu) - 1.0), 0.5 * (xv.dot(xv) - 1.0), 0.5 * xu.dot(xv));
    let mut stiffness = stretch_stiffness(fabric, [uu, vv, uv]);
    if element.damage > 0.0 {
        let left = 1.0 / (1.0 + element.damage);
        stiffness = stiffness.map(|k| k * left);
    }
    if element.stiffness != 1.0 {
        stiffness = stiffness.map(|k| k * element.stiffness);
    }
    let [warp, cross, weft, shear] = stiffness;
    // Second Piola stress; the shear term of the energy is k/2 (uv)^2 with uv counted once.
    let (mut suu, mut svv, mut suv) = (warp * uu + cross * vv, weft * vv + cross * uu, 0.5 * shear * uv);
    // K w of a limit counts as far as its stress is not that of the end of the step, and it has no damping.
    let mut beyond = Limit::default();
    if fabric.is_limited() {
        beyond = limit(fabric, [xu, xv], [wu, wv], params.ahead_s).times(element.stiffness);
        (suu, svv, suv) = (suu + beyond.stress[0], svv + beyond.stress[1], suv + beyond.stress[2]);
    }
    let [puu, puv, pvv] = positive_part(suu, suv, svv);

    // K w: rate of the stress gradient along the velocity, for dt K v and the damping force.
    let quarter = 0.25 * shear;
    let shear_rate = quarter * (xv.dot(wu) + xu.dot(wv));
    let ku = xu * (warp * xu.dot(wu) + cross * xv.dot(wv)) + xv * shear_rate + wu * puu + wv * puv;
    let kv = xv * (weft * xv.dot(wv) + cross * xu.dot(wu)) + xu * shear_rate + wv * pvv + wu * puv;
    let rate = params.ahead_s + fabric.damping_s;
    let mut pu = (xu * suu + xv * suv + ku * rate) * area;
    let mut pv = (xu * suv + xv * svv + kv * rate) * area;
    if beyond.plain_ahead != [0.0; 3] {
        let [warp, weft, quarter] = beyond.plain_ahead;
        let shear_rate = quarter * (xv.dot(wu) + xu.dot(wv));
        pu += (xu * (warp * xu.dot(wu)) + xv * shear_rate) * area;
        pv += (xv * (weft * xv.dot(wv)) + xu * shear_rate) * area;
    }

    // Air: pressure rho |vn| vn n and tangential drag, each corner a third; the Jacobian blocks of all corner pairs are
    // equal.
    let normal = xu.cross(xv);
    let length = normal.length();
    let n = if length > 0.0 { normal / length } else { Vec3::ZERO };
    let relative = Vec3::from(params.wind) - sum * (1.0 / 3.0);
    let vn = relative.dot(n);
    let tangential = relative - n * vn;
    let mut air = (n * (params.air_density * vn.abs() * vn) + tangential * params.air_drag) * (area * (1.0 / 3.0));
    if element.pressure_pa != 0.0 {
        air += normal * (element.pressure_pa * area * (1.0 / 3.0));
    }
    let air_normal = dt * area * 2.0 * params.air_density * vn.abs() * (1.0 / 9.0);
    let air_tangent = dt * area * params.air_drag * (1.0 / 9.0);

    let h = dt * (dt + fabric.damping_s) * area;
    let (warp, weft, quarter) = {
        let [of_warp, of_weft, of_shear] = beyond.plain;
        (warp + of_warp, weft + of_weft, quarter + of_shear)
    };
    record.copy_from_slice(&[
        xu.x,
        xu.y,
        xu.z,
        h * warp, //
        xv.x,
        xv.y,
        xv.z,
        h * cross, //
        h * weft,
        h * quarter,
        h * puu,
        h * puv, //
        h * pvv,
        air_normal,
        air_tangent,
        air.x, //
        pu.x,
        pu.y,
        pu.z,
        air.y, //
        pv.x,
        pv.y,
        pv.z,
        air.z,
    ]);
    beyond
}
