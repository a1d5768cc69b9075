//! A strip of cloth lies on a table and hangs over its edge: let go, it slides as a rope over an edge does. For sharp
//! and round edges, without friction and with Coulomb's (capstan, exp(mu phi)).

use loomtree::math::Vec3;
use loomtree::mesh::Surface;
use loomtree::scene::{Pin, Scene};
use support::contact::{contact_scene, obstacle};
use support::physics::{ACROSS, DOWN, GRAVITY_M_S2, OneRank, strip};

const THICKNESS_M: f32 = 1.5e-3;
const LYING_M: f32 = 0.4;
const LENGTH_M: f32 = 1.0;
const SECONDS: f64 = 0.2;
/// The strip swings down and comes to rest with its end held.
const HELD_S: f64 = 2.0;

/// A table whose top is at height 0 and whose front is at x = 0, with a quarter of a cylinder in place of its edge.
fn table(radius_m: f32) -> Surface {
    let mut profile = vec![[-2.0, 0.0], [-radius_m, 0.0]];
    let segments = if radius_m > 0.0 { 24 } else { 0 };
    for i in 1..=segments {
        let (sin, cos) = (std::f32::consts::FRAC_PI_2 * i as f32 / segments as f32).sin_cos();
        profile.push([radius_m * (sin - 1.0), radius_m * (cos - 1.0)]);
    }
    profile.push([0.0, -2.0]);
    let mut surface = Surface::default();
    for (i, [x, z]) in profile.into_iter().enumerate() {
        surface.positions.extend([-0.5, 0.5].map(|y| Vec3::new(x, y, z)));
        if i > 0 {
            let a = 2 * (i as u32 - 1);
            surface.triangles.extend([[a, a + 2, a + 3], [a, a + 3, a + 1]]);
        }
    }
    surface
}

fn scene(cell_m: f32, radius_m: f32, mu: f64) -> Scene {
    let cells = (LENGTH_M / cell_m).round() as usize;
    let mut mesh = strip(cells, LENGTH_M / cells as f32, Vec3::X);
    mesh.positions.iter_mut().for_each(|x| *x += Vec3::new(-LYING_M, 0.0, 0.99 * THICKNESS_M));
    let mut scene = contact_scene(mesh, f64::from(THICKNESS_M), mu, DOWN);
    scene.obstacles = vec![obstacle("table", table(radius_m), mu)];
    scene.pins = (0..ACROSS as u32).map(|vertex| Pin::new(vertex, None, 0.0, HELD_S)).collect();
    scene
}

/// How far a rope slides over the edge in `SECONDS`, metres: what hangs and lies on the round part drives it, the
/// tension at the edge grows by exp(mu pi / 2).
fn rope_m(radius_m: f64, mu: f64) -> f64 {
    let (g, grows) = (f64::from(GRAVITY_M_S2), (mu * std::f64::consts::FRAC_PI_2).exp());
    let length = f64::from(LENGTH_M);
    // What hangs straight, and of the round part its height.
    let start = length - (f64::from(LYING_M) - radius_m) - radius_m * std::f64::consts::FRAC_PI_2 + radius_m;
    let (mut hanging, mut v, dt) = (start, 0.0f64, 1e-5);
    for _ in 0..(SECONDS / dt) as u32 {
        let lying = length - hanging;
        let a = (hanging * g + (grows - 1.0) * v * v - grows * lying * mu * g) / (hanging + grows * lying);
        v = (v + dt * a).max(0.0);
        hanging += dt * v;
    }
    hanging - start
}

/// Slid, of the rope's way.
fn slid(cell_m: f32, radius_m: f32, mu: f64, step_s: f64) -> f64 {
    let mut scene = scene(cell_m, radius_m, mu);
    scene.settings.step_s = step_s;
    let mut cloth = OneRank::new(&scene);
    let tail =
        |cloth: &OneRank| cloth.positions()[..ACROSS].iter().map(|x| f64::from(x.x)).sum::<f64>() / ACROSS as f64;
    for _ in 0..(HELD_S / step_s).round() as u32 {
        cloth.step();
    }
    let start = tail(&cloth);
    let (mut zones, steps) = (0, (SECONDS / step_s).round() as u32);
    for _ in 0..steps {
        zones += u32::from(cloth.step().zones.impacts > 0);
    }
    let (way, rope) = (tail(&cloth) - start, rope_m(f64::from(radius_m), mu));
    let ratio = way / rope;
    println!("cells {cell_m} m, edge {radius_m} m, mu {mu}, {step_s} s: {way:.4} of {rope:.4} m = {ratio:.3}");
    assert!(zones * 20 <= steps, "zones in {zones} of {steps} steps");
    ratio
}

#[test]
fn a_strip_slides_over_a_sharp_edge_without_friction() {
    for (cell_m, step_s, least) in [(0.014, 0.004, 0.75), (0.007, 0.004, 0.85), (0.014, 0.002, 0.75)] {
        let ratio = slid(cell_m, 0.0, 0.0, step_s);
        assert!((least..1.1).contains(&ratio), "cells {cell_m} m, {step_s} s: {ratio}");
    }
}

#[test]
fn a_strip_slides_over_a_round_edge_without_friction() {
    for (cell_m, radius_m) in [(0.014, 0.05), (0.007, 0.02)] {
        let ratio = slid(cell_m, radius_m, 0.0, 0.004);
        assert!((0.9..1.1).contains(&ratio), "cells {cell_m} m, edge {radius_m} m: {ratio}");
    }
}

#[test]
fn a_strip_slides_over_an_edge_with_friction() {
    for (radius_m, mu) in [(0.05, 0.1), (0.05, 0.3)] {
        let ratio = slid(0.014, radius_m, mu, 0.004);
        assert!((0.8..1.2).contains(&ratio), "edge {radius_m} m, mu {mu}: {ratio}");
    }
}
