//! Stiff and finely graded cloth: what single precision keeps of the motion of the whole beside forces within the cloth
//! that are up to a million times as large. Default tolerance and preconditioner.

use loomtree::math::{DVec3, Vec3};
use loomtree::mesh::TriangleMesh;
use loomtree::model::stiffness_ratio;
use loomtree::scene::Substeps;
use loomtree::step::parts_of_step;
use support::physics::{DOWN, GRAVITY_M_S2, OneRank, uniform_fabric};
use support::{scene, sheet};

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

/// A sheet of 1 m whose cells shrink from 0.17 m at the rim to 0.06 mm at the center lines.
fn graded() -> TriangleMesh {
    const HALF: i32 = 20;
    let side = 2 * HALF as usize + 1;
    let mut mesh = sheet(side, side, [1.0; 2], Vec3::new(-0.5, -0.5, 0.0), Vec3::X, Vec3::Y);
    // 3000 is the 20th power of 1.49.
    let ratio = 3000f64.powf(1.0 / f64::from(HALF));
    let placed = |x: f32| -> f32 {
        let cell = (f64::from(x) * 2.0 * f64::from(HALF)).round();
        let far = (ratio.powf(cell.abs()) - 1.0) / (ratio.powi(HALF) - 1.0);
        (0.5 * far).copysign(cell) as f32
    };
    for x in &mut mesh.positions {
        (x.x, x.y) = (placed(x.x), placed(x.y));
    }
    for (corners, uv) in mesh.triangles.iter().zip(&mut mesh.material_uv) {
        for (corner, uv) in corners.iter().zip(uv) {
            let x = mesh.positions[*corner as usize];
            (uv.x, uv.y) = (x.x + 0.5, x.y + 0.5);
        }
    }
    mesh
}

/// Backward Euler falls n (n + 1) g dt^2 / 2 in n steps.
#[test]
fn a_finely_graded_sheet_falls_freely_and_stays_flat() {
    const STEPS: u32 = 100;
    let step_s = 0.004;
    let mesh = graded();
    let start = mesh.positions.clone();
    let mut scene = scene(mesh, uniform_fabric([480.0, 45.0, 420.0, 70.0], 3e-5, 0.15), &[], step_s, DOWN);
    scene.settings.max_iterations = ITERATIONS_MAX;
    scene.settings.substeps = Substeps::Auto;
    let parts = parts_of_step(stiffness_ratio(&scene));
    assert!(parts > 1, "finer than single precision takes in whole steps");
    let mut cloth = OneRank::new(&scene);
    for _ in 0..STEPS {
        assert_eq!(cloth.step().breakdowns, 0);
    }
    // Parts of steps, in which the run is made.
    let n = f64::from(STEPS * parts);
    let step_s = step_s / f64::from(parts);
    let fallen = 0.5 * f64::from(GRAVITY_M_S2) * step_s * step_s * n * (n + 1.0);
    for (x, from) in cloth.positions().iter().zip(&start) {
        let off = (*x - *from).as_dvec3() + fallen * DVec3::Z;
        assert!(off.length() < 1e-3, "off by {off} m");
    }
}
