//! Threads of seams: they close in the time they are given, at a bounded speed, push nothing anywhere, and do not
//! depend on the number of ranks.

use loomtree::math::{DVec3, Vec3};
use loomtree::model::GlobalModel;
use loomtree::scene::{Closing, Scene};
use loomtree::solver::ExchangeMode;
use support::{Outcome, cpu, sewn_sheets, simulate};

fn gaps(scene: &Scene, positions: &[Vec3]) -> Vec<f32> {
    let pairs = &scene.sewing.as_ref().unwrap().pairs;
    pairs.iter().map(|&[a, b]| positions[a as usize].distance(positions[b as usize])).collect()
}

fn momentum(scene: &Scene, outcome: &Outcome) -> DVec3 {
    let model = GlobalModel::new(scene);
    let masses = model.original_from_global.iter().zip(&model.masses);
    masses.map(|(&v, &mass)| outcome.velocities[v as usize].as_dvec3() * f64::from(mass)).sum()
}

#[test]
fn a_seam_closes_in_its_time_at_its_speed() {
    let mut scene = sewn_sheets(9, Closing { start_s: 0.0, close_s: 0.2, last_m: 0.0 });
    scene.settings.relative_tolerance = 1e-4;
    let first = gaps(&scene, &scene.mesh.positions);
    for steps in [10, 25, 40] {
        let outcome = simulate(&scene, 1, ExchangeMode::Halo, steps, cpu);
        let share = 1.0 - steps as f32 * 0.004 / 0.2;
        // A thread is a little longer than it is at rest, because it draws its panel along.
        for (gap, first) in gaps(&scene, &outcome.positions).iter().zip(&first) {
            assert!(*gap > share * first - 2e-3 && *gap < share * first + 8e-3, "{steps}: {gap} of {first}");
        }
        let (a, b) = (outcome.velocities[8], outcome.velocities[81]);
        assert!((a - b).length() < 1.5 * first[0] / 0.2, "{steps}: {a} {b}");
    }
    let closed = simulate(&scene, 1, ExchangeMode::Halo, 75, cpu);
    let widest = gaps(&scene, &closed.positions).into_iter().fold(0.0, f32::max);
    assert!(widest < 5e-4, "{widest}");
}

#[test]
fn threads_move_no_center_of_mass_and_have_the_same_bits_everywhere() {
    let mut scene = sewn_sheets(9, Closing { start_s: 0.0, close_s: 0.1, last_m: 2.5e-4 });
    scene.settings.collisions = true;
    scene.settings.relative_tolerance = 1e-6;
    let one = simulate(&scene, 1, ExchangeMode::Halo, 20, cpu);
    let speed = one.velocities.iter().map(|v| v.length()).fold(0.0, f32::max);
    let mass: f32 = GlobalModel::new(&scene).masses.iter().sum();
    let p = momentum(&scene, &one);
    assert!(speed > 0.1 && p.length() < 1e-4 * f64::from(mass * speed), "{p} at {speed} m/s");
    for ranks in [2, 3, 5, 8] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 20, cpu);
        assert!(many.positions == one.positions && many.velocities == one.velocities, "{ranks} ranks");
    }
}

#[test]
fn both_sides_of_a_seam_come_closer_than_the_thickness() {
    let mut scene = sewn_sheets(9, Closing { start_s: 0.0, close_s: 0.15, last_m: 2.5e-4 });
    (scene.settings.collisions, scene.settings.thickness_m) = (true, 0.004);
    let outcome = simulate(&scene, 1, ExchangeMode::Halo, 60, cpu);
    let widest = gaps(&scene, &outcome.positions).into_iter().fold(0.0, f32::max);
    assert!(widest < 1e-3, "{widest}");
}
