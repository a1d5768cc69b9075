//! Motion with known answers: free fall, a pendulum, momenta, energy, damping; backward Euler's own errors are part of
//! the answers. One rank except where the rank count matters; native executor; no contacts.

use std::f64::consts::PI;

use loomtree::math::{DVec3, Vec2, Vec3};
use loomtree::mesh::TriangleMesh;
use loomtree::scene::Scene;
use loomtree::solver::ExchangeMode;
use support::physics::{DOWN, GRAVITY_M_S2, OneRank, TIGHT, uniform_fabric};
use support::seeded::Seeded;
use support::{cpu, isotropic_fabric, scene, sheet, simulate};

/// A free horizontal sheet of `n` x `n` vertices and 0.4 m, centre at the origin.
fn free_sheet(n: usize, step_s: f64) -> Scene {
    let mesh = sheet(n, n, [0.4, 0.4], Vec3::new(-0.2, -0.2, 0.0), Vec3::X, Vec3::Y);
    let mut scene = scene(mesh, isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.0), &[], step_s, Vec3::ZERO);
    scene.settings.relative_tolerance = TIGHT;
    scene
}

/// Free fall under backward Euler: y_n = y_0 + n dt v_0 - g dt^2 n(n+1)/2, whatever the material and the rank count.
#[test]
fn free_fall_follows_the_formula_of_backward_euler() {
    // What f32 adds up to in 40 steps (one rounding of 6e-8 per step and value) and the solve's residual.
    const RELATIVE: f64 = 1e-5;
    let (steps, step_s, start) = (40, 0.01, Vec3::new(0.3, -0.2, 1.0));
    let mut scene = free_sheet(9, step_s);
    scene.settings.gravity_m_s2 = DOWN;
    scene.velocities.fill(start);
    let n = f64::from(steps);
    let fall = DVec3::new(0.0, 0.0, -0.5 * f64::from(GRAVITY_M_S2) * step_s * step_s * n * (n + 1.0));
    let expected = start.as_dvec3() * (n * step_s) + fall;
    for ranks in 1..=4 {
        let outcome = simulate(&scene, ranks, ExchangeMode::Halo, steps, cpu);
        for (x, from) in outcome.positions.iter().zip(&scene.mesh.positions) {
            let error = (x.as_dvec3() - from.as_dvec3() - expected).length();
            assert!(error < RELATIVE * expected.length(), "{ranks} ranks: off by {error} m");
        }
    }
}

/// A triangle held at two corners is a point mass on a rod. Closed form of the period: 2 pi sqrt(L/g) / agm(1, cos(A/2)).
#[test]
fn a_pendulum_has_the_period_of_its_amplitude() {
    // Backward Euler loses about 0.25 % of the amplitude per second at this step, and the rod stretches by 0.02 %.
    const RELATIVE: f64 = 3e-3;
    let (length_m, step_s) = (1.0f32, 1.0 / 2000.0);
    for amplitude_deg in [10.0f64, 60.0, 90.0] {
        let amplitude = amplitude_deg.to_radians();
        let bob = Vec3::new(amplitude.sin() as f32, 0.0, -amplitude.cos() as f32) * length_m;
        let mesh = TriangleMesh {
            positions: vec![Vec3::new(0.0, -0.05, 0.0), Vec3::new(0.0, 0.05, 0.0), bob],
            triangles: vec![[0, 1, 2]],
            material_uv: vec![[Vec2::new(-0.05, 0.0), Vec2::new(0.05, 0.0), Vec2::new(0.0, length_m)]],
        };
        let mut scene = scene(mesh, isotropic_fabric(1e4, 0.0, 0.0, 0.2, 0.0), &[0, 1], step_s, DOWN);
        scene.settings.relative_tolerance = TIGHT;
        let mut pendulum = OneRank::new(&scene);
        // Two passes through the lowest point are half a period apart.
        let mut passes = Vec::new();
        let mut before = bob.x;
        while passes.len() < 2 {
            pendulum.step();
            let x = pendulum.positions()[2].x;
            if (x > 0.0) != (before > 0.0) {
                passes.push((f64::from(pendulum.steps) - f64::from(x / (x - before))) * step_s);
            }
            before = x;
            assert!(pendulum.steps < 10_000, "the pendulum does not swing");
        }
        let period = 2.0 * (passes[1] - passes[0]);
        let (mut a, mut b): (f64, f64) = (1.0, (amplitude / 2.0).cos());
        for _ in 0..8 {
            (a, b) = (0.5 * (a + b), (a * b).sqrt());
        }
        let expected = 2.0 * PI * (f64::from(length_m) / f64::from(GRAVITY_M_S2)).sqrt() / a;
        assert!((period / expected - 1.0).abs() < RELATIVE, "{amplitude_deg} deg: {period} s instead of {expected} s");
    }
}

