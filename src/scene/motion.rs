//! Keyframed motions. They are evaluated in f64, because f32 loses digits for keyframes far from the origin and small
//! steps.

use crate::math::{DAffine3, DMat3, DQuat, DVec3, Vec3};

/// A rigid motion with scaling, given by keyframes. It is linear between keyframes (rotation by angle or slerp) and
/// constant outside. [`Motion::transform_at`] evaluates it.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Motion {
    /// Keyframes in ascending time.
    pub keyframes: Vec<Keyframe>,
}

/// A keyframe: x -> pivot + rotation * (scale * (x - pivot)) + translation.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Keyframe {
    /// Seconds since the start of the run.
    pub time_s: f64,
    /// Translation, applied last, meters.
    pub translation_m: crate::math::DVec3,
    /// Unit quaternion.
    pub rotation: crate::math::DQuat,
    /// The rotation as unit axis and angle in radians, if it was given so. The angle can exceed a full turn.
    pub turn: Option<(crate::math::DVec3, f64)>,
    /// Scale factor about the pivot, above 0.
    pub scale: f64,
    /// Center of rotation and scale, meters.
    pub pivot_m: crate::math::DVec3,
}

impl Keyframe {
    /// A keyframe without translation, rotation or scaling.
    pub fn identity(time_s: f64) -> Keyframe {
        Keyframe {
            time_s,
            translation_m: DVec3::ZERO,
            rotation: DQuat::IDENTITY,
            turn: None,
            scale: 1.0,
            pivot_m: DVec3::ZERO,
        }
    }

    /// This keyframe with a rotation by any angle about a unit axis.
    pub fn turned(self, axis: DVec3, angle_rad: f64) -> Keyframe {
        Keyframe { rotation: DQuat::from_axis_angle(axis, angle_rad), turn: Some((axis, angle_rad)), ..self }
    }

    /// The angle about `axis`, if the keyframe rotates about it or not at all.
    fn angle_about(&self, axis: DVec3) -> Option<f64> {
        match self.turn {
            Some((own, angle)) => (own == axis).then_some(angle),
            None => (self.rotation == DQuat::IDENTITY).then_some(0.0),
        }
    }

    /// The rotation at fraction `s` of the way to `next`.
    fn rotation_towards(&self, next: &Keyframe, s: f64) -> DQuat {
        if let Some((axis, _)) = self.turn.or(next.turn)
            && let (Some(from), Some(to)) = (self.angle_about(axis), next.angle_about(axis))
        {
            return DQuat::from_axis_angle(axis, from + s * (to - from));
        }
        self.rotation.slerp(next.rotation, s)
    }

    /// x -> pivot + rotation * (scale * (x - pivot)) + translation.
    pub fn transform(&self) -> DAffine3 {
        let matrix = DMat3::from_quat(self.rotation) * self.scale;
        DAffine3::from_mat3_translation(matrix, self.pivot_m + self.translation_m - matrix * self.pivot_m)
    }
}

impl Motion {
    /// The transform at a time. Translation, scale and pivot are linear between keyframes. The rotation is linear in
    /// the angle if both keyframes turn about the same axis (any number of turns), else it is a slerp along the shorter
    /// way. Before the first and after the last keyframe the transform is constant. Without keyframes it is the
    /// identity.
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
            rotation: a.rotation_towards(b, s),
            turn: None,
            scale: a.scale + s * (b.scale - a.scale),
            pivot_m: a.pivot_m.lerp(b.pivot_m, s),
        }
        .transform()
    }

    /// The same motion in coordinates relative to `origin_m`, for points whose start positions are relative to `base_m`.
    pub(super) fn relative_to(mut self, base_m: DVec3, origin_m: DVec3) -> Motion {
        // Without rotation and scaling a pivot does nothing; moved, it would add rounding errors of its size.
        let turns = self.keyframes.iter().any(|key| key.rotation != DQuat::IDENTITY || key.scale != 1.0);
        for key in &mut self.keyframes {
            key.translation_m += base_m - origin_m;
            if turns {
                key.pivot_m -= base_m;
            }
        }
        self
    }

    /// Position at `time_s` of a point that starts at `start`.
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
    fn turns_about_one_axis_go_by_angle() {
        let full = std::f64::consts::TAU;
        let still = Keyframe::identity;
        // 2.5 turns, then 1 turn back. The first keyframe has no rotation.
        let keyframes =
            vec![still(0.0), still(10.0).turned(DVec3::Y, 2.5 * full), still(14.0).turned(DVec3::Y, 1.5 * full)];
        let motion = Motion { keyframes };
        for (time_s, turns) in
            [(0.0, 0.0), (1.0, 0.25), (3.0, 0.75), (8.0, 2.0), (10.0, 2.5), (13.0, 1.75), (99.0, 1.5)]
        {
            let (sin, cos) = (turns * full).sin_cos();
            let expected = Vec3::new(cos as f32, 0.0, -sin as f32);
            assert!(motion.apply(time_s, Vec3::X).distance(expected) < 1e-6, "at {time_s} s");
        }
        // With another axis the rotation takes the shorter way.
        let other = Motion { keyframes: vec![still(0.0).turned(DVec3::Y, 0.1), still(1.0).turned(DVec3::X, 0.1)] };
        let slerp = DQuat::from_rotation_y(0.1).slerp(DQuat::from_rotation_x(0.1), 0.5);
        assert!(other.apply(0.5, Vec3::Z).distance((slerp * DVec3::Z).as_vec3()) < 1e-6);
    }

    #[test]
    fn the_same_places_relative_to_a_local_origin() {
        let (base, origin) = (DVec3::new(10_000.0, 8.0, 0.0), DVec3::new(9_000.0, 0.0, -4_000.0));
        let key = Keyframe { translation_m: DVec3::new(3.0, 0.0, 1.0), pivot_m: base, ..Keyframe::identity(2.0) };
        let turning = Motion {
            keyframes: vec![Keyframe { pivot_m: base, ..Keyframe::identity(0.0) }, key.turned(DVec3::Y, 7.0)],
        };
        let sliding = Motion { keyframes: vec![Keyframe::identity(0.0), Keyframe { pivot_m: DVec3::ZERO, ..key }] };
        for motion in [turning, sliding] {
            let local = motion.clone().relative_to(base, origin);
            for time_s in [0.0, 0.7, 2.0] {
                let p = DVec3::new(1.0, 2.0, 3.0);
                let world = motion.transform_at(time_s).transform_point3(p + base);
                let there = local.transform_at(time_s).transform_point3(p);
                assert!((there + origin).distance(world) < 1e-8, "at {time_s} s");
            }
        }
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
