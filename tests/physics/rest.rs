//! Shapes at rest with known answers: a hanging strip, a catenary, a cantilever under its own weight, a fabric stiffer along
//! the warp than along the weft. The cloth is released and steps are long, so that backward Euler itself brings it to rest;
//! nothing here is about the way there.

use loomtree::math::Vec3;
use loomtree::scene::Scene;
use support::physics::{ACROSS, DOWN, GRAVITY_M_S2, OneRank, TO_REST, strip, uniform_fabric};
use support::scene;

/// About the angular frequency of the swings that still air has to take out: drag 2 rho h times this is critical.
const SWING_RAD_S: f64 = 8.0;

/// Elongation of a strip of `length_m` hung by its end, warp or weft along gravity, m.
fn elongation(stretching_n_m: [f64; 4], density_kg_m2: f64, length_m: f32, weft: bool) -> f64 {
    let cells = 20;
    let mut mesh = strip(cells, length_m / cells as f32, Vec3::NEG_Z);
    if weft {
        mesh.material_uv.iter_mut().flatten().for_each(|p| *p = loomtree::math::Vec2::new(-p.y, p.x));
    }
    let mut scene = scene(mesh, uniform_fabric(stretching_n_m, 0.0, density_kg_m2), &[0, 1, 2], 0.02, DOWN);
    scene.settings.relative_tolerance = TO_REST;
    let mut cloth = OneRank::new(&scene);
    cloth.settle(1e-5, 400);
    f64::from(-cloth.positions()[ACROSS * cells + 1].z - length_m)
}

/// Strain grows linearly from the free end: tip elongation (rho g h) L^2 / (2 E h) for Poisson's ratio 0.
#[test]
fn a_hanging_strip_stretches_by_its_weight() {
    // The largest strain of 0.2 % makes a Green-strain material stiffer by as much; f32 positions add 0.01 %.
    const RELATIVE: f64 = 5e-3;
    let (eh, density, length) = (1000.0, 0.2, 1.0);
    let expected = density * f64::from(GRAVITY_M_S2) * length * length / (2.0 * eh);
    let measured = elongation([eh, 0.0, eh, 2.0 * eh], density, length as f32, false);
    assert!((measured / expected - 1.0).abs() < RELATIVE, "{measured} m instead of {expected} m");
}

#[test]
fn a_stiff_warp_stretches_less_by_the_ratio_of_the_table() {
    // As above: finite strain.
    const RELATIVE: f64 = 1e-2;
    let table = [800.0, 0.0, 200.0, 150.0];
    let ratio = elongation(table, 0.1, 0.5, true) / elongation(table, 0.1, 0.5, false);
    assert!((ratio / (table[0] / table[2]) - 1.0).abs() < RELATIVE, "{ratio}");
}

/// Root of a function that changes its sign between `low` and `high`.
fn bisect(mut low: f64, mut high: f64, f: impl Fn(f64) -> f64) -> f64 {
    let rising = f(high) > 0.0;
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if (f(middle) > 0.0) == rising { high = middle } else { low = middle }
    }
    0.5 * (low + high)
}

