//! Keyframed motions: evaluation in f64, because a keyframe far from the origin times a small step loses digits in f32.

use crate::math::{DAffine3, DMat3, DQuat, DVec3, Vec3};

use super::{Keyframe, Motion};

impl Keyframe {
    /// The keyframe that moves nothing.
    pub fn identity(time_s: f64) -> Keyframe {
        Keyframe { time_s, translation_m: DVec3::ZERO, rotation: DQuat::IDENTITY, scale: 1.0, pivot_m: DVec3::ZERO }
    }

    /// x -> pivot + rotation * (scale * (x - pivot)) + translation.
    pub fn transform(&self) -> DAffine3 {
        let matrix = DMat3::from_quat(self.rotation) * self.scale;
        DAffine3::from_mat3_translation(matrix, self.pivot_m + self.translation_m - matrix * self.pivot_m)
    }
}

impl Motion {
    /// The transform at a time: translation, scale and pivot linear between the keyframes, rotation by slerp (the shorter
    /// way round), constant before the first and after the last. No keyframes = no motion.
    pub fn transform_at(&self, time_s: f64) -> DAffine3 {
        let after = self.keyframes.partition_point(|key| key.time_s <= time_s);
        let (Some(a), Some(b)) = (self.keyframes.get(after.saturating_sub(1)), self.keyframes.get(after)) else {
            return self.keyframes.last().map_or(DAffine3::IDENTITY, Keyframe::transform);
        };
        if after == 0 {
            return a.transform();
        }
        let s = (time_s - a.time_s) / (b.time_s - a.time_s);
        Keyframe {
            time_s,
            translation_m: a.translation_m.lerp(b.translation_m, s),
            rotation: a.rotation.slerp(b.rotation, s),
            scale: a.scale + s * (b.scale - a.scale),
            pivot_m: a.pivot_m.lerp(b.pivot_m, s),
        }
        .transform()
    }

    /// Where the motion has taken a point that starts at `start` by a time.
    pub fn apply(&self, time_s: f64, start: Vec3) -> Vec3 {
        self.transform_at(time_s).transform_point3(start.as_dvec3()).as_vec3()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linear_between_the_keyframes_and_constant_outside() {
        let key = |time_s, x| Keyframe { translation_m: DVec3::new(x, 0.0, 0.0), ..Keyframe::identity(time_s) };
        let motion = Motion { keyframes: vec![key(1.0, 0.0), key(2.0, 4.0), key(4.0, 0.0)] };
        for (time_s, x) in [(-1.0, 0.0), (1.0, 0.0), (1.25, 1.0), (2.0, 4.0), (3.0, 2.0), (4.0, 0.0), (9.0, 0.0)] {
            assert_eq!(motion.apply(time_s, Vec3::ONE), Vec3::new(1.0 + x, 1.0, 1.0), "at {time_s} s");
        }
        assert_eq!(Motion { keyframes: vec![] }.apply(3.0, Vec3::ONE), Vec3::ONE);
    }

    #[test]
    fn rotation_and_scale_about_a_pivot() {
        let half_turn = DQuat::from_rotation_z(std::f64::consts::PI);
        let end = Keyframe { rotation: half_turn, scale: 3.0, pivot_m: DVec3::X, ..Keyframe::identity(1.0) };
        let motion = Motion { keyframes: vec![Keyframe { pivot_m: DVec3::X, ..Keyframe::identity(0.0) }, end] };
        assert!(motion.apply(1.0, Vec3::new(2.0, 0.0, 5.0)).distance(Vec3::new(-2.0, 0.0, 15.0)) < 1e-6);
        assert!(motion.apply(0.5, Vec3::new(2.0, 0.0, 0.0)).distance(Vec3::new(1.0, 2.0, 0.0)) < 1e-6);
        assert_eq!(motion.apply(0.5, Vec3::X), Vec3::X);
    }
}
