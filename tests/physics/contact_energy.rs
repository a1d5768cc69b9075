//! Contacts take energy and never give any, and bodies that touch only each other keep their momentum.

use loomtree::math::{DVec3, Vec3};
use support::contact::{Watched, assert_free, contact_scene, floor, together, watch};
use support::physics::{DOWN, GRAVITY_M_S2};
use support::{cpu, sheet};

/// Mean height, mean vertical speed.
fn mean_z(values: &[Vec3]) -> f64 {
    values.iter().map(|p| f64::from(p.z)).sum::<f64>() / values.len() as f64
}

/// Cloth does not bounce: of the speed of an impact, what it leaves with is what the thickness gives room for, half of
/// it per step: two Newton steps on the barrier, each of a quarter at most. Then it lies still.
#[test]
fn a_dropped_sheet_stays_where_it_falls() {
    // Over corners of the floor's cells, a corner of the sheet has one contact or two as its place is rounded: it
    // trembles by a few micrometres.
    let (apart, on_corners) = ((7, 1e-9), (5, 1e-8));
    for (step_s, thickness_m, speed_m_s, (cells, at_rest)) in [
        (0.004, 1e-3, 0.0, apart),
        (0.004, 1e-3, 3.0, apart),
        (0.0005, 1e-3, 0.0, apart),
        (0.004, 1e-4, 3.0, apart),
        (0.004, 5e-3, 0.0, apart),
        (0.004, 1e-3, 0.0, on_corners),
    ] {
        let mesh = sheet(11, 11, [0.2, 0.2], Vec3::new(-0.1, -0.1, 0.05), Vec3::X, Vec3::Y);
        let mut scene = contact_scene(mesh, thickness_m, 0.3, DOWN);
        scene.settings.step_s = step_s;
        scene.velocities.iter_mut().for_each(|v| v.z = -speed_m_s);
        scene.obstacles = vec![floor(1.0, cells, 0.3)];
        let run = watch(&scene, 1, (0.4 / step_s) as u32, cpu);
        let case = format!("steps of {step_s} s, {thickness_m} m thick, {speed_m_s} m/s: {}", run.summary());
        let speeds: Vec<f64> = run.velocities.iter().map(|v| mean_z(v)).collect();
        let slowest = speeds.iter().fold(0.0, |a: f64, &b| a.min(b));
        let bounce = speeds.iter().fold(0.0, |a: f64, &b| a.max(b));
        println!("{case}: {slowest:.3} m/s down, then {bounce:.4} m/s up");
        assert!(slowest < -0.9 && bounce <= 0.5 * thickness_m / step_s, "{case}: {slowest} m/s, then {bounce} m/s");
        let energy = run.kinetic_j();
        let most = energy.iter().fold(0.0, |a: f64, &b| a.max(b));
        assert!(
            energy.last().unwrap() < &(at_rest * most),
            "{case}: {} of {most} J at the end",
            energy.last().unwrap()
        );
        let heights = run.positions.last().unwrap().iter().map(|p| f64::from(p.z));
        assert!(heights.clone().all(|z| z > 0.75 * thickness_m && z < 1.01 * thickness_m), "{case}");
        assert_never_above_the_start(&run, &scene.mesh.positions, f64::from(speed_m_s), thickness_m);
        assert_free(&scene, &run);
    }
}

/// Kinetic and potential energy; the room that the thickness takes may lift the sheet by as much.
fn assert_never_above_the_start(run: &Watched, start: &[Vec3], speed_m_s: f64, thickness_m: f64) {
    let mass: f64 = run.masses.iter().sum();
    let g = f64::from(GRAVITY_M_S2);
    let height = |x: &[Vec3]| x.iter().zip(&run.masses).map(|(x, m)| f64::from(x.z) * m * g).sum::<f64>();
    let limit = height(start) + 0.5 * mass * speed_m_s * speed_m_s + mass * g * thickness_m;
    for (step, (x, kinetic)) in run.positions.iter().zip(run.kinetic_j()).enumerate() {
        let energy = height(x) + kinetic;
        assert!(energy <= limit, "step {}: {energy} J of {limit}", step + 1);
    }
}

/// Two free sheets, one tilted and shifted, fly into each other: contacts and zones act in pairs.
#[test]
fn colliding_sheets_keep_their_momentum() {
    // Of the sum of |m v|: an f32 rounding of every velocity in a step, of positions where zones act, and the residual.
    const RELATIVE: f64 = 2e-5;
    for speed_m_s in [0.5, 4.0] {
        let along = Vec3::new(1.0, 0.1, 0.05).normalize();
        let across = Vec3::new(-0.05, 0.03, 1.0).cross(along).normalize();
        let mut scene = contact_scene(
            together([
                sheet(12, 12, [0.2, 0.2], Vec3::new(-0.1, -0.1, 0.0), Vec3::X, Vec3::Y),
                sheet(10, 13, [0.16, 0.2], Vec3::new(-0.07, -0.08, 0.012), along, across),
            ]),
            1e-3,
            0.4,
            Vec3::ZERO,
        );
        scene.settings.relative_tolerance = 1e-7;
        for (v, velocity) in scene.velocities.iter_mut().enumerate() {
            *velocity = if v < 144 { Vec3::new(0.1, 0.0, speed_m_s) } else { Vec3::new(0.0, -0.3, -speed_m_s) };
        }
        let run = watch(&scene, 1, 40, cpu);
        let momentum = |v: &[Vec3]| v.iter().zip(&run.masses).map(|(v, &m)| v.as_dvec3() * m).sum::<DVec3>();
        let scale: f64 = scene.velocities.iter().zip(&run.masses).map(|(v, m)| f64::from(v.length()) * m).sum();
        let start = momentum(&scene.velocities);
        let worst =
            run.velocities.iter().map(|v| (momentum(v) - start).length() / scale).fold(0.0, |a: f64, b| a.max(b));
        let impacts: u64 = run.stats.iter().map(|s| s.zones.impacts).sum();
        println!("{speed_m_s} m/s: changed by {worst:.2e}, {}", run.summary());
        assert!(run.stats.iter().any(|s| s.contacts > 20) && (impacts > 0 || speed_m_s < 1.0), "{}", run.summary());
        assert!(worst < RELATIVE, "{speed_m_s} m/s: changed by {worst} of the sum of |m v|");
        let energy = run.kinetic_j();
        let start: f64 =
            scene.velocities.iter().zip(&run.masses).map(|(v, m)| 0.5 * m * v.as_dvec3().length_squared()).sum();
        let most = start * (1.0 + 1e-5);
        assert!(energy.iter().all(|&e| e <= most), "never more than {most} J: {energy:?}");
        println!("{speed_m_s} m/s: {:.3} of the energy is left", energy.last().unwrap() / start);
        assert_free(&scene, &run);
    }
}