/// Forces inside the cloth, damping among them, add up to zero.
#[test]
fn momentum_is_constant_without_external_force() {
    // Of the sum of |m v|: per step an f32 rounding of every velocity and the solve's residual.
    const RELATIVE: f64 = 1e-5;
    let mut scene = free_sheet(12, 0.004);
    scene.settings.relative_tolerance = 1e-7;
    scene.fabrics[0].damping_s = 0.001;
    let mut random = Seeded::new(4);
    scene.velocities.iter_mut().for_each(|v| *v = random.vector() + Vec3::new(0.1, 0.2, 0.3));
    let mut cloth = OneRank::new(&scene);
    let start = cloth.momentum();
    let scale: f64 = cloth.masses().iter().zip(&scene.velocities).map(|(m, v)| m * f64::from(v.length())).sum();
    for _ in 0..40 {
        cloth.step();
        let change = (cloth.momentum() - start).length();
        assert!(change < RELATIVE * scale, "step {}: changed by {change} of {scale} kg m/s", cloth.steps);
    }
}

/// Backward Euler does not keep angular momentum: with f1 = f(x1), L1 = L0 + dt sum x0 x f1 = L0 - dt^2 sum v1 x f1, which for a
/// sheet spinning at w is L0 (1 - (w dt)^2). It must lose this much, and never gain. The step is short because the linearised
/// force sees the chord of the rotation as a strain of (w dt)^2 / 2, small only against the strain of the spin if
/// E h dt^2 << rho h r^2.
#[test]
fn angular_momentum_of_a_spinning_sheet_shrinks_as_backward_euler_says() {
    // Of the momentum, per step: rounding and residual.
    const NOISE: f64 = 2e-6;
    // Of the predicted loss: the sheet also widens and breathes.
    const LOSS_RELATIVE: f64 = 0.1;
    let (spin_rad_s, step_s, steps) = (10.0f32, 0.0005, 400);
    let mut scene = free_sheet(9, step_s);
    for (v, x) in scene.velocities.iter_mut().zip(&scene.mesh.positions) {
        *v = (Vec3::Z * spin_rad_s).cross(*x);
    }
    let mut cloth = OneRank::new(&scene);
    let start = cloth.angular_momentum().z;
    let mut last = start;
    for _ in 0..steps {
        cloth.step();
        let now = cloth.angular_momentum();
        assert!(now.z < last + NOISE * start, "step {}: grew by {}", cloth.steps, now.z / last - 1.0);
        assert!(now.truncate().length() < 1e-3 * start, "the axis turns: {now}");
        last = now.z;
    }
    let predicted = 1.0 - (1.0 - (f64::from(spin_rad_s) * step_s).powi(2)).powi(steps);
    let loss = 1.0 - last / start;
    assert!((loss / predicted - 1.0).abs() < LOSS_RELATIVE, "lost {loss} instead of {predicted}");
}

