//! Plastic stretching: a strip is pulled by its end, let go, and comes to rest at the stretch of the return map.

use loomtree::math::{DVec3, Vec3};
use loomtree::model::UNSTRETCHED;
use loomtree::scene::{Fabric, Keyframe, Motion, Pin, Plasticity, Scene, StrainLimit};
use support::physics::{ACROSS, OneRank, strip, uniform_fabric};
use support::scene;

const CELL_M: f32 = 0.01;
const CELLS: usize = 2;
const YIELD_STRAIN: f64 = 0.05;
const PULLED_AT_S: f64 = 0.1;
const RELEASED_AT_S: f64 = 0.12;

/// A strip of two cells. The first column of vertices is held; the others are pulled to `stretch` times the length and
/// let go.
fn pulled(stretch: f64, plasticity: Plasticity, step_s: f64) -> Scene {
    let fabric = Fabric {
        damping_s: 0.01,
        plasticity: Some(plasticity),
        ..uniform_fabric([500.0, 0.0, 500.0, 200.0], 1e-4, 0.1)
    };
    let mut scene = scene(strip(CELLS, CELL_M, Vec3::X), fabric, &[], step_s, Vec3::ZERO);
    let motion = |column: usize| {
        let way_m = column as f64 * f64::from(CELL_M) * (stretch - 1.0);
        let at = |time_s, part: f64| Keyframe {
            translation_m: DVec3::new(part * way_m, 0.0, 0.0),
            ..Keyframe::identity(time_s)
        };
        Motion { keyframes: vec![at(0.0, 0.0), at(PULLED_AT_S, 1.0), at(1.0, 1.0)] }
    };
    scene.motions = (1..=CELLS).map(motion).collect();
    scene.pins = (0..(CELLS + 1) * ACROSS)
        .map(|vertex| {
            let (column, vertex) = (vertex / ACROSS, vertex as u32);
            match column {
                0 => Pin::new(vertex, None, 0.0, f64::INFINITY),
                _ => Pin::new(vertex, Some(column as u32 - 1), 0.0, RELEASED_AT_S),
            }
        })
        .collect();
    scene
}

/// Length of the strip over its length at the start.
fn stretch_of(cloth: &OneRank) -> f64 {
    let x = cloth.positions();
    let ends = CELLS * ACROSS..(CELLS + 1) * ACROSS;
    let ends = ends.map(|v| f64::from(x[v].x)).sum::<f64>() / ACROSS as f64;
    ends / (CELLS as f64 * f64::from(CELL_M))
}

fn pull(scene: &Scene, step_s: f64) -> OneRank {
    let mut cloth = OneRank::new(scene);
    for _ in 0..(RELEASED_AT_S / step_s).round() as u32 - 1 {
        cloth.step();
    }
    cloth
}

/// The strip at rest after it was let go.
fn rest_after(stretch: f64, plasticity: Plasticity, step_s: f64) -> OneRank {
    let mut cloth = pull(&pulled(stretch, plasticity, step_s), step_s);
    (0..3).for_each(|_| _ = cloth.step());
    cloth.settle(1e-5, 20_000);
    cloth
}

fn plasticity(hardening: f64, weakening: f64) -> Plasticity {
    Plasticity { yield_strain: YIELD_STRAIN, hardening, weakening, ..Plasticity::NONE }
}

#[test]
fn below_the_yield_strain_the_strip_returns() {
    for step_s in [0.001, 0.002, 0.004] {
        for stretch in [1.045, 0.96] {
            let cloth = rest_after(stretch, plasticity(0.0, 1.0), step_s);
            assert!(cloth.rest_stretches().iter().all(|&rest| rest == UNSTRETCHED), "{step_s} s");
            assert!((stretch_of(&cloth) - 1.0).abs() < 1e-5, "{step_s} s: {}", stretch_of(&cloth));
        }
    }
}

#[test]
fn a_stretch_stays_as_the_return_map_says() {
    let yields_at = YIELD_STRAIN.ln_1p();
    for (stretch, hardening, weakening) in [(1.3f64, 0.0, 0.0), (1.15, 0.0, 0.0), (1.3, 0.5, 0.0), (1.2, 0.25, 1.0)] {
        let expected = ((stretch.ln() - yields_at) / (1.0 + hardening)).exp() - 1.0;
        for step_s in [0.001, 0.002, 0.004] {
            let cloth = rest_after(stretch, plasticity(hardening, weakening), step_s);
            let case = format!("pulled to {stretch}, hardening {hardening}, weakening {weakening}, {step_s} s");
            let found = stretch_of(&cloth) - 1.0;
            assert!((found - expected).abs() < 0.01 * expected, "{case}: rests at {found}, not {expected}");
            for [uu, vv, uv, plastic] in cloth.rest_stretches().iter().map(|rest| rest.map(f64::from)) {
                assert!((uu - 1.0 - expected).abs() < 1e-3 * expected, "{case}: {uu}, not {}", 1.0 + expected);
                assert!((vv - 1.0).abs() < 1e-5 && uv.abs() < 1e-5, "{case}: {vv} {uv}");
                assert!((plastic - uu.ln()).abs() < 1e-5, "{case}: plastic strain {plastic}");
            }
        }
    }
}

/// What is held beyond yield keeps the yield strain, however far it is pulled; damage takes its stiffness.
#[test]
fn a_held_strip_keeps_the_yield_strain_and_weakens() {
    for stretch in [1.1, 1.3] {
        let cloth = pull(&pulled(stretch, plasticity(0.0, 0.0), 0.002), 0.002);
        for [uu, ..] in cloth.rest_stretches() {
            let elastic = stretch / f64::from(uu) - 1.0;
            assert!((elastic - YIELD_STRAIN).abs() < 1e-3 * YIELD_STRAIN, "pulled to {stretch}: {elastic}");
        }
    }
    // Let go, it hangs by its weight: longer by what damage has taken of its stiffness.
    let sag = |weakening: f64| {
        let mut scene = pulled(1.2, plasticity(0.0, weakening), 0.002);
        scene.settings.gravity_m_s2 = Vec3::X * 1000.0;
        let mut cloth = pull(&scene, 0.002);
        (0..3).for_each(|_| _ = cloth.step());
        cloth.settle(1e-5, 20_000);
        let [rest, .., plastic] = cloth.rest_stretches()[0].map(f64::from);
        (stretch_of(&cloth) / rest - 1.0, plastic / YIELD_STRAIN.ln_1p())
    };
    let ((whole, _), (weak, damage)) = (sag(0.0), sag(1.0));
    assert!(damage > 2.0, "{damage}");
    assert!((weak / whole / (1.0 + damage) - 1.0).abs() < 0.03, "{weak} for {whole} after damage {damage}");
}

/// Strain limits count from the shape at rest as it is, so that a strip that has yielded is within them.
#[test]
fn strain_limits_count_from_the_plastic_shape() {
    let mut scene = pulled(1.3, plasticity(0.0, 0.0), 0.002);
    scene.fabrics[0].strain_limit = Some(StrainLimit::Every([0.9, 1.1]));
    let mut cloth = pull(&scene, 0.002);
    (0..3).for_each(|_| _ = cloth.step());
    cloth.settle(1e-5, 20_000);
    let expected = 1.3 / (1.0 + YIELD_STRAIN);
    assert!((stretch_of(&cloth) - expected).abs() < 0.01 * (expected - 1.0), "{}", stretch_of(&cloth));
}
