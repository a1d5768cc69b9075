//! Soft pins: a spring from the target of the pin, within the implicit step; the same bits on any number of ranks.

use loomtree::math::{DVec3, Vec3};
use loomtree::scene::{Keyframe, Motion, Pin, Scene};
use loomtree::solver::ExchangeMode;
use support::physics::{DOWN, GRAVITY_M_S2, OneRank, TIGHT, strip};
use support::{cpu, isotropic_fabric, scene, sheet, simulate};

const STEP_S: f64 = 1.0 / 256.0;

fn soft(vertex: u32, motion: Option<u32>, start_s: f64, stiffness_n_m: f64) -> Pin {
    Pin { stiffness_n_m: Some(stiffness_n_m), ..Pin::new(vertex, motion, start_s, f64::INFINITY) }
}

fn level_sheet() -> Scene {
    let mesh = sheet(9, 9, [0.4, 0.4], Vec3::ZERO, Vec3::X, Vec3::Y);
    scene(mesh, isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.001), &[], STEP_S, DOWN)
}

#[test]
fn a_strip_on_springs_hangs_at_its_weight_over_their_stiffness() {
    const STIFFNESS_N_M: f64 = 4.0;
    // Of the weight: what is left of a motion slower than 1e-5 m/s, and f32 positions of half a meter.
    const RELATIVE: f64 = 2e-4;
    // Long steps, so that backward Euler itself brings it to rest.
    const LONG_STEP_S: f64 = 0.02;
    let fabric = isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.01);
    let mut scene = scene(strip(10, 0.05, -Vec3::Z), fabric, &[], LONG_STEP_S, DOWN);
    scene.settings.relative_tolerance = TIGHT;
    scene.pins = (0..3).map(|vertex| soft(vertex, None, 0.0, STIFFNESS_N_M)).collect();
    let mut cloth = OneRank::new(&scene);
    cloth.settle(1e-6, 1_000);
    let weight_n = cloth.masses().iter().sum::<f64>() * f64::from(GRAVITY_M_S2);
    let stretched = |v: usize| scene.mesh.positions[v].as_dvec3() - cloth.positions()[v].as_dvec3();
    let sum: DVec3 = (0..3).map(stretched).sum::<DVec3>() * STIFFNESS_N_M;
    assert!((sum - DVec3::Z * weight_n).length() < RELATIVE * weight_n, "{sum} N instead of {weight_n} N");
    // One third of it each, as far as the cloth lets them: 49 mm.
    assert!(((0..3).map(|v| stretched(v).z).sum::<f64>() / 3.0 - weight_n / 3.0 / STIFFNESS_N_M).abs() < 1e-4);
}

#[test]
fn springs_in_proportion_to_masses_move_a_sheet_as_backward_euler_of_one_mass() {
    // 1/s; a target that moves at 0.5 m/s.
    const OMEGA: f64 = 20.0;
    let speed = DVec3::new(0.5, 0.0, 0.0);
    let mut scene = level_sheet();
    scene.settings.relative_tolerance = TIGHT;
    let key = |time_s: f64| Keyframe { translation_m: speed * time_s, ..Keyframe::identity(time_s) };
    scene.motions = vec![Motion { keyframes: vec![key(0.0), key(10.0)] }];
    let masses = OneRank::new(&scene).masses();
    scene.pins = (0..).zip(&masses).map(|(vertex, mass)| soft(vertex, Some(0), 0.0, OMEGA * OMEGA * mass)).collect();
    let mut cloth = OneRank::new(&scene);
    let (mut x, mut v) = (DVec3::ZERO, DVec3::ZERO);
    for step in 1..=60 {
        cloth.step();
        let target = speed * (f64::from(step) * STEP_S);
        let force = (target - x - v * STEP_S) * OMEGA * OMEGA + DOWN.as_dvec3();
        v += force * (STEP_S / (1.0 + (OMEGA * STEP_S).powi(2)));
        x += v * STEP_S;
        for (start, now) in scene.mesh.positions.iter().zip(cloth.positions()) {
            let off = (now - *start).as_dvec3().distance(x);
            assert!(off < 2e-6, "step {step}: {off:e} m from {x}");
        }
    }
    assert!(x.length() > 0.01);
}

#[test]
fn soft_pins_give_the_same_bits_on_any_number_of_ranks_and_hold_later_where_the_vertex_is() {
    let mut scene = level_sheet();
    let key = |time_s: f64, x: f64| Keyframe { translation_m: DVec3::X * x, ..Keyframe::identity(time_s) };
    scene.motions = vec![Motion { keyframes: vec![key(0.0, 0.0), key(1.0, 0.4)] }];
    let start_s = 10.0 * STEP_S;
    scene.pins = vec![
        soft(0, None, 0.0, 50.0),
        soft(8, Some(0), 0.0, 30.0),
        Pin::new(40, None, 0.0, 5.0 * STEP_S),
        soft(72, None, start_s, 40.0),
        Pin { end_s: 30.0 * STEP_S, ..soft(80, Some(0), start_s, 40.0) },
    ];
    let one = simulate(&scene, 1, ExchangeMode::Halo, 40, cpu);
    for ranks in [2, 3, 5] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 40, cpu);
        assert!(many.positions == one.positions && many.velocities == one.velocities, "{ranks} ranks");
    }
    // A spring that takes hold of a falling vertex pulls it back to where it was then.
    let mut cloth = OneRank::new(&scene);
    for _ in 0..10 {
        cloth.step();
    }
    let there = cloth.positions()[72];
    assert!(there.z < -1e-3);
    scene.pins[3].stiffness_n_m = Some(1e6);
    let mut cloth = OneRank::new(&scene);
    for _ in 0..40 {
        cloth.step();
    }
    assert!(cloth.positions()[72].distance(there) < 1e-5, "{} {there}", cloth.positions()[72]);
}
