//! A person of 1.7 m: where the joints are at rest, and the round cones that each of them carries. y is up, the face
//! looks along z, the left side is at x > 0, the soles are at y = 0. Arms hang 40 degrees below level, legs
//! stand apart.
//! Measures are those of no one in particular.

use super::cone::Cone;
use crate::math::DVec3;

/// A joint of the skeleton.
#[derive(Clone, Copy, Debug)]
pub(super) struct Joint {
    pub name: &'static str,
    /// Its parent stands before it; the first has none.
    pub parent: Option<usize>,
    /// Its place at rest.
    pub at: DVec3,
}

/// Number of joints.
pub(super) const JOINTS: usize = 21;
pub(super) const PELVIS: usize = 0;
pub(super) const SPINE: usize = 1;
pub(super) const CHEST: usize = 2;
pub(super) const NECK: usize = 3;
pub(super) const HEAD: usize = 4;
/// Joints of the left side; those of the right side follow in the same order.
pub(super) const COLLAR: [usize; 2] = [5, 13];
pub(super) const UPPER_ARM: [usize; 2] = [6, 14];
pub(super) const FOREARM: [usize; 2] = [7, 15];
pub(super) const HAND: [usize; 2] = [8, 16];
pub(super) const THIGH: [usize; 2] = [9, 17];
pub(super) const SHIN: [usize; 2] = [10, 18];
pub(super) const FOOT: [usize; 2] = [11, 19];
pub(super) const TOES: [usize; 2] = [12, 20];

const SHOULDER_AT: [f64; 3] = [0.175, 1.385, -0.005];
const ELBOW_AT: [f64; 3] = [0.382, 1.211, -0.010];
const WRIST_AT: [f64; 3] = [0.573, 1.050, 0.010];
const HIP_AT: [f64; 3] = [0.090, 0.920, 0.000];
const KNEE_AT: [f64; 3] = [0.130, 0.500, 0.010];
const ANKLE_AT: [f64; 3] = [0.160, 0.080, -0.010];
const BALL_AT: [f64; 3] = [0.170, 0.035, 0.100];

/// The skeleton, parents first.
pub(super) fn skeleton() -> [Joint; JOINTS] {
    let middle = [
        ("pelvis", None, [0.0, 0.950, 0.0]),
        ("spine", Some(PELVIS), [0.0, 1.060, 0.0]),
        ("chest", Some(SPINE), [0.0, 1.200, 0.0]),
        ("neck", Some(CHEST), [0.0, 1.430, -0.012]),
        ("head", Some(NECK), [0.0, 1.520, 0.0]),
    ];
    let limbs = |side: usize| {
        let names = if side == 0 { LEFT } else { RIGHT };
        let sign = if side == 0 { 1.0 } else { -1.0 };
        let places = [[0.03, 1.400, 0.0], SHOULDER_AT, ELBOW_AT, WRIST_AT, HIP_AT, KNEE_AT, ANKLE_AT, BALL_AT];
        let parents =
            [CHEST, COLLAR[side], UPPER_ARM[side], FOREARM[side], PELVIS, THIGH[side], SHIN[side], FOOT[side]];
        (0..8).map(move |i| (names[i], Some(parents[i]), [sign * places[i][0], places[i][1], places[i][2]]))
    };
    let mut all = middle.into_iter().chain(limbs(0)).chain(limbs(1));
    std::array::from_fn(|_| match all.next() {
        Some((name, parent, at)) => Joint { name, parent, at: at.into() },
        None => unreachable!("there are five joints in the middle and eight on either side"),
    })
}

const LEFT: [&str; 8] =
    ["collar.left", "upper_arm.left", "forearm.left", "hand.left", "thigh.left", "shin.left", "foot.left", "toes.left"];
const RIGHT: [&str; 8] = [
    "collar.right",
    "upper_arm.right",
    "forearm.right",
    "hand.right",
    "thigh.right",
    "shin.right",
    "foot.right",
    "toes.right",
];