/// A strip without bending stiffness held at both ends hangs in a catenary: z = a cosh(x / a), L = 2 a sinh(S / 2a).
#[test]
fn a_strip_held_at_both_ends_hangs_in_a_catenary() {
    // Of the span: tension stretches the strip by at most 0.1 %, and 32 chords are shorter than the arc by 0.04 %.
    const OF_SPAN: f64 = 3e-3;
    let (cells, span_m, density, eh) = (32, 1.0, 0.1, 1000.0);
    for length_m in [1.05, 1.2, 1.5, 2.0] {
        let mut mesh = strip(cells, (length_m / cells as f64) as f32, Vec3::X);
        // Start: an arc of a circle through both supports.
        let half_angle = bisect(1e-6, 3.1, |angle| angle.sin() / angle - span_m / length_m);
        let radius = length_m / (2.0 * half_angle);
        let arc = |i: usize| length_m * ((i / ACROSS) as f64 / cells as f64 - 0.5);
        for (i, x) in mesh.positions.iter_mut().enumerate() {
            let angle = arc(i) / radius;
            (x.x, x.z) = ((radius * angle.sin()) as f32, (radius * (half_angle.cos() - angle.cos())) as f32);
        }
        let ends = [0, 1, 2].map(|i| [i, (ACROSS * cells) as u32 + i]);
        let mut scene =
            scene(mesh, uniform_fabric([eh, 0.0, eh, 2.0 * eh], 0.0, density), ends.as_flattened(), 0.02, DOWN);
        scene.settings.relative_tolerance = TO_REST;
        scene.settings.air_drag_kg_m2_s = 2.0 * density * SWING_RAD_S;
        let mut cloth = OneRank::new(&scene);
        cloth.settle(1e-4, 300);

        let a = bisect(0.05, 20.0, |a| 2.0 * a * (span_m / (2.0 * a)).sinh() - length_m);
        for (i, x) in cloth.positions().iter().enumerate() {
            let s = arc(i);
            let (expected_x, expected_z) = (a * (s / a).asinh(), a.hypot(s) - a.hypot(0.5 * length_m));
            let error = (f64::from(x.x) - expected_x).hypot(f64::from(x.z) - expected_z);
            assert!(error < OF_SPAN * span_m, "length {length_m} m, vertex {i}: {error} m from the catenary");
        }
    }
}

/// Tip of a heavy elastica clamped level, D theta'' = -w (L - s) cos theta, theta(0) = 0, theta'(L) = 0, by shooting with
/// classical Runge-Kutta: (x, drop) over L for Gamma = w L^3 / D.
fn heavy_elastica(gamma: f64) -> [f64; 2] {
    let shoot = |curvature: f64| {
        let steps = 2000;
        let h = 1.0 / f64::from(steps);
        let rate = |s: f64, y: [f64; 4]| [y[1], -gamma * (1.0 - s) * y[0].cos(), y[0].cos(), y[0].sin()];
        let mut y = [0.0, curvature, 0.0, 0.0];
        for i in 0..steps {
            let s = f64::from(i) * h;
            let along = |k: [f64; 4], by: f64| std::array::from_fn(|c| y[c] + by * k[c]);
            let k1 = rate(s, y);
            let k2 = rate(s + 0.5 * h, along(k1, 0.5 * h));
            let k3 = rate(s + 0.5 * h, along(k2, 0.5 * h));
            let k4 = rate(s + h, along(k3, h));
            y = std::array::from_fn(|c| y[c] + h / 6.0 * (k1[c] + 2.0 * k2[c] + 2.0 * k3[c] + k4[c]));
        }
        y
    };
    // The moment at the clamp of the undeformed strip is the largest possible one.
    let y = shoot(bisect(0.0, 0.5 * gamma + 1e-9, |curvature| shoot(curvature)[1]));
    [y[2], y[3]]
}

#[test]
fn the_heavy_elastica_agrees_with_the_published_table() {
    let Some(data) = std::env::var_os("LOOMTREE_TEST_DATA") else {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
        return;
    };
    let table = std::path::Path::new(&data).join("reference-curves/heavy_elastica_cantilever.csv");
    let text = std::fs::read_to_string(&table).unwrap();
    for line in text.lines().skip(1).step_by(10) {
        let row: Vec<f64> = line.split(',').map(|v| v.parse().unwrap()).collect();
        // Gamma, x / L, drop / L. Beyond 100 a strip hangs almost straight down.
        if row[0] < 100.0 {
            let [x, drop] = heavy_elastica(row[0]);
            assert!((x - row[1]).abs() < 1e-6 && (drop - row[2]).abs() < 1e-6, "Gamma {}: {x} {drop}", row[0]);
        }
    }
}

