//! Air: drag along the cloth, pressure across it, terminal velocities. The sheets start flat and level, so that closed forms
//! hold; nothing here is about flutter.

use loomtree::math::Vec3;
use loomtree::scene::{PreconditionerKind, Scene};
use support::physics::{DOWN, GRAVITY_M_S2, OneRank, TIGHT};
use support::{isotropic_fabric, scene, sheet};

/// Mass per area of the sheets, kg/m^2.
const DENSITY_KG_M2: f64 = 0.1;

fn level_sheet(step_s: f64) -> Scene {
    let mesh = sheet(9, 9, [0.4, 0.4], Vec3::ZERO, Vec3::X, Vec3::Y);
    let mut scene = scene(mesh, isotropic_fabric(200.0, 0.3, 2e-4, DENSITY_KG_M2, 0.0), &[], step_s, Vec3::ZERO);
    scene.settings.relative_tolerance = TIGHT;
    scene
}

/// Linear drag c along the cloth: backward Euler gives v_n = v_0 (1 + dt c / rho h)^-n at every vertex.
#[test]
fn drag_along_the_cloth_slows_it_by_the_formula_of_backward_euler() {
    // f32 rounding of 50 steps and the solve's residual.
    const RELATIVE: f32 = 2e-5;
    let (step_s, drag, steps, start) = (0.01, 0.5, 50, Vec3::new(1.5, -0.5, 0.0));
    let mut scene = level_sheet(step_s);
    scene.settings.air_drag_kg_m2_s = drag;
    scene.velocities.fill(start);
    let mut cloth = OneRank::new(&scene);
    for _ in 0..steps {
        cloth.step();
    }
    let expected = start * (1.0 + step_s * drag / DENSITY_KG_M2).powi(-steps) as f32;
    assert!(expected.length() < 0.2 * start.length(), "there is something to see");
    for v in cloth.velocities() {
        assert!((v - expected).length() < RELATIVE * start.length(), "{v} m/s instead of {expected} m/s");
    }
}

/// A level sheet sinks at the velocity at which pressure carries it: rho_air v^2 = rho h g.
#[test]
fn a_falling_sheet_reaches_its_terminal_velocity() {
    // The approach is exponential with a time of v / 2g; after 1.2 s nothing is left but rounding and slight bending.
    const RELATIVE: f64 = 1e-3;
    let air = 1.2;
    let mut scene = level_sheet(0.02);
    scene.settings.gravity_m_s2 = DOWN;
    scene.settings.air_density_kg_m3 = air;
    let mut cloth = OneRank::new(&scene);
    let terminal = (DENSITY_KG_M2 * f64::from(GRAVITY_M_S2) / air).sqrt();
    for _ in 0..60 {
        cloth.step();
        assert!(f64::from(cloth.fastest_m_s()) < terminal * (1.0 + RELATIVE), "step {}: too fast", cloth.steps);
    }
    let mass: f64 = cloth.masses().iter().sum();
    let mean = cloth.momentum() / mass;
    assert!((mean.z / -terminal - 1.0).abs() < RELATIVE, "{mean} m/s instead of {terminal} m/s down");
    assert!(mean.truncate().length() < RELATIVE * terminal);
}

/// A free sheet ends at the wind's velocity: along the cloth exponentially with rho h / c, across it as rho h / (rho_air t).
fn ends_at_the_velocity_of_the_wind(preconditioner: PreconditionerKind) {
    // After 6 s the pressure has 0.1 / (1.2 * 6) m/s left to even out; the rest has decayed by e^-30.
    const LEFT_M_S: f32 = 0.1 / (1.2 * 6.0) * 1.1;
    let wind = Vec3::new(2.0, 0.5, 1.0);
    let mut scene = level_sheet(0.04);
    scene.settings.preconditioner = preconditioner;
    scene.settings.wind_m_s = wind;
    scene.settings.air_density_kg_m3 = 1.2;
    scene.settings.air_drag_kg_m2_s = 0.5;
    let mut cloth = OneRank::new(&scene);
    let mut gap = wind.length();
    let mass: f64 = cloth.masses().iter().sum();
    for _ in 0..150 {
        cloth.step();
        let now = ((cloth.momentum() / mass).as_vec3() - wind).length();
        assert!(now < gap + 1e-5, "step {}: the wind drives the sheet away from its velocity", cloth.steps);
        gap = now;
    }
    let worst = cloth.velocities().iter().map(|v| (*v - wind).length()).fold(0.0, f32::max);
    assert!(worst < LEFT_M_S, "{worst} m/s off the wind");
}

#[test]
fn a_free_sheet_ends_at_the_velocity_of_the_wind() {
    ends_at_the_velocity_of_the_wind(PreconditionerKind::Jacobi);
}

/// Stiff, and a tolerance near what f32 has: rounding breaks descents off that use the coarse level.
#[test]
fn solves_that_rounding_breaks_off_end_there_as_well() {
    ends_at_the_velocity_of_the_wind(PreconditionerKind::Schwarz);
}
