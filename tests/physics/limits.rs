//! Strain limits: cloth that hangs, flies and is pulled stays within them, and where nothing reaches them nothing
//! changes.

use loomtree::math::Vec3;
use loomtree::output::principal_stretches;
use loomtree::scene::{Fabric, Scene};
use loomtree::solver::ExchangeMode;
use support::physics::{ACROSS, DOWN, OneRank, strip, uniform_fabric};
use support::{cpu, isotropic_fabric, scene, sheet, simulate};

fn limited(fabric: Fabric, strain_limit: [f64; 2]) -> Fabric {
    Fabric { strain_limit: Some(strain_limit), ..fabric }
}

/// Largest and smallest stretch of all triangles.
fn stretches(scene: &Scene, positions: &[Vec3]) -> [f64; 2] {
    let mesh = &scene.mesh;
    mesh.triangles.iter().zip(&mesh.material_uv).fold([0.0, f64::INFINITY], |[most, least], (corners, uv)| {
        let [largest, smallest] = principal_stretches(corners.map(|v| positions[v as usize]), *uv);
        [most.max(largest), least.min(smallest)]
    })
}

/// A strip that hangs from its end. Its weight would stretch it by `density g L / k` there.
fn hanging_strip(strain_limit: Option<[f64; 2]>) -> Scene {
    let fabric = Fabric { damping_s: 0.01, strain_limit, ..uniform_fabric([50.0, 0.0, 50.0, 20.0], 1e-6, 0.5) };
    let pinned: Vec<u32> = (0..ACROSS as u32).collect();
    scene(strip(40, 0.025, -Vec3::Z), fabric, &pinned, 0.004, DOWN)
}

#[test]
fn a_hanging_strip_ends_at_its_limit() {
    let ends_at = |strain_limit| {
        let scene = hanging_strip(strain_limit);
        let mut cloth = OneRank::new(&scene);
        for _ in 0..1500 {
            cloth.step();
        }
        // Nothing takes out what swings it to and fro, but it has stopped to fall.
        assert!(cloth.fastest_m_s() < 0.05, "{strain_limit:?}: {} m/s", cloth.fastest_m_s());
        stretches(&scene, &cloth.positions())[0]
    };
    // The stiffness is per Green strain, so the stretch s obeys k s (s^2 - 1) / 2 = weight: 9.1 % for 9.8 %.
    assert!(ends_at(None) > 1.08);
    for most in [1.02, 1.05] {
        let largest = ends_at(Some([0.0, most]));
        assert!(largest > most && largest < most + 0.005, "limit {most}: stretched to {largest}");
    }
}

#[test]
fn within_the_limits_nothing_changes() {
    let mut flying = scene(
        sheet(13, 13, [0.4; 2], Vec3::ZERO, Vec3::X, Vec3::Y),
        isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.001),
        &[0, 12],
        0.004,
        DOWN,
    );
    let without = simulate(&flying, 1, ExchangeMode::Halo, 20, cpu);
    assert!(stretches(&flying, &without.positions)[0] < 1.2);
    flying.fabrics[0].strain_limit = Some([0.2, 1.5]);
    let with = simulate(&flying, 1, ExchangeMode::Halo, 20, cpu);
    assert_eq!(with.positions, without.positions);
    assert_eq!(with.velocities, without.velocities);
}

/// A sheet that starts 10 % too long and 10 % too short, and flies.
fn pulled() -> Scene {
    let fabric = limited(isotropic_fabric(300.0, 0.3, 2e-5, 0.15, 0.0), [0.95, 1.05]);
    let mut scene = scene(sheet(11, 11, [0.4; 2], Vec3::ZERO, Vec3::X, Vec3::Y), fabric, &[], 0.002, Vec3::ZERO);
    scene.mesh.positions.iter_mut().for_each(|p| *p = Vec3::new(1.1 * p.x, 0.9 * p.y, 0.01 * (20.0 * p.x).sin()));
    scene.settings.relative_tolerance = 1e-7;
    scene
}

#[test]
fn limits_keep_the_momentum() {
    let scene = pulled();
    let mut cloth = OneRank::new(&scene);
    let mass: f64 = cloth.masses().iter().sum();
    // Of the mass at its highest speed: per step an f32 rounding of every velocity and the solve's residual, as for the
    // momentum of cloth without limits (`motion`).
    const RELATIVE: f64 = 1e-5;
    let mut scale = 0.0f64;
    for _ in 0..50 {
        cloth.step();
        scale = scale.max(mass * f64::from(cloth.fastest_m_s()));
        let momentum = cloth.momentum().length();
        assert!(momentum < RELATIVE * scale, "step {}: {momentum} of {scale} kg m/s", cloth.steps);
    }
    assert!(scale > mass, "nothing is faster than 1 m/s");
    let [most, least] = stretches(&scene, &cloth.positions());
    assert!(most < 1.055 && least > 0.945, "{most} {least}");
}

#[test]
fn limits_give_the_same_bits_on_every_number_of_ranks() {
    let mut scene = pulled();
    scene.settings.relative_tolerance = 0.01;
    let one = simulate(&scene, 1, ExchangeMode::Halo, 12, cpu);
    for ranks in [2, 3, 5, 8] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 12, cpu);
        assert!(many.positions == one.positions && many.velocities == one.velocities, "{ranks} ranks");
    }
}
