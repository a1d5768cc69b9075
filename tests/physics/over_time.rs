//! What changes during a run by itself, and pressure: what the equations give within a step, and over several.

use loomtree::math::{DVec3, Vec3};
use loomtree::mesh::{TriangleMesh, flatten_triangles, shapes};
use loomtree::scene::{Cloth, FieldShape, ForceField, OverTime, Scene};
use loomtree::solver::ExchangeMode;
use support::physics::{OneRank, TIGHT, TO_REST};
use support::{cpu, isotropic_fabric, scene, sheet, simulate};

/// A free sheet of 0.4 m with its corner at the origin, stretched by `stretch`.
fn free_sheet(stretch: f32, step_s: f64) -> Scene {
    let mut mesh = sheet(9, 9, [0.4, 0.4], Vec3::ZERO, Vec3::X, Vec3::Y);
    mesh.positions.iter_mut().for_each(|x| *x *= stretch);
    let mut scene = scene(mesh, isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.0), &[], step_s, Vec3::ZERO);
    scene.settings.relative_tolerance = TIGHT;
    scene
}

/// v_n = dt * sum of g at the ends of the steps, whatever the material and the number of ranks.
#[test]
fn gravity_with_keys_pulls_as_at_the_end_of_every_step() {
    let (steps, step_s) = (30, 0.01);
    let mut scene = free_sheet(1.0, step_s);
    let keys = vec![(0.05, Vec3::new(0.0, 0.0, -4.0)), (0.15, Vec3::new(8.0, 0.0, 0.0))];
    scene.settings.over_time.gravity_m_s2 = OverTime::new(keys);
    let gravity = scene.settings.over_time.gravity_m_s2.clone().unwrap();
    let expected: DVec3 = (1..=steps).map(|n| gravity.at(f64::from(n) * step_s).as_dvec3() * step_s).sum();
    assert!(expected.x > 1.0 && expected.z < -0.3, "{expected}");
    for ranks in 1..=3 {
        for v in simulate(&scene, ranks, ExchangeMode::Halo, steps, cpu).velocities {
            assert!((v.as_dvec3() - expected).length() < 1e-5, "{ranks} ranks: {v} for {expected}");
        }
    }
}

/// From a center that is far away a radial field is the same everywhere; it is a vertex's mass that it moves.
#[test]
fn a_force_field_accelerates_every_vertex_by_its_value() {
    let (steps, step_s) = (20, 0.01);
    let mut scene = free_sheet(1.0, step_s);
    let far = FieldShape::Radial { center_m: DVec3::new(0.0, 0.0, 1e6), radius_m: f64::INFINITY };
    let still = FieldShape::Turbulence { scale_m: 1e9, change_s: f64::INFINITY, seed: 4, origin_m: DVec3::ZERO };
    let force =
        |shape, start_s, end_s| ForceField { shape, strength_m_s2: 3.0, strength_over_time: None, start_s, end_s };
    scene.settings.over_time.forces = vec![force(far, 0.0, 0.105), force(still, 0.0, f64::INFINITY)];
    let noise = scene.settings.over_time.forces[1].acceleration_m_s2(DVec3::ZERO, 0.0);
    assert!(noise.length() > 0.1, "{noise}");
    let expected = DVec3::new(0.0, 0.0, -0.3) + noise * 0.2;
    for v in simulate(&scene, 2, ExchangeMode::Halo, steps, cpu).velocities {
        assert!((v.as_dvec3() - expected).length() < 1e-4, "{v} for {expected}");
    }
}

/// The first step of a stretched sheet: twice the stiffness, twice the velocities.
#[test]
fn a_factor_on_the_stiffness_acts_on_forces() {
    let after = |factor: f64| {
        let mut scene = free_sheet(1.05, 1e-5);
        scene.settings.over_time.stiffness_factor = OverTime::new(vec![(0.0, factor)]);
        let mut cloth = OneRank::new(&scene);
        cloth.step();
        cloth.velocities()
    };
    let (once, twice) = (after(1.0), after(2.0));
    let fastest = once.iter().map(|v| v.length()).fold(0.0, f32::max);
    assert!(fastest > 1e-3, "{fastest} m/s");
    for (one, two) in once.iter().zip(&twice) {
        assert!((*two - *one * 2.0).length() < 2e-3 * fastest, "{one} {two}");
    }
}

