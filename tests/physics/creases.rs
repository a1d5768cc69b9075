//! Plastic bending: a strip is folded by its end, let go, and comes to rest at the angle of the return map.

use loomtree::forces::dihedral_angle;
use loomtree::math::{DQuat, DVec3, Vec3};
use loomtree::scene::{Fabric, Keyframe, Motion, Pin, Plasticity, Scene};
use support::physics::{ACROSS, OneRank, strip, uniform_fabric};
use support::scene;

const CELL_M: f32 = 0.01;
/// Curvature per angle of a fold across square cells: one over their size.
const CURVATURE_FROM_ANGLE: f64 = 1.0 / CELL_M as f64;
/// Yields at 0.5 rad.
const YIELD_1_M: f64 = 0.5 * CURVATURE_FROM_ANGLE;
const FOLDED_AT_S: f64 = 0.1;
const RELEASED_AT_S: f64 = 0.12;

/// A strip of two cells. Two columns of vertices are held; the third is turned about the second one by `angle` and let
/// go.
fn folded(angle: f64, plasticity: Plasticity, step_s: f64) -> Scene {
    let fabric = Fabric {
        damping_s: 0.01,
        plasticity: Some(plasticity),
        ..uniform_fabric([500.0, 0.0, 500.0, 200.0], 1e-4, 0.1)
    };
    let mut scene = scene(strip(2, CELL_M, Vec3::X), fabric, &[], step_s, Vec3::ZERO);
    let turned = |time_s, part: f64| Keyframe {
        rotation: DQuat::from_rotation_y(part * angle),
        pivot_m: DVec3::new(f64::from(CELL_M), 0.0, 0.0),
        ..Keyframe::identity(time_s)
    };
    // In pieces, because between keyframes an angle takes the shorter way.
    scene.motions = vec![Motion {
        keyframes: (0..=4).map(|i| turned(FOLDED_AT_S * f64::from(i) / 4.0, f64::from(i) / 4.0)).collect(),
    }];
    let columns = ACROSS as u32;
    scene.pins = (0..3 * columns)
        .map(|vertex| match vertex < 2 * columns {
            true => Pin::new(vertex, None, 0.0, f64::INFINITY),
            false => Pin::new(vertex, Some(0), 0.0, RELEASED_AT_S),
        })
        .collect();
    scene
}

/// Angle across the middle column, absolute, radians.
fn angle_of(cloth: &OneRank) -> f64 {
    let x = cloth.positions();
    // An edge of the middle column, and the vertices of its two triangles.
    let (angle, _) = dihedral_angle([x[3], x[4], x[0], x[7]]);
    f64::from(angle.abs())
}

/// Angle of the strip at rest after the fold, and its crease.
fn rest_after(angle: f64, plasticity: Plasticity, step_s: f64) -> (f64, [f64; 2]) {
    let mut cloth = OneRank::new(&folded(angle, plasticity, step_s));
    for _ in 0..(RELEASED_AT_S / step_s).round() as u32 + 1 {
        cloth.step();
    }
    cloth.settle(1e-5, 20_000);
    (angle_of(&cloth), cloth.crease([3, 4]).map(|value| f64::from(value.abs())))
}

fn plasticity(hardening: f64, weakening: f64) -> Plasticity {
    Plasticity { yield_curvature_1_m: YIELD_1_M, hardening, weakening, ..Plasticity::NONE }
}

#[test]
fn below_the_yield_curvature_the_strip_returns() {
    for step_s in [0.001, 0.004] {
        let (angle, crease) = rest_after(0.45, plasticity(0.0, 0.0), step_s);
        assert_eq!(crease, [0.0; 2], "{step_s} s");
        assert!(angle < 1e-3, "{step_s} s: {angle} rad");
    }
}

#[test]
fn a_crease_stays_at_the_angle_of_the_return_map() {
    for (folded, hardening, weakening) in [(1.2, 0.0, 0.0), (2.5, 0.0, 0.0), (1.2, 0.5, 0.0), (2.0, 0.25, 1.0)] {
        let expected = (folded - YIELD_1_M / CURVATURE_FROM_ANGLE) / (1.0 + hardening);
        for step_s in [0.001, 0.002, 0.004] {
            let (angle, [rest, plastic]) = rest_after(folded, plasticity(hardening, weakening), step_s);
            let case = format!("folded by {folded}, hardening {hardening}, {step_s} s");
            assert!((rest - expected).abs() < 0.01 * expected, "{case}: rests at {rest}, not {expected} rad");
            assert!((plastic / CURVATURE_FROM_ANGLE - rest).abs() < 1e-4, "{case}: plastic curvature {plastic}");
            assert!((angle - rest).abs() < 0.01 * expected, "{case}: at {angle}, rest {rest} rad");
        }
    }
}

/// What is held beyond yield pulls with the moment of the yield curvature, however far it is folded.
#[test]
fn a_held_fold_keeps_the_yield_curvature() {
    for angle in [0.8, 1.6, 2.4] {
        let mut cloth = OneRank::new(&folded(angle, plasticity(0.0, 0.0), 0.002));
        for _ in 0..55 {
            cloth.step();
        }
        let elastic = CURVATURE_FROM_ANGLE * (angle_of(&cloth) - f64::from(cloth.crease([3, 4])[0].abs()));
        assert!((elastic - YIELD_1_M).abs() < 1e-3 * YIELD_1_M, "folded by {angle}: {elastic} 1/m");
    }
}
