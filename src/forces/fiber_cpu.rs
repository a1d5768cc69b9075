//! CPU twin of `fiber.wgsl` and `limit.wgsl`: what strain limits add to a triangle; `fiber` explains it.

use super::element::{FabricTable, StepParams, TriangleElement};
use crate::math::{Vec2, Vec3};

/// Green strain beyond the limit from which on the slope of a fiber's stress does not grow.
const LIMIT_BEND: f32 = 0.0025;
/// The matrix has at least this part of the largest slope of a fiber's stress.
const LIMIT_SLOPE_LEAST: f32 = 0.3;

/// What the strain limits of a fabric add to a triangle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Limit {
    /// Second Piola stress uu, vv, uv, N/m: that of the state, or that of the end of the step.
    pub stress: [f32; 3],
    /// Stiffness along `direction`, N/m.
    pub fiber: f32,
    /// The stress of the fiber is that of this time before the end of the step, seconds.
    pub ahead_s: f32,
    /// Unit vector in material space.
    pub direction: Vec2,
    /// Stiffness of warp, weft and a quarter of that of shear, N/m.
    pub plain: [f32; 3],
    /// `plain` times the time before the end of the step that its stress is of, N s/m.
    pub plain_ahead: [f32; 3],
}

impl Limit {
    /// What a triangle of `factor` times the stiffness of the fabric gets.
    pub(super) fn times(self, factor: f32) -> Limit {
        let of = |values: [f32; 3]| values.map(|value| value * factor);
        let Limit { stress, fiber, plain, plain_ahead, .. } = self;
        Limit { stress: of(stress), fiber: fiber * factor, plain: of(plain), plain_ahead: of(plain_ahead), ..self }
    }
}

/// Stress (N/m) of a fiber at the Green strain `beyond` its limit, for a fabric of this
/// [`FabricTable::limit_stiffness`]: quadratic, so that its slope is continuous, then linear, so that it is bounded.
pub(super) fn fiber_stress(stiffness: f32, beyond: f32) -> f32 {
    let size = beyond.abs();
    let bent = size.min(LIMIT_BEND);
    beyond.signum() * stiffness * (bent / LIMIT_BEND) * (size - 0.5 * bent)
}

/// The slope of [`fiber_stress`] that the matrix has: at least 0.3 of the largest one, so that a triangle that has just
/// gone beyond its limit meets resistance at once; 0 within it.
pub(super) fn fiber_slope(stiffness: f32, beyond: f32) -> f32 {
    if beyond == 0.0 { 0.0 } else { stiffness * (beyond.abs() / LIMIT_BEND).clamp(LIMIT_SLOPE_LEAST, 1.0) }
}

/// The limits of a triangle with this deformation `[x_u, x_v]` and its rate, `ahead_s` after the state.
pub(super) fn limit(fabric: &FabricTable, now: [Vec3; 2], rate: [Vec3; 2], ahead_s: f32) -> Limit {
    if fabric.has_fibers() {
        limit_of_every_direction(fabric, now, rate, ahead_s)
    } else {
        limit_by_direction(fabric, now, rate, ahead_s)
    }
}

/// As [`limit`] for limits of warp, weft and shear. Their stiffness has a place in the record of the triangle.
fn limit_by_direction(fabric: &FabricTable, now: [Vec3; 2], rate: [Vec3; 2], ahead_s: f32) -> Limit {
    let ([u, v], [wu, wv], k) = (now, rate, fabric.limit_stiffness);
    let mut found = Limit::default();
    for (i, x, w, [least, most]) in [(0, u, wu, fabric.warp_limit), (1, v, wv, fabric.weft_limit)] {
        let beyond = |squared: f32| 0.5 * ((squared - most * most).max(0.0) + (squared - least * least).min(0.0));
        let (mut e, mut ahead) = (beyond(x.dot(x)), ahead_s);
        if e == 0.0 {
            (e, ahead) = (beyond(x.dot(x) + 2.0 * ahead_s * x.dot(w)), 0.0);
        }
        found.stress[i] = fiber_stress(k, e);
        found.plain[i] = fiber_slope(k, e);
        found.plain_ahead[i] = found.plain[i] * ahead;
    }
    // The stretch of the threads counts as what it is now.
    let most = fabric.shear_limit * (u.dot(u) * v.dot(v)).sqrt();
    let beyond = |product: f32| 0.5 * ((product - most).max(0.0) + (product + most).min(0.0));
    let (mut e, mut ahead) = (beyond(u.dot(v)), ahead_s);
    if e == 0.0 {
        (e, ahead) = (beyond(u.dot(v) + ahead_s * (u.dot(wv) + v.dot(wu))), 0.0);
    }
    found.stress[2] = 0.5 * fiber_stress(k, e);
    found.plain[2] = 0.25 * fiber_slope(k, e);
    found.plain_ahead[2] = found.plain[2] * ahead;
    found
}

