//! Steps on a device: close to the native executor, and the same bits for every worker count.

use loomtree::gpu::Executor;
use loomtree::math::Vec3;
use loomtree::scene::{Closing, Pin, Scene};
use loomtree::solver::{ExchangeMode, PreconditionerKind};
use support::device;
use support::{Outcome, cpu, isotropic_fabric, scene, sewn_sheets, sheet, simulate};

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
    scene.settings.relative_tolerance = 1e-4;
    scene
}

/// A device per rank.
fn gpu(rank: usize) -> Executor {
    Executor::gpu(None, rank).unwrap()
}

fn bits(values: &[Vec3]) -> Vec<[u32; 3]> {
    values.iter().map(|v| v.to_array().map(f32::to_bits)).collect()
}

fn largest_distance(a: &Outcome, b: &Outcome) -> f32 {
    a.positions.iter().zip(&b.positions).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
}

#[test]
fn a_device_follows_the_native_executor() {
    if device::executor().is_none() {
        return;
    }
    let mut soft = hanging(21);
    soft.pins.extend((100..120).map(|vertex| Pin { stiffness_n_m: Some(3.0), ..Pin::new(vertex, None, 0.0, 0.012) }));
    for scene in [hanging(21), soft] {
        let expected = simulate(&scene, 1, ExchangeMode::Halo, 5, cpu);
        assert!(expected.positions.iter().any(|p| p.z < -0.001), "the sheet falls");
        for (ranks, mode) in [(1, ExchangeMode::Halo), (2, ExchangeMode::Full)] {
            let found = simulate(&scene, ranks, mode, 5, gpu);
            assert!(found.stats.iter().all(|s| s.converged && s.iterations > 3));
            // Both solve to 1e-4 of the start; five steps add up to a few micrometres.
            let distance = largest_distance(&found, &expected);
            assert!(distance < 2e-5, "{mode:?}, {ranks} ranks: {distance} m apart");
        }
    }
}

#[test]
fn a_device_sews_as_the_native_executor_does() {
    if device::executor().is_none() {
        return;
    }
    let mut scene = sewn_sheets(12, Closing { start_s: 0.0, close_s: 0.1, last_m: 0.0 });
    // Loose solves differ by more: the threads draw both sheets along by centimeters.
    scene.settings.relative_tolerance = 1e-6;
    let expected = simulate(&scene, 1, ExchangeMode::Halo, 6, cpu);
    assert!(expected.positions[11].x > 0.203, "the sheets come closer");
    for ranks in [1, 2] {
        let found = simulate(&scene, ranks, ExchangeMode::Halo, 6, gpu);
        let distance = largest_distance(&found, &expected);
        assert!(distance < 2e-5, "{ranks} ranks: {distance} m apart");
    }
}

#[test]
fn halo_mode_on_devices_gives_the_same_bits_for_every_rank_count() {
    if device::executor().is_none() {
        return;
    }
    let scene = hanging(21);
    let one = simulate(&scene, 1, ExchangeMode::Halo, 3, gpu);
    for ranks in [2, 3] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 3, gpu);
        assert_eq!(bits(&many.positions), bits(&one.positions), "{ranks} ranks");
        assert_eq!(bits(&many.velocities), bits(&one.velocities), "{ranks} ranks");
    }
}

#[test]
fn schwarz_on_devices_needs_fewer_iterations_and_gives_the_same_bits_for_every_rank_count() {
    if device::executor().is_none() {
        return;
    }
    // 2,500 vertices: chunks of six rows.
    let mut scene = hanging(50);
    scene.settings.preconditioner = PreconditionerKind::Jacobi;
    let iterations = |outcome: &Outcome| outcome.stats.iter().map(|s| s.iterations).sum::<u32>();
    let jacobi = simulate(&scene, 1, ExchangeMode::Halo, 2, gpu);
    scene.settings.preconditioner = PreconditionerKind::Schwarz;
    let one = simulate(&scene, 1, ExchangeMode::Halo, 2, gpu);
    println!("{} iterations instead of {}", iterations(&one), iterations(&jacobi));
    assert!(iterations(&one) * 3 < iterations(&jacobi) * 2, "{} and {}", iterations(&one), iterations(&jacobi));
    let distance = largest_distance(&one, &jacobi);
    assert!(distance < 2e-5, "{distance} m apart");
    for (ranks, mode) in [(2, ExchangeMode::Halo), (3, ExchangeMode::Halo), (2, ExchangeMode::Full)] {
        let many = simulate(&scene, ranks, mode, 2, gpu);
        if mode == ExchangeMode::Halo {
            assert!(bits(&many.positions) == bits(&one.positions), "{ranks} ranks");
        }
        assert!(largest_distance(&many, &one) < 2e-5, "{mode:?}, {ranks} ranks");
    }
}
