//! Pins that follow an obstacle: held vertices keep their place on a triangle that moves, for any number of ranks,
//! until they are released.

use std::path::Path;

use loomtree::math::{DQuat, DVec3, Vec3};
use loomtree::scene::{Overrides, Scene, parse};
use loomtree::solver::ExchangeMode;
use support::{Outcome, cpu, simulate};

const STEP_S: f64 = 0.004;

/// A sheet above a box that turns and rises; the pin holds what `select` says.
fn scene(select: &str, more: &str) -> Scene {
    let text = format!(
        r#"
        [simulation]
        step_s = {STEP_S}
        steps_per_frame = 1
        substeps = 1
        [[cloth]]
        sheet = {{ size_m = [1, 1], triangles = 256 }}
        plane = "xz"
        origin_m = [-0.5, 0.31, 0.5]
        [[obstacle]]
        name = "ball"
        sphere = {{ center_m = [9, 0, 0], radius_m = 0.1, triangles = 20 }}
        [[obstacle]]
        name = "table"
        box = {{ center_m = [0, 0.25, 0], size_m = [0.6, 0.1, 0.6], triangles = 48 }}
        motion = [{{ time_s = 0 }}, {{ time_s = 1, rotate_deg = [90, 0, 1, 0], translate_m = [0, 0.4, 0.2] }}]
        [[pin]]
        follow = "table"
        {select}
        {more}
        "#
    );
    parse(&text, Path::new("x.toml"), &Overrides::default()).unwrap()
}

/// Where the table has what is at `start` at time 0.
fn moved(start: Vec3, time_s: f64) -> DVec3 {
    DQuat::from_rotation_y(time_s * std::f64::consts::FRAC_PI_2) * start.as_dvec3() + DVec3::new(0.0, 0.4, 0.2) * time_s
}

fn after(scene: &Scene, ranks: usize, steps: u32) -> Outcome {
    simulate(scene, ranks, ExchangeMode::Halo, steps, cpu)
}

#[test]
fn held_vertices_keep_their_place_on_a_turning_box_for_any_number_of_ranks() {
    let scene = scene("box_m = [[-0.25, 0, -0.25], [0.25, 1, 0.25]]", "");
    let held: Vec<u32> = scene.pins.iter().map(|pin| pin.vertex).collect();
    assert!(held.len() > 20 && scene.pins.iter().all(|pin| pin.motion == Some(0)) && scene.followed == [1]);
    let steps = 20;
    let one = after(&scene, 1, steps);
    for &vertex in &held {
        let start = scene.mesh.positions[vertex as usize];
        let off = one.positions[vertex as usize].as_dvec3().distance(moved(start, f64::from(steps) * STEP_S));
        assert!(off < 1e-6, "vertex {vertex} is {off:e} m off");
    }
    for ranks in [2, 3, 5] {
        let other = after(&scene, ranks, steps);
        assert!(other.positions == one.positions && other.velocities == one.velocities, "{ranks} ranks");
    }
}

#[test]
fn released_vertices_fall() {
    let scene = scene("nearest = 9", "end_s = 0.02");
    assert_eq!(scene.pins.len(), 9);
    let held = after(&scene, 2, 5);
    let free = after(&scene, 2, 10);
    for pin in &scene.pins {
        let start = scene.mesh.positions[pin.vertex as usize];
        let at = |time_s: f64| moved(start, time_s);
        assert!(held.positions[pin.vertex as usize].as_dvec3().distance(at(0.02)) < 1e-6);
        assert!(free.positions[pin.vertex as usize].as_dvec3().distance(at(0.04)) > 1e-6, "no pin holds it");
    }
}

#[test]
fn the_nearest_vertices_are_those_closest_to_the_obstacle() {
    let scene = scene("nearest = 40", "");
    let held: Vec<u32> = scene.pins.iter().map(|pin| pin.vertex).collect();
    // All vertices lie 10 mm above the table; those beside it are farther away.
    let outside = |v: u32| scene.mesh.positions[v as usize].abs();
    assert!(held.iter().all(|&v| outside(v).x <= 0.31 && outside(v).z <= 0.31), "{held:?}");
    assert_eq!(held.len(), 40);
}