/// A ball of cloth of 0.2 m under pressure.
fn ball(pressure_pa: f64, step_s: f64) -> Scene {
    let surface = shapes::sphere(0.2, 6);
    let mesh = TriangleMesh {
        material_uv: flatten_triangles(&surface.positions, &surface.triangles),
        positions: surface.positions,
        triangles: surface.triangles,
    };
    let (vertices, triangles) = (mesh.positions.len() as u32, mesh.triangles.len() as u32);
    let mut scene = scene(mesh, isotropic_fabric(500.0, 0.3, 2e-5, 0.15, 0.0), &[], step_s, Vec3::ZERO);
    let (name, friction) = ("ball".to_owned(), 0.0);
    scene.cloths = vec![Cloth { name, vertices: 0..vertices, triangles: 0..triangles, friction, pressure_pa }];
    scene.settings.relative_tolerance = TIGHT;
    scene
}

/// m dv = dt p A of a vertex, outward whichever way the triangles are wound; all together push nowhere.
#[test]
fn pressure_pushes_every_vertex_by_its_area() {
    let (pressure_pa, step_s) = (80.0, 1e-5);
    for turned in [false, true] {
        let mut scene = ball(pressure_pa, step_s);
        if turned {
            scene.mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
            scene.mesh.material_uv = flatten_triangles(&scene.mesh.positions, &scene.mesh.triangles);
        }
        let positions = scene.mesh.positions.clone();
        let mut areas = vec![DVec3::ZERO; positions.len()];
        for &[a, b, c] in &scene.mesh.triangles {
            let [x, y, z] = [a, b, c].map(|v| positions[v as usize].as_dvec3());
            let area = (y - x).cross(z - x) / 2.0 * if turned { -1.0 } else { 1.0 };
            [a, b, c].iter().for_each(|&v| areas[v as usize] += area / 3.0);
        }
        let mut cloth = OneRank::new(&scene);
        cloth.step();
        let mut momentum = DVec3::ZERO;
        for (((v, mass), area), x) in cloth.velocities().iter().zip(cloth.masses()).zip(&areas).zip(&positions) {
            let (v, expected) = (v.as_dvec3(), *area * (step_s * pressure_pa / mass));
            assert!((v - expected).length() < 2e-3 * expected.length(), "{v} for {expected}");
            assert!(v.dot(x.as_dvec3()) > 0.0, "outward");
            momentum += v * mass;
        }
        let each = step_s * pressure_pa * areas[0].length();
        assert!(momentum.length() < 1e-3 * each, "{momentum} of {each}");
    }
}

/// At rest the tension T of a ball carries the pressure: p = 2 T / r, and T follows from the strain e by T = E h e /
/// (1 - nu), for small strains.
#[test]
fn a_ball_under_pressure_comes_to_rest_where_its_tension_holds_it() {
    let mut scene = ball(100.0, 0.004);
    scene.fabrics[0].damping_s = 0.05;
    scene.settings.relative_tolerance = TO_REST;
    let mut cloth = OneRank::new(&scene);
    (0..150).for_each(|_| {
        cloth.step();
    });
    let radius = |of: &[Vec3]| of.iter().map(|x| f64::from(x.length())).sum::<f64>() / of.len() as f64;
    let (start, end) = (radius(&scene.mesh.positions), radius(&cloth.positions()));
    // The same stretch in all directions: Cauchy's stress equals the second Piola stress.
    let stretch = end / start;
    let tension = 500.0 / (1.0 - 0.3) * 0.5 * (stretch * stretch - 1.0);
    let expected = 2.0 * tension / (0.2 * stretch);
    assert!((stretch - 1.0) > 0.01 && (expected / 100.0 - 1.0).abs() < 0.05, "stretch {stretch}: {expected} Pa");
}
