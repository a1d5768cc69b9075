//! Force fields: accelerations that depend on the place and the time, besides gravity and wind.

use serde::{Deserialize, Serialize};

use crate::math::DVec3;

use super::over_time::OverTime;

/// A force field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ForceField {
    /// Its shape in space.
    pub shape: FieldShape,
    /// Acceleration where the shape is 1, m/s^2.
    pub strength_m_s2: f64,
    /// In place of `strength_m_s2`.
    pub strength_over_time: Option<OverTime<f64>>,
    /// It acts from this time, seconds.
    pub start_s: f64,
    /// It acts until this time, seconds (infinite = always).
    pub end_s: f64,
}

/// How a force field is distributed in space. Points are relative to the scene's local origin, meters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum FieldShape {
    /// Away from a point, falling evenly to 0 at `radius_m` (infinite: 1 everywhere).
    Radial {
        /// The point.
        center_m: DVec3,
        /// Where it ends.
        radius_m: f64,
    },
    /// Around an axis through a point, counterclockwise seen from its tip, falling evenly to 0 at `radius_m` from the
    /// axis.
    Vortex {
        /// A point of the axis.
        center_m: DVec3,
        /// Unit vector.
        axis: DVec3,
        /// Where it ends.
        radius_m: f64,
    },
    /// Smooth noise in every component, from -1 to 1.
    Turbulence {
        /// Size of an eddy, meters.
        scale_m: f64,
        /// Time in which it becomes another one, seconds (infinite = it stands still).
        change_s: f64,
        /// Which noise.
        seed: u64,
        /// The scene's local origin, so that the noise stands still in the world, meters.
        origin_m: DVec3,
    },
}

impl ForceField {
    /// Acceleration at a point relative to the local origin (meters) and a time (seconds), m/s^2.
    pub fn acceleration_m_s2(&self, point_m: DVec3, time_s: f64) -> DVec3 {
        if time_s < self.start_s || time_s > self.end_s {
            return DVec3::ZERO;
        }
        let strength = self.strength_over_time.as_ref().map_or(self.strength_m_s2, |keys| keys.at(time_s));
        strength * self.shape.at(point_m, time_s)
    }
}

impl FieldShape {
    fn at(&self, point_m: DVec3, time_s: f64) -> DVec3 {
        match self {
            FieldShape::Radial { center_m, radius_m } => falling(point_m - *center_m, *radius_m),
            FieldShape::Vortex { center_m, axis, radius_m } => {
                let from_center = point_m - *center_m;
                axis.cross(falling(from_center - *axis * axis.dot(from_center), *radius_m))
            }
            FieldShape::Turbulence { scale_m, change_s, seed, origin_m } => {
                let at = (point_m + *origin_m) / *scale_m;
                let at = [at.x, at.y, at.z, time_s / *change_s];
                DVec3::from_array([0, 1, 2].map(|component| noise(at, 3 * seed + component)))
            }
        }
    }
}

/// The direction of `way_m`, times 1 at its start down to 0 at `radius_m`.
fn falling(way_m: DVec3, radius_m: f64) -> DVec3 {
    way_m.normalize_or_zero() * (1.0 - way_m.length() / radius_m).max(0.0)
}

/// Value noise: random values from -1 to 1 at whole numbers, with continuous first and second derivatives between them
/// [Perlin 2002].
fn noise(at: [f64; 4], seed: u64) -> f64 {
    let cell = at.map(f64::floor);
    let part = [0, 1, 2, 3].map(|i| {
        let t = at[i] - cell[i];
        t * t * t * (t * (6.0 * t - 15.0) + 10.0)
    });
    (0..16)
        .map(|corner: u32| {
            let is_far = |i: usize| corner >> i & 1 == 1;
            let weight: f64 = (0..4).map(|i| if is_far(i) { part[i] } else { 1.0 - part[i] }).product();
            let hash =
                (0..4).fold(seed, |hash, i| mixed(hash ^ (cell[i] + f64::from(u8::from(is_far(i)))) as i64 as u64));
            weight * ((hash >> 11) as f64 / (1u64 << 52) as f64 - 1.0)
        })
        .sum()
}

/// A number that seems to have nothing to do with `value` [Steele et al. 2014].
fn mixed(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field(shape: FieldShape) -> ForceField {
        ForceField { shape, strength_m_s2: 2.0, strength_over_time: None, start_s: 1.0, end_s: 5.0 }
    }

    #[test]
    fn fields_point_where_they_should() {
        let center_m = DVec3::new(1.0, 0.0, 0.0);
        let radial = field(FieldShape::Radial { center_m, radius_m: 4.0 });
        assert_eq!(radial.acceleration_m_s2(DVec3::new(3.0, 0.0, 0.0), 2.0), DVec3::X);
        assert_eq!(radial.acceleration_m_s2(DVec3::new(6.0, 0.0, 0.0), 2.0), DVec3::ZERO);
        assert_eq!(radial.acceleration_m_s2(center_m, 2.0), DVec3::ZERO);
        for time_s in [0.9, 5.1] {
            assert_eq!(radial.acceleration_m_s2(DVec3::ZERO, time_s), DVec3::ZERO);
        }
        let vortex = field(FieldShape::Vortex { center_m, axis: DVec3::Y, radius_m: f64::INFINITY });
        let found = vortex.acceleration_m_s2(DVec3::new(2.0, 7.0, 0.0), 2.0);
        assert!((found - DVec3::new(0.0, 0.0, -2.0)).length() < 1e-12, "{found}");
    }

    #[test]
    fn noise_is_smooth_bounded_and_as_often_up_as_down() {
        let turbulence =
            |seed| field(FieldShape::Turbulence { scale_m: 0.3, change_s: 0.5, seed, origin_m: DVec3::ZERO });
        let (one, other) = (turbulence(7), turbulence(8));
        let (mut sum, mut squares, mut steepest, mut apart) = (DVec3::ZERO, 0.0, 0.0f64, 0.0);
        let places = 4_000;
        for i in 0..places {
            let point = DVec3::new(0.137, -0.091, 0.113) * f64::from(i);
            let (time_s, step) = (1.0 + 0.001 * f64::from(i), DVec3::splat(1e-6));
            let found = one.acceleration_m_s2(point, time_s);
            assert!(found.abs().max_element() <= 2.0);
            sum += found;
            squares += found.length_squared();
            steepest = steepest.max((one.acceleration_m_s2(point + step, time_s) - found).length() / step.length());
            apart += (other.acceleration_m_s2(point, time_s) - found).length_squared();
        }
        let (mean, mean_square) = (sum / f64::from(places), squares / f64::from(places));
        assert!(mean.length() < 0.1 && mean_square > 0.2, "{mean} {mean_square}");
        // A component changes by at most 2 * 15 / 8 per eddy and direction.
        assert!(steepest < 2.0 * 2.0 * 1.875 * 3.0 / 0.3, "{steepest}");
        assert!(apart / f64::from(places) > mean_square, "another seed is another noise");
    }
}
