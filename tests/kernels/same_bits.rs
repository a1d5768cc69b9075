//! The same bits for every worker count: ranks as threads, native executor.

use loomtree::math::Vec3;
use loomtree::scene::Scene;
use loomtree::solver::ExchangeMode;
use support::{cpu, isotropic_fabric, scene, sheet, simulate};

/// A sheet hung by two corners in the wind.
fn hanging(n: usize) -> Scene {
    let mesh = sheet(n, n, [0.5, 0.5], Vec3::ZERO, Vec3::X, Vec3::Y);
    let mut scene = scene(
        mesh,
        isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.001),
        &[0, (n - 1) as u32],
        0.004,
        Vec3::new(0.0, 0.0, -9.81),
    );
    scene.settings.wind_m_s = Vec3::new(1.0, 2.0, 0.5);
    scene.settings.air_density_kg_m3 = 1.2;
    scene.settings.air_drag_kg_m2_s = 0.05;
    scene
}

fn bits(values: &[Vec3]) -> Vec<[u32; 3]> {
    values.iter().map(|v| v.to_array().map(f32::to_bits)).collect()
}

#[test]
fn halo_mode_gives_the_same_bits_for_every_rank_count() {
    let scene = hanging(41);
    let one = simulate(&scene, 1, ExchangeMode::Halo, 15, cpu);
    assert!(one.stats.iter().all(|s| s.converged && s.iterations > 3));
    assert!(one.positions.iter().any(|p| p.z < -0.005), "the sheet falls");
    for ranks in [2, 3, 4, 5, 8] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 15, cpu);
        assert_eq!(bits(&many.positions), bits(&one.positions), "{ranks} ranks");
        assert_eq!(bits(&many.velocities), bits(&one.velocities), "{ranks} ranks");
    }
}

#[test]
fn full_mode_repeats_its_bits_and_stays_close_to_halo_mode() {
    let scene = hanging(25);
    let halo = simulate(&scene, 1, ExchangeMode::Halo, 10, cpu);
    for ranks in [2, 3, 4] {
        let first = simulate(&scene, ranks, ExchangeMode::Full, 10, cpu);
        let again = simulate(&scene, ranks, ExchangeMode::Full, 10, cpu);
        assert_eq!(bits(&first.positions), bits(&again.positions));
        let distance = first.positions.iter().zip(&halo.positions).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        // Both stop at a relative residual of 0.01; their difference is of the size of that error.
        assert!(distance < 2e-3, "{ranks} ranks: {distance} m apart");
    }
}

#[test]
fn threads_do_not_change_a_bit() {
    let scene = hanging(25);
    let one = simulate(&scene, 2, ExchangeMode::Halo, 5, cpu);
    let three = simulate(&scene, 2, ExchangeMode::Halo, 5, |_| loomtree::gpu::Executor::cpu(3));
    assert_eq!(bits(&one.positions), bits(&three.positions));
}
