//! Rigid motions that fit given displacements. Vertices that share one rigid motion never meet on the way, because at
//! every time their straight paths are an affine map of the start positions, which is invertible below half a turn.

use crate::math::{DMat3, DVec3};

/// Largest turn of a fitted motion per correction, radians.
const MOST_TURN: f64 = 0.5;
/// Corrections of a fit; each squares the error.
const CORRECTIONS: u32 = 12;

/// `x -> rotation * (x - from) + to`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct RigidMotion {
    pub rotation: DMat3,
    pub from: DVec3,
    pub to: DVec3,
}

impl RigidMotion {
    /// The motion that leaves every point where it is.
    pub(super) const STILL: RigidMotion = RigidMotion { rotation: DMat3::IDENTITY, from: DVec3::ZERO, to: DVec3::ZERO };

    pub(super) fn apply(&self, x: DVec3) -> DVec3 {
        if self.is_still() { x } else { self.rotation * (x - self.from) + self.to }
    }

    pub(super) fn is_still(&self) -> bool {
        self.rotation == DMat3::IDENTITY && self.from == self.to
    }
}

/// A point at the start and the end of the step, and its mass.
pub(super) type MovingPoint = (DVec3, DVec3, f64);

/// The rigid motion that keeps linear momentum and, to first order in the turn, angular momentum of `points` over the step.
pub(super) fn momentum_preserving(points: &[MovingPoint]) -> RigidMotion {
    corrected(points, 1)
}

/// The rigid motion that all points share up to `tolerance_m`; none if they do not move as one body.
pub(super) fn shared(points: &[MovingPoint], tolerance_m: f64) -> Option<RigidMotion> {
    if points.iter().all(|(start, end, _)| start == end) {
        return Some(RigidMotion::STILL);
    }
    // A plain translation is kept free of rounding in the rotation.
    let shift = points[0].1 - points[0].0;
    let translation = RigidMotion { to: shift, ..RigidMotion::STILL };
    [translation, corrected(points, CORRECTIONS)]
        .into_iter()
        .find(|motion| points.iter().all(|(start, end, _)| (motion.apply(*start) - *end).length() <= tolerance_m))
}

/// Least-squares fit by repeated small turns.
fn corrected(points: &[MovingPoint], corrections: u32) -> RigidMotion {
    let mass: f64 = points.iter().map(|p| p.2).sum();
    let from = points.iter().map(|p| p.0 * p.2).sum::<DVec3>() / mass;
    let to = points.iter().map(|p| p.1 * p.2).sum::<DVec3>() / mass;
    let mut rotation = DMat3::IDENTITY;
    for _ in 0..corrections {
        let mut inertia = DMat3::ZERO;
        let mut angular = DVec3::ZERO;
        for (start, end, m) in points {
            let arm = rotation * (*start - from);
            inertia += *m * (DMat3::IDENTITY * arm.length_squared() - outer(arm));
            angular += *m * arm.cross(*end - to);
        }
        // Points on one line have no inertia about it: a trace of it makes the turn about it zero.
        let trace = inertia.x_axis.x + inertia.y_axis.y + inertia.z_axis.z;
        if trace <= 0.0 {
            break;
        }
        let turn = (inertia + DMat3::IDENTITY * (1e-12 * trace)).inverse() * angular;
        let angle = turn.length();
        if angle.is_nan() || angle == 0.0 {
            break;
        }
        rotation = DMat3::from_axis_angle(turn / angle, angle.min(MOST_TURN)) * rotation;
    }
    RigidMotion { rotation, from, to }
}

fn outer(v: DVec3) -> DMat3 {
    DMat3::from_cols(v * v.x, v * v.y, v * v.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moved(by: impl Fn(DVec3) -> DVec3) -> Vec<MovingPoint> {
        let corners = [DVec3::ZERO, DVec3::X, DVec3::new(0.3, 2.0, 0.0), DVec3::new(0.1, 0.2, 0.7)];
        corners.iter().enumerate().map(|(i, &x)| (x, by(x), 1.0 + i as f64)).collect()
    }

    #[test]
    fn a_shared_motion_is_found_and_another_is_not() {
        let turn = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 1.2);
        let points = moved(|x| turn * x + DVec3::new(5.0, 0.0, -1.0));
        let motion = shared(&points, 1e-9).expect("one body");
        assert!((motion.apply(DVec3::Y) - (turn * DVec3::Y + DVec3::new(5.0, 0.0, -1.0))).length() < 1e-9);
        assert_eq!(shared(&moved(|x| x * 1.1), 1e-3), None);
        assert!(shared(&moved(|x| x), 0.0).expect("standing still").is_still());
        // Two points, one point: any motion that takes them along.
        assert!(shared(&points[..2], 1e-9).is_some() && shared(&points[..1], 0.0).is_some());
    }

    #[test]
    fn momentum_is_kept() {
        let points = moved(|x| x * 1.05 + DVec3::new(0.01 * x.y, -0.02 * x.x, 0.1));
        let motion = momentum_preserving(&points);
        let momentum = |end: &dyn Fn(&MovingPoint) -> DVec3| points.iter().map(|p| (end(p) - p.0) * p.2).sum::<DVec3>();
        let (before, after) = (momentum(&|p| p.1), momentum(&|p| motion.apply(p.0)));
        assert!((before - after).length() < 1e-12, "{before} {after}");
        let center = motion.from;
        let angular = |end: &dyn Fn(&MovingPoint) -> DVec3| {
            points.iter().map(|p| (p.0 - center).cross(end(p) - p.0) * p.2).sum::<DVec3>()
        };
        let (before, after) = (angular(&|p| p.1), angular(&|p| motion.apply(p.0)));
        assert!((before - after).length() < 0.01 * before.length(), "{before} {after}");
    }
}
