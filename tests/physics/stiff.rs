//! Stiff cloth: what single precision keeps of the motion of the whole beside forces within the cloth
//! that are up to a million times as large. Default tolerance and preconditioner.

use loomtree::math::Vec3;
use loomtree::scene::Substeps;
use support::contact::watch;
use support::physics::{DOWN, OneRank, uniform_fabric};
use support::{cpu, scene, sheet};

/// Stiff systems take more than the 500 iterations of the default.
const ITERATIONS_MAX: u32 = 5000;

/// Mean drop of a level sheet of 1 m and 0.2 kg/m^2, let go with one edge held, after 0.24 s.
fn mean_drop_m(stretching_n_m: f64, step_s: f64) -> f64 {
    const SIDE: usize = 33;
    let mesh = sheet(SIDE, SIDE, [1.0; 2], Vec3::ZERO, Vec3::X, Vec3::Y);
    let held: Vec<u32> = (0..mesh.positions.len() as u32).filter(|&v| mesh.positions[v as usize].x == 0.0).collect();
    assert_eq!(held.len(), SIDE);
    let k = stretching_n_m;
    let mut scene = scene(mesh, uniform_fabric([k, 0.1 * k, k, k], 1e-5, 0.2), &held, step_s, DOWN);
    scene.settings.max_iterations = ITERATIONS_MAX;
    scene.settings.substeps = Substeps::Auto;
    let mut cloth = OneRank::new(&scene);
    let steps = (0.24 / step_s).round() as u32;
    let breakdowns: u32 = (0..steps).map(|_| cloth.step().breakdowns).sum();
    assert_eq!(breakdowns, 0);
    let positions = cloth.positions();
    -positions.iter().map(|x| f64::from(x.z)).sum::<f64>() / positions.len() as f64
}

/// The mean drop of this sheet at 1e5 N/m in steps of 1 ms and less.
const DROP_M: f64 = 0.2244;

#[test]
fn a_sheet_swings_down_alike_from_1e5_to_1e7_n_per_m() {
    for stretching in [1e5, 1e6, 1e7] {
        let drop = mean_drop_m(stretching, 0.004);
        println!("{stretching:e} N/m: {drop} m");
        assert!((drop / DROP_M - 1.0).abs() < 0.04, "{stretching:e} N/m: {drop} m instead of {DROP_M} m");
    }
}

#[test]
fn a_sheet_of_1e8_n_per_m_swings_down_in_steps_of_10_ms() {
    let drop = mean_drop_m(1e8, 0.01);
    println!("{drop} m");
    assert!((drop / DROP_M - 1.0).abs() < 0.10, "{drop} m instead of {DROP_M} m");
}

/// Far beyond single precision, and with sub-steps forbidden: solves break off. The step is made in halves, both are
/// counted, and what is handed on falls as it may, but is finite and the same from run to run.
#[test]
fn a_solve_that_breaks_off_ends_no_run() {
    let run = || {
        let mesh = sheet(17, 17, [1.0; 2], Vec3::ZERO, Vec3::X, Vec3::Y);
        let held: Vec<u32> = (0..17).collect();
        let k = 1e11;
        let mut scene = scene(mesh, uniform_fabric([k, 0.1 * k, k, k], 1e-5, 0.2), &held, 0.01, DOWN);
        scene.settings.max_iterations = ITERATIONS_MAX;
        scene.settings.relative_tolerance = 1e-6;
        scene.settings.substeps = Substeps::Fixed(1);
        let run = watch(&scene, 1, 6, cpu);
        let breakdowns: u32 = run.stats.iter().map(|s| s.breakdowns).sum();
        let halvings: u32 = run.stats.iter().map(|s| s.zones.halvings).sum();
        (run.positions.last().unwrap().clone(), breakdowns, halvings)
    };
    let (positions, breakdowns, halvings) = run();
    println!("{breakdowns} breakdowns, {halvings} halvings");
    assert!(breakdowns > 0 && halvings > 0, "{breakdowns} breakdowns, {halvings} halvings");
    assert!(positions.iter().all(|x| x.is_finite() && x.length() < 2.0));
    assert_eq!(run(), (positions, breakdowns, halvings));
}
