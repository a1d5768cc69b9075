//! CPU twin of `stitch.wgsl`: three records per thread of a seam; `stitch` explains them.

use super::element::{HINGE_RECORD_FLOATS, vertex};
use super::stitch::{RECORDS_STITCH, StitchElement, StitchParams};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;

/// Fills `records` (48 floats per thread). Bytes per thread: 16 element + 48 state read, 192 written.
pub(super) fn stitch(
    cpu: &CpuExecutor,
    params: &StitchParams,
    elements: &[StitchElement],
    positions: &[f32],
    velocities: &[f32],
    records: &mut [f32],
) {
    cpu.for_ranges_mut(records, RECORDS_STITCH * HINGE_RECORD_FLOATS, 64, |range, out| {
        for (element, records) in elements[range].iter().zip(out.chunks_exact_mut(RECORDS_STITCH * HINGE_RECORD_FLOATS))
        {
            let [x, w] = [positions, velocities].map(|of| {
                let [a, b] = element.vertices.map(|v| vertex(of, v));
                a - b
            });
            let length = x.length();
            let way = (element.first_m - params.last_m).max(0.0);
            let (rest, rest_rate) = (element.first_m - way * params.closed, -way * params.closing_1_s);
            let (n, across) = if length > 0.0 { (x / length, (1.0 - rest / length).max(0.0)) } else { (Vec3::X, 1.0) };
            let rate = w.dot(n);
            let firm = element.stiffness_n_m * params.firmness;
            let pull = (length - rest) + params.ahead_s * rate;
            let taut = if pull > 0.0 { firm } else { 0.0 };
            let damper = if pull > 0.0 || rate < rest_rate { firm * params.damping_s } else { 0.0 };
            let moment = taut * pull + damper * (rate - rest_rate);
            let axis = if n.x.abs() < 0.6 { Vec3::X } else { Vec3::Y };
            let t = n.cross(axis).normalize();
            let b = n.cross(t);
            let along = params.step_s * (params.step_s * taut + damper);
            let (kt, lag) = (taut * across, params.ahead_s + params.damping_s);
            let aside = params.step_s * (params.step_s + params.damping_s) * kt;
            let directions = [(n, along, moment), (t, aside, kt * lag * w.dot(t)), (b, aside, kt * lag * w.dot(b))];
            for ((d, h, moment), record) in directions.into_iter().zip(records.chunks_exact_mut(HINGE_RECORD_FLOATS)) {
                record.fill(0.0);
                d.write_to_slice(&mut record[..3]);
                (-d).write_to_slice(&mut record[4..7]);
                (record[3], record[7]) = (h, moment);
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Closing;

    /// Force on the first vertex and the sum of the stiffness blocks, over h.
    fn thread(gap: Vec3, rate: Vec3, params: StitchParams) -> (Vec3, impl Fn(Vec3) -> Vec3) {
        let element = StitchElement { vertices: [0, 1], stiffness_n_m: 100.0, first_m: 0.5 };
        let positions = [gap, Vec3::ZERO].map(|p| p.to_array()).concat();
        let velocities = [rate, Vec3::ZERO].map(|p| p.to_array()).concat();
        let mut records = vec![0.0; 48];
        stitch(&CpuExecutor::new(1), &params, &[element], &positions, &velocities, &mut records);
        let h = params.step_s * (params.step_s + params.damping_s);
        let of = records.chunks_exact(16).map(|r| (Vec3::from_slice(&r[..3]), r[3] / h, r[7])).collect::<Vec<_>>();
        let force = of.iter().map(|(d, _, moment)| *d * -moment).sum();
        (force, move |v| of.iter().map(|(d, k, _)| *d * (k * d.dot(v))).sum())
    }

    #[test]
    fn a_thread_pulls_to_its_length_and_does_not_push() {
        let closing = Closing { start_s: 0.0, close_s: 1.0, last_m: 0.001 };
        let at = |closed| StitchParams { damping_s: 0.0, ..StitchParams::new(0.01, 0.0, &closing, closed) };
        let (force, _) = thread(Vec3::new(0.0, 0.5, 0.0), Vec3::ZERO, at(0.0));
        assert_eq!(force, Vec3::ZERO);
        let (force, stiffness) = thread(Vec3::new(0.0, 0.5, 0.0), Vec3::ZERO, at(1.0));
        assert!((force - Vec3::new(0.0, -49.9, 0.0)).length() < 1e-3, "{force}");
        assert!((stiffness(Vec3::Y) - Vec3::Y * 100.0).length() < 1e-3);
        assert!((stiffness(Vec3::X) - Vec3::X * 99.8).length() < 1e-2);
        assert_eq!(thread(Vec3::new(0.0, 5e-4, 0.0), Vec3::ZERO, at(1.0)).0, Vec3::ZERO);
        // Long after, it is firmer.
        let (force, _) = thread(Vec3::new(0.0, 0.5, 0.0), Vec3::ZERO, at(3.0));
        assert!((force - Vec3::new(0.0, -499.0, 0.0)).length() < 1e-2, "{force}");
        // Without a length of its own it holds in every direction.
        let (_, stiffness) = thread(Vec3::ZERO, Vec3::ZERO, StitchParams { last_m: -0.1, ..at(1.0) });
        for d in [Vec3::X, Vec3::Y, Vec3::Z] {
            assert!((stiffness(d) - d * 100.0).length() < 1e-3, "{}", stiffness(d));
        }
    }

    #[test]
    fn the_stiffness_is_the_slope_of_the_force() {
        let closing = Closing { start_s: 0.0, close_s: 0.5, last_m: 0.0 };
        let params = StitchParams { damping_s: 0.0, ..StitchParams::new(0.01, 0.0, &closing, 0.3) };
        let gap = Vec3::new(0.3, -0.2, 0.25);
        let (_, stiffness) = thread(gap, Vec3::ZERO, params);
        for d in [Vec3::X, Vec3::Y, Vec3::new(0.3, 0.5, -0.8)] {
            let at = |e: f32| thread(gap + d * e, Vec3::ZERO, params).0;
            let slope = (at(1e-3) - at(-1e-3)) / 2e-3;
            assert!((slope + stiffness(d)).length() < 0.05, "{slope} {}", stiffness(d));
        }
        // The damper asks for the speed at which the thread shrinks.
        let closing = StitchParams::new(0.01, 0.0, &closing, 0.3);
        let n = gap.normalize();
        let still = thread(gap, -n, closing).0;
        let slow = thread(gap, Vec3::ZERO, closing).0;
        assert!((still - thread(gap, Vec3::ZERO, params).0).length() < 1e-3);
        assert!(slow.dot(n) < still.dot(n));
        // A slack thread that shortens faster than it should is held back, another one is not.
        let short = gap.normalize() * 0.1;
        assert!(thread(short, -n * 5.0, closing).0.dot(n) > 0.1);
        assert_eq!(thread(short, -n * 0.5, closing).0, Vec3::ZERO);
    }
}
