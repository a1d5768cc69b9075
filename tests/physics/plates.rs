//! Bending with known answers on the sheets of scene files: a strip that buckles under its
//! own weight, and the drape test, whose coefficient grows with the stiffness of the fabric.

use loomtree::math::Vec3;
use loomtree::output::{FrameMesh, drape};
use loomtree::scene::{Fabric, Overrides, parse};
use support::physics::{ACROSS, GRAVITY_M_S2, OneRank, strip, uniform_fabric};
use support::scene;

/// A vertical strip that is clamped at its lower end falls over where its weight per area passes 7.837 D / L^3
/// (Greenhill's column).
#[test]
fn a_standing_strip_buckles_under_its_own_weight_at_the_known_length() {
    const CELLS: usize = 20;
    let sideways = |gamma: f64| {
        let (length, density) = (0.25, 0.2);
        let cell_m = length / (CELLS as f64 - 0.5);
        let rigidity = density * f64::from(GRAVITY_M_S2) * f64::powi(length, 3) / gamma;
        let fabric = uniform_fabric([400.0, 0.0, 400.0, 800.0], 4.0 * rigidity, density);
        // A thousandth of the weight pushes sideways.
        let gravity = Vec3::new(1e-3, 0.0, -1.0) * GRAVITY_M_S2;
        let mut scene = scene(strip(CELLS, cell_m as f32, Vec3::Z), fabric, &[0, 1, 2, 3, 4, 5], 0.03, gravity);
        scene.settings.relative_tolerance = 1e-5;
        scene.settings.max_iterations = 1000;
        let mut cloth = OneRank::new(&scene);
        (0..400).for_each(|_| {
            cloth.step();
        });
        f64::from(cloth.positions()[ACROSS * CELLS + 1].x) / length
    };
    // Below the critical weight the push is amplified by about 1 / (1 - gamma / 7.837), beyond it the strip hangs over.
    let (standing, buckled) = (sideways(7.0), sideways(8.7));
    assert!((1e-4..0.03).contains(&standing), "at 7.0 the tip is {standing} L aside");
    assert!(buckled > 0.25, "at 8.7 the tip is {buckled} L aside");
}

/// Drape coefficient of a preset after one second, on a disc of 1,024 triangles.
fn drape_coefficient(fabric: &str) -> f64 {
    let text = format!(
        r#"
        [simulation]
        step_s = 0.008
        collisions = false
        [air]
        [[cloth]]
        sheet = {{ radius_m = 0.15, triangles = 1024 }}
        plane = "xz"
        fabric = "{fabric}"
        damping_s = 0.004
        [[pin]]
        sphere = {{ center_m = [0, 0, 0], radius_m = 0.091 }}
        "#
    );
    let scene = parse(&text, "cusick.toml".as_ref(), &Overrides::default()).unwrap();
    let mut cloth = OneRank::new(&scene);
    (0..125).for_each(|_| {
        cloth.step();
    });
    let mesh = |positions| FrameMesh { positions, triangles: scene.mesh.triangles.clone() };
    drape(&mesh(scene.mesh.positions.clone()), &mesh(cloth.positions()), 0.09, 1)[0].coefficient
}

#[test]
fn silk_drapes_better_than_cotton_and_cotton_better_than_denim() {
    let [silk, cotton, denim] = ["silk", "cotton", "denim"].map(drape_coefficient);
    let all = format!("silk {silk}, cotton {cotton}, denim {denim}");
    assert!(silk > 0.15 && silk + 0.05 < cotton && cotton + 0.15 < denim && denim < 0.95, "{all}");
    // Bending lengths (rigidity / weight)^(1/3) of 1.3, 1.6 and 2.7 cm.
    let lengths = ["silk", "cotton", "denim"].map(|name| {
        let fabric = Fabric::preset(name).unwrap();
        let bending = fabric.bending_n_m.iter().map(|row| row[0]).sum::<f64>() / 3.0;
        (bending / 4.0 / fabric.density_kg_m2 / f64::from(GRAVITY_M_S2)).cbrt()
    });
    assert!(lengths.is_sorted() && (0.01..0.03).contains(&lengths[0]), "{lengths:?}");
}
