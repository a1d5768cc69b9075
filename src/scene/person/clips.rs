//! What the person does: poses as formulas of time. Every clip begins in the rest pose and at rest.

use std::f64::consts::TAU;

use super::anatomy::{
    CHEST, COLLAR, FOOT, FOREARM, HEAD, JOINTS, NECK, PELVIS, SHIN, SPINE, THIGH, UPPER_ARM, skeleton, soles,
};
use crate::math::{DAffine3, DQuat, DVec3};

/// Turns of the joints in their parents' axes, and the way of the pelvis from its place at rest.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Pose {
    pub root: DVec3,
    pub turns: [DQuat; JOINTS],
}

/// A clip: its name, its length in seconds and its pose at a time.
pub(super) type Clip = (&'static str, f64, fn(f64) -> Pose);

/// All clips.
pub(super) const CLIPS: [Clip; 7] = [
    ("stand", 4.0, stand),
    ("spin", 6.0, spin),
    ("walk", 6.0, walk),
    ("kneel", 4.0, kneel),
    ("kick", 4.0, kick),
    ("sit", 4.0, sit),
    ("bow", 4.0, bow),
];

/// Over this height the foot that carries the body changes to the other.
const STEP_M: f64 = 0.004;

impl Pose {
    fn rest() -> Pose {
        Pose { root: DVec3::ZERO, turns: [DQuat::IDENTITY; JOINTS] }
    }

    /// Turns a joint further about x (forward), y (to the left) and z (over to its right side), degrees; z first.
    fn turn(&mut self, joint: usize, [x, y, z]: [f64; 3]) {
        let [x, y, z] = [x, y, z].map(f64::to_radians);
        let turn = DQuat::from_rotation_y(y) * DQuat::from_rotation_x(x) * DQuat::from_rotation_z(z);
        self.turns[joint] *= turn;
    }

    /// Both arms go down by this many degrees.
    fn lower_arms(&mut self, degrees: f64) {
        self.turn(UPPER_ARM[0], [0.0, 0.0, -degrees]);
        self.turn(UPPER_ARM[1], [0.0, 0.0, degrees]);
    }

    /// Both legs close by this many degrees; the soles stay level.
    fn close_legs(&mut self, degrees: f64) {
        for (side, sign) in [(0, -1.0), (1, 1.0)] {
            self.turn(THIGH[side], [0.0, 0.0, sign * degrees]);
            self.turn(FOOT[side], [0.0, 0.0, -sign * degrees]);
        }
    }

    /// A leg bends: thigh forward, knee back, the sole tilts toes down, degrees.
    fn bend_leg(&mut self, side: usize, thigh: f64, knee: f64, sole: f64) {
        self.turn(THIGH[side], [-thigh, 0.0, 0.0]);
        self.turn(SHIN[side], [knee, 0.0, 0.0]);
        self.turn(FOOT[side], [thigh - knee + sole, 0.0, 0.0]);
    }

    /// From a point at rest to where its joint has it.
    fn transforms(&self) -> [DAffine3; JOINTS] {
        let mut globals = [DAffine3::IDENTITY; JOINTS];
        for (i, joint) in skeleton().iter().enumerate() {
            let about = DAffine3::from_translation(joint.at) * DAffine3::from_quat(self.turns[i]);
            let own = about * DAffine3::from_translation(-joint.at);
            globals[i] = match joint.parent {
                Some(parent) => globals[parent] * own,
                None => DAffine3::from_translation(self.root) * own,
            };
        }
        globals
    }

    /// The pose with its lowest sole or knee on the floor.
    fn grounded(mut self) -> Pose {
        self.root.y += lowest(&Pose::rest()) - lowest(&self);
        self
    }

    /// The pose moved level so that a point of a joint is above or below its place at rest.
    fn anchored(mut self, points: [(usize, DVec3); 2]) -> Pose {
        let globals = self.transforms();
        let way: DVec3 =
            points.iter().map(|&(joint, at)| globals[joint].transform_point3(at) - at).sum::<DVec3>() / 2.0;
        self.root -= DVec3::new(way.x, 0.0, way.z);
        self
    }
}

/// Height of what the body stands on, smooth where that changes.
fn lowest(pose: &Pose) -> f64 {
    let globals = pose.transforms();
    let heights: Vec<f64> =
        soles().iter().map(|&(joint, center, radius)| globals[joint].transform_point3(center).y - radius).collect();
    let least = heights.iter().copied().fold(f64::INFINITY, f64::min);
    least - STEP_M * heights.iter().map(|height| ((least - height) / STEP_M).exp()).sum::<f64>().ln()
}

/// From 0 to 1 between two times, without a jump in speed or acceleration.
fn ramp(time_s: f64, from_s: f64, to_s: f64) -> f64 {
    let u = ((time_s - from_s) / (to_s - from_s)).clamp(0.0, 1.0);
    u * u * u * (u * (6.0 * u - 15.0) + 10.0)
}

/// Up to 1 and down again.
fn bump(time_s: f64, [up, top, still, down]: [f64; 4]) -> f64 {
    ramp(time_s, up, top) * (1.0 - ramp(time_s, still, down))
}

/// Stands and sways a little. Ends as it begins.
fn stand(time_s: f64) -> Pose {
    let mut pose = Pose::rest();
    let (slow, wave) =
        ((1.0 - (TAU * time_s / 4.0).cos()) / 2.0, (TAU * time_s / 4.0).sin() * (TAU * time_s / 8.0).sin());
    pose.turn(SPINE, [2.0 * slow, 3.0 * wave, 1.5 * wave]);
    pose.turn(CHEST, [-1.0 * slow, 3.0 * wave, 0.0]);
    pose.turn(HEAD, [2.0 * slow, 6.0 * wave, 0.0]);
    pose.lower_arms(10.0 * slow);
    pose.grounded()
}

/// Turns three times on the spot, arms up, and stands.
fn spin(time_s: f64) -> Pose {
    let mut pose = Pose::rest();
    let up = bump(time_s, [0.1, 1.2, 3.6, 5.2]);
    pose.turn(PELVIS, [0.0, 1080.0 * ramp(time_s, 0.3, 4.7), 0.0]);
    pose.close_legs(2.5 * up);
    pose.lower_arms(-32.0 * up);
    pose.turn(SPINE, [0.0, 5.0 * up, 0.0]);
    pose.turn(CHEST, [-3.0 * up, 5.0 * up, 0.0]);
    pose.turn(HEAD, [-4.0 * up, 12.0 * up, 0.0]);
    pose.grounded()
}

/// Walks straight ahead.
fn walk(time_s: f64) -> Pose {
    const STEPS_PER_S: f64 = 0.85;
    const SPEED_M_S: f64 = 1.05;
    let share = ramp(time_s, 0.2, 1.4);
    let mut pose = Pose::rest();
    pose.close_legs(3.0 * share);
    pose.lower_arms(24.0 * share);
    for (side, start) in [(0, 0.0), (1, 0.5)] {
        let phase = TAU * (STEPS_PER_S * time_s + start);
        let swing = ((1.0 + (phase + 0.35).cos()) / 2.0).powi(2);
        let (thigh, knee) = (share * (23.0 * phase.sin() + 5.0), share * (9.0 + 46.0 * swing));
        let sole = share * (14.0 * swing * (phase + 0.35).sin().powi(2) - 4.0 * phase.sin());
        pose.bend_leg(side, thigh, knee, sole);
        pose.turn(UPPER_ARM[side], [share * 20.0 * phase.sin(), 0.0, 0.0]);
        pose.turn(FOREARM[side], [-share * 14.0, 0.0, 0.0]);
    }
    let phase = TAU * STEPS_PER_S * time_s;
    pose.turn(PELVIS, [0.0, -share * 5.0 * phase.sin(), share * 2.0 * phase.cos()]);
    pose.turn(CHEST, [share * 2.0, share * 9.0 * phase.sin(), -share * 2.0 * phase.cos()]);
    // The speed is a ramp over 1.7 s; this is its integral.
    let (since, ramp_s) = (time_s - 0.2, 1.7);
    let u = (since / ramp_s).clamp(0.0, 1.0);
    let way_s = ramp_s * u.powi(4) * (u * u - 3.0 * u + 2.5) + (since - ramp_s).max(0.0);
    pose.root.z = SPEED_M_S * way_s;
    pose.grounded()
}

/// Goes down on the right knee.
fn kneel(time_s: f64) -> Pose {
    let down = ramp(time_s, 0.3, 2.3);
    let mut pose = Pose::rest();
    pose.bend_leg(0, 84.0 * down, 84.0 * down, 0.0);
    pose.bend_leg(1, -6.0 * down, 82.0 * down, 82.0 * down);
    pose.lower_arms(14.0 * down);
    pose.turn(SPINE, [6.0 * down, 0.0, 0.0]);
    pose.turn(CHEST, [4.0 * down, 0.0, 0.0]);
    pose.turn(NECK, [8.0 * down, 0.0, 0.0]);
    pose.grounded()
}

/// Raises the right knee, kicks forward, puts the foot down; strikes with the left fist and with the right.
fn kick(time_s: f64) -> Pose {
    let mut pose = Pose::rest();
    let raised = bump(time_s, [0.5, 1.0, 1.45, 2.0]);
    let out = bump(time_s, [0.92, 1.18, 1.25, 1.5]);
    let ready = ramp(time_s, 0.1, 0.6);
    pose.bend_leg(0, 10.0 * ready, 18.0 * ready, 0.0);
    pose.bend_leg(1, 74.0 * raised, 92.0 * raised - 84.0 * out, 30.0 * out);
    pose.turn(PELVIS, [-10.0 * out, 10.0 * out, 0.0]);
    pose.turn(SPINE, [-6.0 * out + 4.0 * ready, 0.0, 0.0]);
    // Arms go forward by the turn about y, and bend at the elbow.
    for (side, sign, strike) in
        [(0, 1.0, bump(time_s, [2.0, 2.3, 2.4, 2.8])), (1, -1.0, bump(time_s, [2.6, 2.9, 3.0, 3.5]))]
    {
        pose.turn(
            UPPER_ARM[side],
            [0.0, -sign * (38.0 * ready + 34.0 * strike), sign * (26.0 * strike - 10.0 * ready)],
        );
        pose.turn(FOREARM[side], [0.0, -sign * (62.0 * ready - 56.0 * strike), 0.0]);
        pose.turn(COLLAR[side], [0.0, -sign * 8.0 * strike, 0.0]);
        pose.turn(CHEST, [0.0, -sign * 14.0 * strike, 0.0]);
    }
    let foot = DVec3::new(0.160, 0.040, -0.040);
    pose.anchored([(FOOT[0], foot); 2]).grounded()
}

/// Sits down on what is behind at knee height.
fn sit(time_s: f64) -> Pose {
    let down = ramp(time_s, 0.3, 2.2);
    let lean = bump(time_s, [0.3, 1.2, 1.4, 2.8]);
    let mut pose = Pose::rest();
    for side in [0, 1] {
        pose.bend_leg(side, 82.0 * down, 82.0 * down, 0.0);
    }
    pose.lower_arms(-6.0 * down);
    pose.turn(PELVIS, [14.0 * lean, 0.0, 0.0]);
    for side in [0, 1] {
        pose.turn(THIGH[side], [-14.0 * lean, 0.0, 0.0]);
    }
    pose.turn(SPINE, [10.0 * lean, 0.0, 0.0]);
    pose.turn(CHEST, [6.0 * lean, 0.0, 0.0]);
    let foot = |sign: f64| DVec3::new(sign * 0.160, 0.040, -0.040);
    pose.anchored([(FOOT[0], foot(1.0)), (FOOT[1], foot(-1.0))]).grounded()
}

/// Bows from the hips and stands up again.
fn bow(time_s: f64) -> Pose {
    let down = bump(time_s, [0.2, 1.4, 2.2, 3.8]);
    let mut pose = Pose::rest();
    pose.close_legs(2.0 * down);
    pose.turn(PELVIS, [26.0 * down, 0.0, 0.0]);
    for side in [0, 1] {
        pose.turn(THIGH[side], [-26.0 * down, 0.0, 0.0]);
    }
    pose.turn(SPINE, [10.0 * down, 0.0, 0.0]);
    pose.turn(CHEST, [8.0 * down, 0.0, 0.0]);
    pose.turn(NECK, [10.0 * down, 0.0, 0.0]);
    pose.lower_arms(16.0 * down);
    let foot = |sign: f64| DVec3::new(sign * 0.160, 0.040, -0.040);
    pose.anchored([(FOOT[0], foot(1.0)), (FOOT[1], foot(-1.0))]).grounded()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clips_begin_at_rest_move_smoothly_and_stand_on_the_floor() {
        for (name, length_s, pose) in CLIPS {
            let start = pose(0.0);
            assert!(start.root.length() < 1e-12, "{name}: {}", start.root);
            assert!(start.turns.iter().all(|turn| turn.angle_between(DQuat::IDENTITY) < 1e-6), "{name}");
            let heads =
                |time_s: f64| pose(time_s).transforms().map(|joint| joint.transform_point3(DVec3::new(0.1, 0.5, 0.1)));
            let step = 1e-3;
            let mut before: Option<[DVec3; JOINTS]> = None;
            for i in 0..(length_s / step) as usize {
                let time_s = i as f64 * step;
                let (here, next) = (heads(time_s), heads(time_s + step));
                let speeds: [DVec3; JOINTS] = std::array::from_fn(|j| (next[j] - here[j]) / step);
                if let Some(before) = before {
                    let jump = (0..JOINTS).map(|j| speeds[j].distance(before[j])).fold(0.0, f64::max);
                    // 300 m/s^2 at most, so no jump.
                    assert!(
                        jump < 300.0 * step,
                        "{name} at {time_s}: the speed changes by {jump} m/s in a millisecond"
                    );
                }
                before = Some(speeds);
                assert!((lowest(&pose(time_s)) - lowest(&Pose::rest())).abs() < 1e-9, "{name} at {time_s}");
            }
        }
    }
}