/// As [`limit`] for a limit that is the same in every direction.
fn limit_of_every_direction(fabric: &FabricTable, now: [Vec3; 2], rate: [Vec3; 2], ahead_s: f32) -> Limit {
    let least = fabric.strain_limit[0] * fabric.strain_limit[0];
    let most = fabric.strain_limit[1] * fabric.strain_limit[1];
    let ([u, v], [wu, wv]) = (now, rate);
    let (uu, vv, uv) = (u.dot(u), v.dot(v), u.dot(v));
    let (mut at, mut ahead) = (MohrCircle::new(uu, vv, uv), ahead_s);
    if at.is_within(least, most) {
        // To first order: with the square of the rate, a triangle that turns would seem to stretch.
        let (uu, vv) = (uu + 2.0 * ahead_s * u.dot(wu), vv + 2.0 * ahead_s * v.dot(wv));
        (at, ahead) = (MohrCircle::new(uu, vv, uv + ahead_s * (u.dot(wv) + v.dot(wu))), 0.0);
        if at.is_within(least, most) {
            return Limit::default();
        }
    }
    let [largest, smallest] = at.principal();
    let first = at.wide_direction();
    let mut found = Limit { direction: first, ahead_s: ahead, ..Limit::default() };
    let (mut beyond, mut stiffness) = (0, 0.0f32);
    for (squared, d) in [(largest, first), (smallest, Vec2::new(-first.y, first.x))] {
        let limit = if squared > most {
            most
        } else if squared < least {
            least
        } else {
            continue;
        };
        beyond += 1;
        let stress = fiber_stress(fabric.limit_stiffness, 0.5 * (squared - limit));
        stiffness = stiffness.max(fiber_slope(fabric.limit_stiffness, 0.5 * (squared - limit)));
        found.stress[0] += stress * d.x * d.x;
        found.stress[1] += stress * d.y * d.y;
        found.stress[2] += stress * d.x * d.y;
        found.direction = d;
    }
    if beyond == 2 {
        found.plain = [stiffness, stiffness, 0.5 * stiffness];
        found.plain_ahead = found.plain.map(|k| k * ahead);
    } else {
        found.fiber = stiffness
    }
    found
}

/// Mohr's circle of a symmetric matrix in material space, such as the squares of x_u and x_v and their product.
#[derive(Clone, Copy)]
pub(super) struct MohrCircle {
    mean: f32,
    /// Half the difference of the diagonal.
    half: f32,
    uv: f32,
}

impl MohrCircle {
    pub(super) fn new(uu: f32, vv: f32, uv: f32) -> MohrCircle {
        MohrCircle { mean: 0.5 * (uu + vv), half: 0.5 * (uu - vv), uv }
    }

    fn radius(&self) -> f32 {
        (self.half * self.half + self.uv * self.uv).sqrt()
    }

    /// Principal values, the larger one first.
    pub(super) fn principal(&self) -> [f32; 2] {
        let radius = self.radius();
        [self.mean + radius, self.mean - radius]
    }

    /// Whether both are between `least` and `most`. Nearly all triangles are, and do not need the square root: the
    /// radius is at most the sum of the two.
    pub(super) fn is_within(&self, least: f32, most: f32) -> bool {
        let bound = self.half.abs() + self.uv.abs();
        let is_within = |radius: f32| self.mean + radius <= most && self.mean - radius >= least;
        is_within(bound) || is_within(self.radius())
    }

    /// Direction of the larger one; any if they are alike.
    pub(super) fn wide_direction(&self) -> Vec2 {
        let MohrCircle { half, uv, .. } = *self;
        let radius = self.radius();
        let wide = if half >= 0.0 { Vec2::new(half + radius, uv) } else { Vec2::new(uv, radius - half) };
        let length = wide.length();
        if length > 0.0 { wide / length } else { Vec2::X }
    }
}

