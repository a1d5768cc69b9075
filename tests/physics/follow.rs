//! Pins that follow an obstacle: held vertices keep their place on a triangle that moves, for any number of ranks,
//! until they are released.

use std::path::Path;

use loomtree::math::{DQuat, DVec3, Vec3};
use loomtree::model::GlobalModel;
use loomtree::scene::{Overrides, Scene, parse};
use loomtree::solver::ExchangeMode;
use support::{Outcome, cpu, on_ranks, simulate, whole_state};

const STEP_S: f64 = 0.004;

/// A sheet above a box that turns and rises; the pin holds what `select` says.
fn scene(select: &str, more: &str) -> Scene {
    held_by("follow", select, more)
}

fn held_by(how: &str, select: &str, more: &str) -> Scene {
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
        {how} = "table"
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

/// Where the table has, at `later_s`, what is at `point` at `time_s`.
fn carried(point: Vec3, time_s: f64, later_s: f64) -> DVec3 {
    let way = |time_s: f64| DVec3::new(0.0, 0.4, 0.2) * time_s;
    let turn = |time_s: f64| DQuat::from_rotation_y(time_s * std::f64::consts::FRAC_PI_2);
    turn(later_s) * (turn(time_s).inverse() * (point.as_dvec3() - way(time_s))) + way(later_s)
}

#[test]
fn a_late_pin_takes_its_place_on_the_moving_box_when_it_begins() {
    let begins = 6;
    let start_s = f64::from(begins) * STEP_S;
    let scene = scene("nearest = { point_m = [0, 0.3, 0], count = 9 }", &format!("start_s = {start_s}"));
    assert!(
        scene.pins.len() == 9 && scene.pins.iter().all(|pin| scene.mesh.positions[pin.vertex as usize].length() < 0.5)
    );
    let (free, held) = (after(&scene, 2, begins), after(&scene, 2, begins + 14));
    for pin in &scene.pins {
        let [before, now] = [&free, &held].map(|outcome| outcome.positions[pin.vertex as usize]);
        let off = now.as_dvec3().distance(carried(before, start_s, start_s + 14.0 * STEP_S));
        assert!(off < 1e-6, "vertex {} is {off:e} m off", pin.vertex);
        assert!(
            before.as_dvec3().distance(moved(scene.mesh.positions[pin.vertex as usize], start_s)) > 1e-3,
            "it fell"
        );
    }
    for ranks in [1, 3, 5] {
        let other = after(&scene, ranks, begins + 14);
        assert!(other.positions == held.positions && other.velocities == held.velocities, "{ranks} ranks");
    }
}

#[test]
fn attached_vertices_stay_where_they_first_touch_the_obstacle() {
    // The table rises to the sheet, 10 mm above it, which falls; the whole sheet is attached, so what the table meets
    // keeps its place on it.
    let scene = held_by("attach", "box_m = [[-1, 0, -1], [1, 1, 1]]", "");
    assert!(scene.pins.len() == scene.mesh.positions.len() && scene.pins.iter().all(|pin| pin.on_touch));
    let steps = 30;
    let model = GlobalModel::new(&scene);
    let states = |ranks: usize| {
        let parts = on_ranks(&model, ranks, ExchangeMode::Halo, cpu, move |simulation, transport| {
            (1..=steps)
                .map(|step| {
                    simulation.step(transport, step, false).unwrap();
                    simulation.state()
                })
                .collect::<Vec<_>>()
        });
        (0..steps as usize)
            .map(|step| whole_state(&model, parts.iter().map(|of_rank| &of_rank[step])))
            .collect::<Vec<_>>()
    };
    let one = states(1);
    let (first, last) = (one.iter().position(|state| !state.holds.is_empty()).expect("something touches"), &one[29]);
    assert!(last.holds.len() > 20 && last.holds.len() < scene.mesh.positions.len(), "{}", last.holds.len());
    let taken = &one[first].holds;
    assert!(taken.iter().all(|hold| last.holds.contains(hold)), "holds stay as they were taken");
    let time_s = |step: usize| (step + 1) as f64 * STEP_S;
    for hold in taken {
        let [before, now] = [&one[first], last].map(|state| state.positions[hold.vertex as usize]);
        let off = now.as_dvec3().distance(carried(before, time_s(first), time_s(29)));
        assert!(off < 2e-6, "vertex {} is {off:e} m off", hold.vertex);
        let foot = carried(now, time_s(29), 0.0);
        assert!(foot.y < 0.3 + scene.settings.thickness_m + 1e-4, "{foot}");
    }
    for ranks in [2, 3, 5] {
        assert_eq!(states(ranks)[29].hash(), last.hash(), "{ranks} ranks");
    }
}
