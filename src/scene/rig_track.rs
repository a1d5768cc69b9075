//! Animation channels of a rig: keyframes of one property of one node [Khronos 2021, Sec. 3.11 and Appendix C].

use serde::{Deserialize, Serialize};

use crate::math::{DQuat, DVec3};

/// How values between two keys are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Interpolation {
    /// Linear; rotations by slerp along the shorter way.
    Linear,
    /// The value of the key before.
    Step,
    /// A cubic Hermite spline; every key has an in-tangent, a value and an out-tangent.
    CubicSpline,
}

/// The property of a node that a channel moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Property {
    Translation,
    Rotation,
    Scale,
    /// Weights of the morph targets of the node's mesh.
    Weights,
}

/// A channel. Its keys are a part of the values of the rig.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Track {
    pub node: u32,
    pub property: Property,
    pub interpolation: Interpolation,
    /// Number of keys, at least 1.
    pub keys: usize,
    /// Numbers per value: 3, 4, or that of the morph targets.
    pub width: usize,
    /// Place of the keys' times (ascending, seconds) among the values of the rig.
    pub times: usize,
    /// Place of the keys' values.
    pub values: usize,
}

impl Track {
    /// The value at a time of the clip; the first before the first key, the last after the last. Rotations have length
    /// 1. `all` = the values of the rig.
    pub(super) fn at(&self, all: &[f32], clip_s: f64, out: &mut Vec<f64>) {
        let times = &all[self.times..self.times + self.keys];
        let after = times.partition_point(|&time| f64::from(time) <= clip_s);
        out.clear();
        // Without two keys around the time, the value is that of one key.
        if after == 0 || after == self.keys || self.interpolation == Interpolation::Step {
            out.extend(self.value(all, after.max(1) - 1));
            return self.unit(out);
        }
        let (a, b) = (after - 1, after);
        let [from, to] = [a, b].map(|key| f64::from(times[key]));
        let s = (clip_s - from) / (to - from);
        match self.interpolation {
            Interpolation::CubicSpline => {
                let (s2, s3) = (s * s, s * s * s);
                let own = [2.0 * s3 - 3.0 * s2 + 1.0, s3 - 2.0 * s2 + s, 3.0 * s2 - 2.0 * s3, s3 - s2];
                let numbers = self
                    .value(all, a)
                    .zip(self.tangent(all, a, 2))
                    .zip(self.value(all, b))
                    .zip(self.tangent(all, b, 0));
                out.extend(
                    numbers.map(|(((va, oa), vb), ib)| {
                        own[0] * va + own[2] * vb + (to - from) * (own[1] * oa + own[3] * ib)
                    }),
                );
            }
            _ if self.property == Property::Rotation => {
                let quat = |key| {
                    let mut numbers = self.value(all, key);
                    DQuat::from_array(std::array::from_fn(|_| numbers.next().unwrap_or_default()))
                };
                out.extend(slerp(unit(quat(a)), unit(quat(b)), s).to_array());
            }
            _ => out.extend(self.value(all, a).zip(self.value(all, b)).map(|(va, vb)| va + s * (vb - va))),
        }
        self.unit(out);
    }

    /// The time of the last key, seconds.
    pub(super) fn end_s(&self, all: &[f32]) -> f64 {
        f64::from(all[self.times + self.keys - 1])
    }

    /// Values per key: a spline has its tangents beside them.
    pub(super) fn values_per_key(&self) -> usize {
        if self.interpolation == Interpolation::CubicSpline { 3 } else { 1 }
    }

    fn unit(&self, value: &mut [f64]) {
        if self.property == Property::Rotation {
            value.copy_from_slice(&unit(DQuat::from_slice(value)).to_array());
        }
    }

    fn value<'a>(&self, all: &'a [f32], key: usize) -> impl Iterator<Item = f64> + 'a {
        let per_key = self.values_per_key();
        self.numbers(all, per_key * key + per_key / 2)
    }

    /// In-tangent (`side` 0) or out-tangent (2) of a key of a spline.
    fn tangent<'a>(&self, all: &'a [f32], key: usize, side: usize) -> impl Iterator<Item = f64> + 'a {
        self.numbers(all, 3 * key + side)
    }

    fn numbers<'a>(&self, all: &'a [f32], place: usize) -> impl Iterator<Item = f64> + 'a {
        let first = self.values + place * self.width;
        all[first..first + self.width].iter().map(|&x| f64::from(x))
    }
}

/// The quaternion with length 1; no rotation if it has no length.
pub(super) fn unit(q: DQuat) -> DQuat {
    let length = q.length();
    if length > 0.0 && length.is_finite() { q * (1.0 / length) } else { DQuat::IDENTITY }
}