/// Backward Euler takes energy away and never adds any, at steps from far below to far above the cloth's own periods. With
/// one linearised solve per step this holds while a step turns the cloth by small angles only, as here; it is no guarantee: a
/// sheet rolled to 0.1 m as stiff as 0.02 N m (150 times denim) springs open within one step of 20 ms and gains.
#[test]
fn energy_never_grows_without_forcing() {
    // Of the start energy, per step: residual of the solve and rounding of the positions.
    const NOISE: f64 = 1e-5;
    type Shape = fn(Vec3) -> Vec3;
    let stretched: Shape = |x| Vec3::new(x.x * 1.1, x.y * 1.05, 0.03 * (x.x * 12.0).sin());
    // A cylinder of 0.1 m radius, without stretching but for the chords.
    let rolled: Shape = |x| Vec3::new(0.1 * (x.x * 10.0).sin(), x.y, 0.1 * (x.x * 10.0).cos());
    for (name, shape, bending_n_m, bending_share) in
        [("stretched", stretched, 2e-3, 0.0), ("rolled", rolled, 1e-3, 0.5)]
    {
        for step_s in [1e-4, 1e-3, 4e-3, 2e-2] {
            let mut scene = free_sheet(11, step_s);
            scene.fabrics = vec![isotropic_fabric(200.0, 0.3, bending_n_m, 0.15, 0.0)];
            scene.mesh.positions.iter_mut().for_each(|x| *x = shape(*x));
            let mut cloth = OneRank::new(&scene);
            let start = cloth.energy_j();
            let share = cloth.bend_energy_j() / start;
            assert!(share > bending_share, "{name}: bending is {share} of the energy");
            let mut last = start;
            for _ in 0..60 {
                cloth.step();
                let now = cloth.energy_j();
                let step = cloth.steps;
                assert!(now < last + NOISE * start, "{name}, dt {step_s}, step {step}: {last} -> {now} of {start} J");
                last = now;
            }
            assert!(last < start * 0.995, "{name}, dt {step_s}: {last} of {start} J are left after 60 steps");
        }
    }
}

/// Damping proportional to stiffness: a mode of angular frequency w decays as exp(-damping w^2 t / 2) in amplitude. The lowest
/// longitudinal mode of a free strip of length L has w = pi/L sqrt(E h / (rho h)).
#[test]
fn stiffness_proportional_damping_has_its_rate() {
    // Backward Euler's own decay w^2 dt / 2 is taken out; what is left is of order (w dt)^2, and the finite strain.
    const RELATIVE: f64 = 0.05;
    let (eh_n_m, density_kg_m2, length_m, step_s, damping_s) = (100.0, 0.1, 0.4f64, 2e-5, 4e-4);
    let omega = PI / length_m * f64::sqrt(eh_n_m / density_kg_m2);
    let steps = (2.0 * PI / omega / step_s).round() as u32;
    let remaining = |damping_s: f64| {
        let mesh = sheet(21, 2, [length_m as f32, 0.02], Vec3::X * (-0.5 * length_m as f32), Vec3::X, Vec3::Y);
        let mut fabric = uniform_fabric([eh_n_m, 0.0, eh_n_m, 2.0 * eh_n_m], 0.0, density_kg_m2);
        fabric.damping_s = damping_s;
        let mut scene = scene(mesh, fabric, &[], step_s, Vec3::ZERO);
        scene.settings.relative_tolerance = TIGHT;
        // Strain 0.1 % cos(pi x / L): the mode itself.
        for x in &mut scene.mesh.positions {
            x.x += (1e-3 * length_m / PI * (PI * f64::from(x.x) / length_m).sin()) as f32;
        }
        let mut cloth = OneRank::new(&scene);
        let start = cloth.energy_j();
        for _ in 0..steps {
            cloth.step();
        }
        cloth.energy_j() / start
    };
    let (undamped, damped) = (remaining(0.0), remaining(damping_s));
    assert!(damped < undamped && undamped < 1.0);
    // Energy: twice the amplitude's rate.
    let rate = -(damped / undamped).ln() / (f64::from(steps) * step_s);
    let expected = damping_s * omega * omega;
    assert!((rate / expected - 1.0).abs() < RELATIVE, "{rate} 1/s instead of {expected} 1/s");
}