/// All cones of the body with the joint that carries each.
pub(super) fn flesh() -> Vec<(usize, Cone)> {
    let middle = [
        (PELVIS, Cone::new([0.0, 0.900, -0.005], [0.0, 1.010, 0.000], [0.085, 0.085])),
        (SPINE, Cone::new([0.0, 1.010, 0.000], [0.0, 1.130, 0.005], [0.080, 0.082])),
        (CHEST, Cone::new([0.0, 1.130, 0.005], [0.0, 1.330, -0.005], [0.085, 0.085])),
        (NECK, Cone::new([0.0, 1.400, -0.015], [0.0, 1.520, 0.000], [0.050, 0.046])),
        (HEAD, Cone::new([0.0, 1.590, -0.008], [0.0, 1.612, -0.010], [0.080, 0.083])),
        (HEAD, Cone::new([0.0, 1.530, 0.040], [0.0, 1.590, 0.030], [0.040, 0.052])),
    ];
    let left = [
        (PELVIS, Cone::new([0.070, 0.900, -0.005], [0.055, 1.010, 0.000], [0.096, 0.076])),
        (PELVIS, Cone::new([0.062, 0.900, -0.045], [0.055, 0.960, -0.035], [0.078, 0.070])),
        (SPINE, Cone::new([0.055, 1.010, 0.000], [0.050, 1.100, 0.003], [0.074, 0.070])),
        (SPINE, Cone::new([0.050, 1.100, 0.003], [0.062, 1.200, 0.005], [0.070, 0.078])),
        (CHEST, Cone::new([0.062, 1.200, 0.005], [0.085, 1.310, -0.005], [0.080, 0.076])),
        (CHEST, Cone::new([0.068, 1.240, 0.052], [0.060, 1.290, 0.040], [0.046, 0.036])),
        (CHEST, Cone::new([0.085, 1.310, -0.005], [0.060, 1.380, -0.012], [0.074, 0.046])),
        (COLLAR[0], Cone::new([0.060, 1.390, -0.012], [0.150, 1.380, -0.008], [0.042, 0.050])),
        (UPPER_ARM[0], Cone::new(SHOULDER_AT, ELBOW_AT, [0.048, 0.036])),
        (FOREARM[0], Cone::new(ELBOW_AT, WRIST_AT, [0.037, 0.025])),
        (HAND[0], Cone::new(WRIST_AT, [0.628, 1.004, 0.018], [0.026, 0.034])),
        (HAND[0], Cone::new([0.628, 1.004, 0.018], [0.678, 0.957, 0.024], [0.032, 0.018])),
        (HAND[0], Cone::new([0.600, 1.024, 0.032], [0.632, 0.990, 0.062], [0.016, 0.013])),
        (THIGH[0], Cone::new(HIP_AT, KNEE_AT, [0.088, 0.054])),
        (SHIN[0], Cone::new(KNEE_AT, ANKLE_AT, [0.052, 0.036])),
        (SHIN[0], Cone::new([0.137, 0.420, -0.012], [0.147, 0.270, -0.014], [0.048, 0.036])),
        (FOOT[0], Cone::new(ANKLE_AT, BALL_AT, [0.040, 0.034])),
        (FOOT[0], Cone::new([0.160, 0.040, -0.040], [0.163, 0.038, 0.020], [0.038, 0.036])),
        (TOES[0], Cone::new(BALL_AT, [0.174, 0.028, 0.160], [0.034, 0.028])),
    ];
    let mirrored = |joint: usize| if joint < COLLAR[0] { joint } else { joint + COLLAR[1] - COLLAR[0] };
    let right = left.map(|(joint, cone)| (mirrored(joint), cone.mirrored()));
    middle.into_iter().chain(left).chain(right).collect()
}

/// Balls on which the body can stand: joint, center and radius.
pub(super) fn soles() -> Vec<(usize, DVec3, f64)> {
    let left = [
        (FOOT[0], [0.160, 0.040, -0.040], 0.040),
        (TOES[0], BALL_AT, 0.035),
        (TOES[0], [0.174, 0.028, 0.160], 0.028),
        (SHIN[0], KNEE_AT, 0.056),
    ];
    let all = [1.0, -1.0].into_iter().zip([0, COLLAR[1] - COLLAR[0]]).flat_map(|(sign, shift)| {
        left.map(|(joint, [x, y, z], radius)| (joint + shift, DVec3::new(sign * x, y, z), radius))
    });
    all.collect()
}