/// Spherical interpolation of unit quaternions along the shorter way, to the last digits of f64.
pub(super) fn slerp(a: DQuat, b: DQuat, s: f64) -> DQuat {
    let b = if a.dot(b) < 0.0 { -b } else { b };
    // Half the angle from the chord and its complement, exact for small angles as well.
    let angle = 2.0 * (a - b).length().atan2((a + b).length());
    if angle < 1e-9 {
        return unit(a * (1.0 - s) + b * s);
    }
    let [from, to] = [(1.0 - s) * angle, s * angle].map(|part| part.sin() / angle.sin());
    unit(a * from + b * to)
}

/// Translation, rotation and scale of a node.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Pose {
    pub translation: DVec3,
    pub rotation: DQuat,
    pub scale: DVec3,
}

impl Pose {
    /// Replaces one property by `value`, of which only the given share is taken; the rest is that of the pose.
    pub(super) fn set(&mut self, property: Property, value: &[f64], share: f64) {
        let towards = |from: DVec3| from + share * (DVec3::from_slice(value) - from);
        match property {
            Property::Translation => self.translation = towards(self.translation),
            Property::Scale => self.scale = towards(self.scale),
            Property::Rotation if share < 1.0 => {
                self.rotation = slerp(unit(self.rotation), DQuat::from_slice(value), share);
            }
            Property::Rotation => self.rotation = DQuat::from_slice(value),
            Property::Weights => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(property: Property, interpolation: Interpolation, keys: usize, width: usize) -> Track {
        Track { node: 0, property, interpolation, keys, width, times: 0, values: keys }
    }

    fn at(track: &Track, all: &[f32], clip_s: f64) -> Vec<f64> {
        let mut out = Vec::new();
        track.at(all, clip_s, &mut out);
        out
    }

    #[test]
    fn linear_and_step() {
        let all = [1.0, 3.0, 10.0, 20.0];
        let linear = track(Property::Weights, Interpolation::Linear, 2, 1);
        for (clip_s, value) in [(0.0, 10.0), (1.0, 10.0), (1.5, 12.5), (3.0, 20.0), (9.0, 20.0)] {
            assert_eq!(at(&linear, &all, clip_s), [value], "at {clip_s} s");
        }
        let step = Track { interpolation: Interpolation::Step, ..linear };
        for (clip_s, value) in [(0.0, 10.0), (2.999, 10.0), (3.0, 20.0), (9.0, 20.0)] {
            assert_eq!(at(&step, &all, clip_s), [value], "at {clip_s} s");
        }
        assert_eq!(step.end_s(&all), 3.0);
    }

    #[test]
    fn a_spline_has_its_values_and_tangents_at_its_keys() {
        // Two keys 2 s apart; in-tangent, value, out-tangent of each.
        let all = [0.0, 2.0, 9.0, 1.0, 4.0, -3.0, 5.0, 9.0];
        let spline = track(Property::Scale, Interpolation::CubicSpline, 2, 1);
        assert_eq!([0.0, 2.0, 7.0].map(|t| at(&spline, &all, t)[0]), [1.0, 5.0, 5.0]);
        let slope = |t: f64| (at(&spline, &all, t + 1e-6)[0] - at(&spline, &all, t)[0]) / 1e-6;
        assert!((slope(0.0) - 4.0).abs() < 1e-4 && (slope(2.0 - 1e-6) + 3.0).abs() < 1e-4);
        // Hermite at the middle: (p0 + p1) / 2 + (m0 - m1) T / 8.
        assert!((at(&spline, &all, 1.0)[0] - (3.0 + 7.0 * 2.0 / 8.0)).abs() < 1e-12);
    }

    #[test]
    fn rotations_take_the_shorter_way_at_constant_speed() {
        let [a, b] = [0.2, 1.4].map(DQuat::from_rotation_y);
        for s in [0.0, 0.25, 0.5, 1.0] {
            let expected = DQuat::from_rotation_y(0.2 + 1.2 * s);
            for other in [b, -b] {
                let got = slerp(a, other, s);
                assert!((got - expected).length() < 1e-15, "{s}: {got}");
            }
        }
        let near = DQuat::from_rotation_y(0.2 + 1e-12);
        assert!((slerp(a, near, 0.5) - a).length() < 1e-12);
        let all: Vec<f32> = [0.0, 1.0].into_iter().chain([0.0, 0.0, 0.0, 2.0, 0.0, 0.0, -3.0, 0.0]).collect();
        let track = track(Property::Rotation, Interpolation::Linear, 2, 4);
        let half = at(&track, &all, 0.5);
        assert!((half[2].abs() - 0.5f64.sqrt()).abs() < 1e-15 && (half[3].abs() - 0.5f64.sqrt()).abs() < 1e-15);
        assert_eq!(unit(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0)), DQuat::IDENTITY);
    }
}
