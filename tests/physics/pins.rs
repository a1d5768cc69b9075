//! Prescribed vertices: they follow keyframes to the last bit, take hold without a jump, let go, on any rank count.
//! Whether the free vertices beside them are right is `physics_system.rs`'s question.

use loomtree::math::{DQuat, DVec3, Vec3};
use loomtree::scene::{Keyframe, Motion, Pin, Scene};
use loomtree::solver::ExchangeMode;
use support::physics::{DOWN, GRAVITY_M_S2, OneRank, TIGHT};
use support::{cpu, isotropic_fabric, scene, sheet, simulate};

/// A power of two, so that times are exact in every arithmetic, seconds.
const STEP_S: f64 = 1.0 / 256.0;
const CORNERS: [u32; 2] = [0, 8];

/// A sheet of 9 x 9 vertices, level, gravity down.
fn level_sheet() -> Scene {
    let mesh = sheet(9, 9, [0.4, 0.4], Vec3::ZERO, Vec3::X, Vec3::Y);
    scene(mesh, isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.001), &[], STEP_S, DOWN)
}

/// Forth, a quarter turn about an axis beside the sheet, back; the keyframes fall between steps.
fn dance() -> Motion {
    let key = |time_s, translation_m, angle| Keyframe {
        translation_m,
        rotation: DQuat::from_rotation_y(angle),
        pivot_m: DVec3::new(0.1, 0.0, 0.3),
        ..Keyframe::identity(time_s)
    };
    Motion {
        keyframes: vec![
            key(0.01, DVec3::ZERO, 0.0),
            key(0.05, DVec3::new(0.02, -0.01, 0.03), 0.3),
            key(0.12, DVec3::new(0.0, 0.01, 0.0), -0.2),
        ],
    }
}

fn bits(v: Vec3) -> [u32; 3] {
    v.to_array().map(f32::to_bits)
}

/// Where a pin held from `since_s` at `from` has to be.
fn target(motion: &Motion, start: Vec3, from: Vec3, since_s: f64, time_s: f64) -> Vec3 {
    let moved = |t: f64| motion.transform_at(t).transform_point3(start.as_dvec3());
    (from.as_dvec3() + (moved(time_s) - moved(since_s))).as_vec3()
}

#[test]
fn moving_pins_follow_their_keyframes_to_the_last_bit() {
    let mut scene = level_sheet();
    scene.motions = vec![dance()];
    scene.pins = CORNERS.map(|vertex| Pin::new(vertex, Some(0), 0.0, f64::INFINITY)).to_vec();
    let mut cloth = OneRank::new(&scene);
    for _ in 0..40 {
        let before = cloth.positions();
        cloth.step();
        let (x, v) = (cloth.positions(), cloth.velocities());
        for pin in CORNERS.map(|v| v as usize) {
            let start = scene.mesh.positions[pin];
            let expected = target(&scene.motions[0], start, start, 0.0, f64::from(cloth.steps) * STEP_S);
            assert_eq!(bits(x[pin]), bits(expected), "step {}", cloth.steps);
            assert_eq!(bits(v[pin]), bits((x[pin] - before[pin]) / STEP_S as f32), "step {}", cloth.steps);
        }
    }
    assert!(cloth.positions()[0].distance(scene.mesh.positions[0]) > 0.01, "the motion moves");
    let one = cloth.positions();
    for ranks in 2..=4 {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 40, cpu).positions;
        assert!(one.iter().zip(&many).all(|(a, b)| bits(*a) == bits(*b)), "{ranks} ranks");
    }
}

#[test]
fn a_late_pin_takes_hold_where_the_vertex_is() {
    // The sheet falls freely for 16 steps; then one corner stops and one follows its motion from there.
    // One f32 rounding (at most 3e-8 m here) per step adds up.
    const DRIFT_M: f32 = 20.0 * 3e-8;
    let hold = 16;
    let since_s = f64::from(hold) * STEP_S;
    let mut scene = level_sheet();
    scene.motions = vec![dance()];
    scene.pins = [(CORNERS[0], None), (CORNERS[1], Some(0))]
        .map(|(vertex, motion)| Pin::new(vertex, motion, since_s, f64::INFINITY))
        .to_vec();
    let mut cloth = OneRank::new(&scene);
    for _ in 0..hold {
        cloth.step();
    }
    let at_hold = cloth.positions();
    assert!(scene.mesh.positions[0].z - at_hold[0].z > 0.01, "it has fallen");
    for _ in 0..20 {
        let before = cloth.positions();
        cloth.step();
        let x = cloth.positions();
        let [still, moving] = CORNERS.map(|v| v as usize);
        assert_eq!(bits(x[still]), bits(at_hold[still]), "step {}", cloth.steps);
        assert_eq!(bits(cloth.velocities()[still]), bits(Vec3::ZERO));
        let time_s = f64::from(cloth.steps) * STEP_S;
        // A late pin goes on from where it was a step ago, so that a resumed run needs to know no more than the state.
        let start = scene.mesh.positions[moving];
        let expected = target(&scene.motions[0], start, before[moving], time_s - STEP_S, time_s);
        assert_eq!(bits(x[moving]), bits(expected), "step {}", cloth.steps);
        let straight = target(&scene.motions[0], start, at_hold[moving], since_s, time_s);
        assert!(x[moving].distance(straight) < DRIFT_M, "step {}", cloth.steps);
    }
}

#[test]
fn a_released_sheet_falls() {
    // Of the weight, per step: the solve's residual and rounding.
    const RELATIVE: f64 = 1e-3;
    let release = 16;
    let mut scene = level_sheet();
    scene.settings.relative_tolerance = TIGHT;
    scene.pins = CORNERS.map(|vertex| Pin::new(vertex, None, 0.0, f64::from(release) * STEP_S)).to_vec();
    let mut cloth = OneRank::new(&scene);
    let weight_n = cloth.masses().iter().sum::<f64>() * f64::from(GRAVITY_M_S2);
    for _ in 0..release {
        cloth.step();
        assert_eq!(
            CORNERS.map(|v| bits(cloth.positions()[v as usize])),
            CORNERS.map(|v| bits(scene.mesh.positions[v as usize]))
        );
    }
    // From now on gravity is the only external force.
    for _ in 0..20 {
        let before = cloth.momentum();
        cloth.step();
        let force = (cloth.momentum() - before) / STEP_S;
        let error = (force + DVec3::Z * weight_n).length();
        assert!(error < RELATIVE * weight_n, "step {}: {force} N instead of {weight_n} N down", cloth.steps);
    }
    assert!(CORNERS.iter().all(|&v| cloth.positions()[v as usize].z < -0.01));
}
