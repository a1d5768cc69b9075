//! Bending with known answers on the sheets of scene files: a clamped plate that sinks by its weight, a strip that
//! buckles under its own weight, and the drape test, whose coefficient grows with the stiffness of the fabric.

use loomtree::math::Vec3;
use loomtree::output::{FrameMesh, drape};
use loomtree::scene::{Fabric, Overrides, parse};
use support::physics::{ACROSS, GRAVITY_M_S2, OneRank, strip, uniform_fabric};
use support::scene;

/// How far the tip of a sheet of 0.1 m x 0.35 m sinks that is clamped over 0.05 m, with a flexural rigidity of 1 N m and
/// 1 kg/m^2, meters.
fn sinking_m() -> f64 {
    let text = r#"
        [simulation]
        step_s = 0.02
        collisions = false
        relative_tolerance = 1e-5
        max_iterations = 2000
        [[fabric]]
        name = "card"
        density_kg_m2 = 1.0
        stretching_n_m = [20000, 0, 20000, 10000]
        flexural_rigidity_n_m = 1.0
        [[cloth]]
        sheet = { size_m = [0.35, 0.1], triangles = 700, mesh = "grid" }
        plane = "xz"
        fabric = "card"
        damping_s = 0.01
        [[pin]]
        box_m = [[-0.01, -0.01, -0.2], [0.0501, 0.01, 0.01]]
        "#;
    let scene = parse(text, "plate.toml".as_ref(), &Overrides::default()).unwrap();
    let mut cloth = OneRank::new(&scene);
    cloth.settle(1e-5, 200);
    let (sum, count) = cloth
        .positions()
        .iter()
        .zip(&scene.mesh.positions)
        .filter(|(_, start)| start.x == 0.35)
        .fold((0.0, 0), |(sum, count), (p, _)| (sum - f64::from(p.y), count + 1));
    sum / f64::from(count)
}

#[test]
fn a_clamped_plate_sinks_by_weight_over_rigidity() {
    // w L^4 / 8 D. On the grid the clamp ends half a cell of 10 mm before the last pinned vertices
    // (tests/physics/rest.rs).
    let sinks_m = f64::from(GRAVITY_M_S2) * 0.305f64.powi(4) / 8.0;
    let part = sinking_m() / sinks_m;
    assert!((part - 1.0).abs() < 0.01, "{part} of the closed form");
}

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