/// Fills the record of a triangle's fiber (16 floats), which is taut: what `limit` says at the deformation `now` and
/// its rate.
pub(super) fn fiber_record(
    params: &StepParams,
    element: &TriangleElement,
    limit: &Limit,
    [now, rate]: [[Vec3; 2]; 2],
    record: &mut [f32],
) {
    record.fill(0.0);
    let &Limit { fiber, direction: d, ahead_s, .. } = limit;
    let f = now[0] * d.x + now[1] * d.y;
    for ([u, v], g) in element.corner_weights().iter().zip(record.chunks_exact_mut(4)) {
        (f * (u * d.x + v * d.y)).write_to_slice(&mut g[..3]);
    }
    record[3] = params.step_s * params.step_s * fiber * element.area_m2;
    record[7] = ahead_s * fiber * element.area_m2 * f.dot(rate[0] * d.x + rate[1] * d.y);
}

/// [`TriangleElement`]'s x_u and x_v of positions or velocities of its corners.
#[inline(always)]
pub(super) fn deformation(element: &TriangleElement, x: [Vec3; 3]) -> [Vec3; 2] {
    let (d1, d2) = (x[1] - x[0], x[2] - x[0]);
    let ([u1, u2], [v1, v2]) = (element.weights_u, element.weights_v);
    [d1 * u1 + d2 * u2, d1 * v1 + d2 * v2]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Fabric, StrainLimit};

    #[test]
    fn the_slope_of_the_stress_is_continuous_and_at_most_the_stiffness() {
        let slope = |e: f32| (fiber_stress(1000.0, e + 1e-4) - fiber_stress(1000.0, e - 1e-4)) / 2e-4;
        for e in [-0.02f32, -0.002, -0.001, 0.001, 0.002, 0.006, 0.03] {
            let expected = 1000.0 * (e.abs() / LIMIT_BEND).min(1.0);
            assert!((slope(e) - expected).abs() < 2.0, "at {e}: {} {expected}", slope(e));
            assert!(fiber_slope(1000.0, e) >= expected, "at {e}");
            assert!(fiber_stress(1000.0, e) * e > 0.0);
        }
        assert_eq!(fiber_stress(1000.0, 0.0), 0.0);
    }

    #[test]
    fn only_what_is_beyond_the_limits_is_resisted() {
        let fabric = Fabric {
            strain_limit: Some(StrainLimit::Every([0.9, 1.1])),
            ..Fabric::uniform("f", 0.1, [100.0; 4], 1e-5)
        };
        let fabric = FabricTable::from(&fabric);
        // Stretched by s along the direction at `angle` and by t across it.
        let found = |s: f32, t: f32, angle: f32| {
            let (d, n) = (Vec2::from_angle(angle), Vec2::from_angle(angle).perp());
            let column = |axis: Vec2| Vec3::new(s * d.dot(axis), t * n.dot(axis), 0.0);
            limit(&fabric, [column(Vec2::X), column(Vec2::Y)], [Vec3::ZERO; 2], 0.0)
        };
        assert_eq!(found(1.09, 0.91, 0.4), Limit::default());
        let k = fabric.limit_stiffness;
        let law = fiber_stress(k, 0.5 * (1.2f32.powi(2) - 1.1f32.powi(2)));
        for angle in [0.0, 0.4, 1.3, 2.8] {
            let d = Vec2::from_angle(angle);
            let Limit { stress, fiber, direction, plain, .. } = found(1.2, 1.0, angle);
            assert!((direction.dot(d).abs() - 1.0).abs() < 1e-5 && plain == [0.0; 3] && (fiber - k).abs() < 1e-3 * k);
            let expected = [d.x * d.x, d.y * d.y, d.x * d.y].map(|part| law * part);
            assert!(stress.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3 * law), "{stress:?} {expected:?}");
            // Too short across: the fiber lies there and pushes.
            let short = found(1.0, 0.8, angle);
            assert!(short.direction.dot(d).abs() < 1e-5 && short.stress[0] + short.stress[1] < 0.0);
            // Both: no fiber, but the stiffness in all directions.
            let both = found(1.2, 0.8, angle);
            assert!(both.fiber == 0.0 && (both.plain[0] - k).abs() < 1e-3 * k && both.plain[1] == both.plain[0]);
            assert_eq!(both.plain[2], 0.5 * both.plain[0]);
        }
        // What the velocity leads to within the step counts.
        let ahead = limit(&fabric, [Vec3::X, Vec3::Y], [Vec3::X * 50.0, Vec3::ZERO], 0.004);
        assert!(ahead.stress[0] > 0.0 && ahead.direction.x.abs() > 0.999);
    }

    /// By differences of an energy: the stress is its derivative, the stiffness a bound of the second one.
    #[test]
    fn limits_of_warp_weft_and_shear_are_derivatives_of_an_energy() {
        let along = StrainLimit::Along { warp: Some([0.9, 1.02]), weft: Some([0.95, 1.1]), shear_deg: Some(10.0) };
        let fabric = Fabric { strain_limit: Some(along), ..Fabric::uniform("f", 0.1, [100.0; 4], 1e-5) };
        let fabric = FabricTable::from(&fabric);
        assert!(fabric.is_limited() && !fabric.has_fibers());
        let still = [Vec3::ZERO; 2];
        // Within: 1 % along the warp, 5 % along the weft, sheared by 8 degrees.
        let within = [Vec3::X * 1.01, Vec3::new(8f32.to_radians().sin(), 8f32.to_radians().cos(), 0.0) * 1.05];
        assert_eq!(limit(&fabric, within, still, 0.0), Limit::default());
        let k = f64::from(fabric.limit_stiffness);
        for (u, v) in [
            (Vec3::new(1.05, 0.02, 0.01), Vec3::new(0.3, 1.01, 0.1)),
            (Vec3::new(0.8, 0.1, 0.2), Vec3::new(-0.4, 1.2, 0.0)),
            (Vec3::new(1.021, 0.0, 0.0), Vec3::new(0.18, 0.94, 0.0)),
        ] {
            let found = limit(&fabric, [u, v], still, 0.004);
            assert_eq!(found.fiber, 0.0);
            // The force on x_u is x_u S_uu + x_v S_uv, and the law is cubic, then square in what is beyond.
            let law = |e: f64| {
                let (e, b) = (e.abs(), f64::from(LIMIT_BEND));
                if e < b { k * e.powi(3) / (6.0 * b) } else { k * (e * e / 2.0 - b * e / 2.0 + b * b / 6.0) }
            };
            let (u, v) = (u.as_dvec3(), v.as_dvec3());
            let cap = f64::from(fabric.shear_limit) * (u.length_squared() * v.length_squared()).sqrt();
            let beyond = |x: f64, least: f64, most: f64| (x - most).max(0.0) + (x - least).min(0.0);
            let square =
                |x: f64, [least, most]: [f32; 2]| 0.5 * beyond(x, f64::from(least).powi(2), f64::from(most).powi(2));
            let warp = |x: f64| law(square(x, fabric.warp_limit));
            let weft = |x: f64| law(square(x, fabric.weft_limit));
            let shear = |x: f64| law(0.5 * beyond(x, -cap, cap));
            let slope = |f: &dyn Fn(f64) -> f64, x: f64| (f(x + 1e-5) - f(x - 1e-5)) / 2e-5;
            let curve = |f: &dyn Fn(f64) -> f64, x: f64| (f(x + 1e-4) - 2.0 * f(x) + f(x - 1e-4)) / 1e-8;
            let (uu, vv, uv) = (u.length_squared(), v.length_squared(), u.dot(v));
            // d(uu)/2 = x_u dx_u, so stress = 2 dW/d(uu); stiffness along x_u = 4 d2W/d(uu)2.
            let expected = [2.0 * slope(&warp, uu), 2.0 * slope(&weft, vv), slope(&shear, uv)];
            let stiffness = [4.0 * curve(&warp, uu), 4.0 * curve(&weft, vv), curve(&shear, uv)];
            for i in 0..3 {
                assert!(
                    (f64::from(found.stress[i]) - expected[i]).abs() < 1e-3 * k * 0.1,
                    "{i} {found:?} {expected:?}"
                );
                assert!(f64::from(found.plain[i]) > stiffness[i] - 2e-2 * k, "{i} {found:?} {stiffness:?}");
            }
        }
    }
}