const CANTILEVER_M: f64 = 0.25;
const CANTILEVER_KG_M2: f64 = 0.2;

/// A strip with its first two rows of vertices held: a hinge of the second row stands for the curvature between the middles of the
/// cells beside it, so the clamp lies in the middle of the first cell and `cells` - 1/2 cells are free.
fn cantilever(cells: usize, gamma: f64) -> (Scene, f64) {
    let cell_m = CANTILEVER_M / (cells as f64 - 0.5);
    // Hinges across the strip on a grid of cell h: torsion stiffness ke l^2 / (4a) with l = h, a = h^2, that is ke / 4, at the
    // angle kappa h; energy per area ke kappa^2 / 8 = D kappa^2 / 2, hence ke = 4 D. Diagonals do not fold in a cylinder.
    let flexural_n_m = CANTILEVER_KG_M2 * f64::from(GRAVITY_M_S2) * CANTILEVER_M.powi(3) / gamma;
    let eh = 400.0;
    let fabric = uniform_fabric([eh, 0.0, eh, 2.0 * eh], 4.0 * flexural_n_m, CANTILEVER_KG_M2);
    let mut scene = scene(strip(cells, cell_m as f32, Vec3::X), fabric, &[0, 1, 2, 3, 4, 5], 0.03, DOWN);
    // Tighter than elsewhere: next to the membrane's rounding noise the bending moments are small.
    scene.settings.relative_tolerance = 1e-5;
    scene.settings.max_iterations = 1000;
    scene.settings.air_drag_kg_m2_s = 2.0 * CANTILEVER_KG_M2 * SWING_RAD_S;
    (scene, cell_m)
}

/// The drop at 5, 10 and 20 cells against the heavy elastica; the chord angle at the finest.
fn refine_cantilever(gamma: f64) {
    // Chords instead of a curve, hinges at held corners, up to 0.1 % of stretching and as much of a rest of motion.
    const DROP_RELATIVE: [f64; 3] = [6e-2, 1.5e-2, 6e-3];
    const CHORD_DEG: f64 = 0.3;
    let [x, drop] = heavy_elastica(gamma);
    let mut errors = [0.0; 3];
    for (i, cells) in [5, 10, 20].into_iter().enumerate() {
        let (scene, cell_m) = cantilever(cells, gamma);
        let mut cloth = OneRank::new(&scene);
        cloth.settle(1e-4, 400);
        let tip = cloth.positions()[ACROSS * cells + 1].as_dvec3();
        let measured = [(tip.x - 0.5 * cell_m) / CANTILEVER_M, -tip.z / CANTILEVER_M];
        errors[i] = measured[1] / drop - 1.0;
        println!("Gamma {gamma}, {cells} cells: drop {:.5} L, {:+.3} %", measured[1], 100.0 * errors[i]);
        assert!(errors[i].abs() < DROP_RELATIVE[i], "Gamma {gamma}, {cells} cells: {} L, not {drop} L", measured[1]);
        let off_deg = (measured[1].atan2(measured[0]) - drop.atan2(x)).to_degrees();
        assert!(i < 2 || off_deg.abs() < CHORD_DEG, "Gamma {gamma}: chord off by {off_deg} deg");
    }
    assert!(errors[2].abs() < 0.5 * errors[0].abs(), "Gamma {gamma}: refining does not help: {errors:?}");
}

/// Small deflections: the drop is Gamma / 8 L but for 1.2 %, so a wrong factor of the bending stiffness shows as itself.
#[test]
fn a_stiff_cantilever_converges_to_the_heavy_elastica() {
    refine_cantilever(1.0);
}

/// The angle of 41.5 degrees of Peirce's cantilever test.
#[test]
fn a_bent_cantilever_converges_to_the_heavy_elastica() {
    refine_cantilever(8.0);
}

#[test]
fn a_hanging_cantilever_converges_to_the_heavy_elastica() {
    refine_cantilever(30.0);
}
