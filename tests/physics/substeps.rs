//! Sub-steps: none where steps are short or nothing moves, as many as the motion asks for elsewhere, the same for any
//! number of ranks.

use std::path::Path;

use loomtree::math::Vec3;
use loomtree::mesh::unique_edges;
use loomtree::scene::{Overrides, Scene, Substeps, parse};
use loomtree::solver::ExchangeMode;
use support::physics::OneRank;
use support::{cpu, simulate};

const FILM_FRAME_S: f64 = 1.0 / 24.0;

/// A ball that walks at 1 m/s into a hanging cloth, after 0.2 s of rest, in steps of `step_s`.
fn walking(step_s: f64, substeps: Substeps) -> Scene {
    let text = format!(
        r#"
        [simulation]
        step_s = {step_s}
        [[cloth]]
        sheet = {{ size_m = [1, 1], triangles = 1000 }}
        [[pin]]
        edge = "top"
        [[obstacle]]
        sphere = {{ center_m = [0.5, 0.4, -0.35], radius_m = 0.2, triangles = 300 }}
        motion = [{{ time_s = 0.2 }}, {{ time_s = 1.4, translate_m = [0, 0, 1.2] }}]
        "#
    );
    let mut scene = parse(&text, Path::new("walking.toml"), &Overrides::default()).unwrap();
    scene.settings.substeps = substeps;
    scene
}

/// The longest edge of the mesh at a state, in lengths of its start.
fn stretch(scene: &Scene, positions: &[Vec3]) -> f64 {
    let length = |x: &[Vec3], [a, b]: [u32; 2]| f64::from(x[a as usize].distance(x[b as usize]));
    let ratio = |&edge: &[u32; 2]| length(positions, edge) / length(&scene.mesh.positions, edge);
    unique_edges(&scene.mesh).iter().map(ratio).fold(0.0, f64::max)
}

/// The longest edge over `seconds`, looked at after every film frame, and the sub-steps of all steps.
fn walk(scene: &Scene, seconds: f64) -> (f64, Vec<u32>) {
    let mut one = OneRank::new(scene);
    let frame = (FILM_FRAME_S / scene.settings.step_s).round() as u32;
    let (mut longest, mut substeps) = (0.0f64, Vec::new());
    for step in 1..=(seconds / scene.settings.step_s).round() as u32 {
        substeps.push(one.step().substeps);
        if step % frame == 0 {
            longest = longest.max(stretch(scene, &one.positions()));
        }
    }
    (longest, substeps)
}

#[test]
fn a_step_of_a_film_frame_stretches_no_edge_more_than_short_steps_do() {
    let (short, parts) = walk(&walking(FILM_FRAME_S / 10.0, Substeps::Auto), 1.0);
    assert!(parts.iter().all(|&parts| parts == 1), "a step of 1/240 s has no sub-steps");
    let (film, counts) = walk(&walking(FILM_FRAME_S, Substeps::Auto), 1.0);
    assert!(film < 1.05 * short, "{film} against {short}");
    assert_eq!(counts[1..4], [1; 3], "nothing moves yet");
    assert_eq!(counts.iter().max(), Some(&8), "the ball walks 42 mm in a frame, a quarter of a cell is 8 mm");
    let (whole, parts) = walk(&walking(FILM_FRAME_S, Substeps::Fixed(1)), 1.0);
    println!(
        "longest edge: {short:.3} in steps of 1/240 s, {film:.3} in film frames of {counts:?} sub-steps, \
         {whole:.3} without"
    );
    assert!(parts.iter().all(|&parts| parts == 1));
    assert!(whole > 1.2 * short, "without sub-steps the longest edge is {whole}: nothing to show");
}

#[test]
fn a_number_of_sub_steps_has_the_bits_of_as_many_steps() {
    let steps =
        |step_s, substeps, count| simulate(&walking(step_s, substeps), 1, ExchangeMode::Halo, count, cpu).positions;
    // Powers of two, so that the times of both are the same numbers.
    assert_eq!(steps(1.0 / 32.0, Substeps::Fixed(4), 9), steps(1.0 / 128.0, Substeps::Fixed(1), 36));
}

#[test]
fn sub_steps_are_the_same_for_any_number_of_ranks() {
    let scene = walking(FILM_FRAME_S, Substeps::Auto);
    let one = simulate(&scene, 1, ExchangeMode::Halo, 12, cpu);
    let parts: Vec<u32> = one.stats.iter().map(|stats| stats.substeps).collect();
    assert!(parts.iter().any(|&parts| parts > 1), "{parts:?}");
    for ranks in [2, 5] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 12, cpu);
        assert_eq!(many.stats.iter().map(|stats| stats.substeps).collect::<Vec<_>>(), parts);
        assert!(many.positions == one.positions, "{ranks} ranks: other bits");
    }
}

#[test]
fn what_moves_as_a_whole_needs_none() {
    let mut scene = walking(FILM_FRAME_S, Substeps::Auto);
    scene.pins.clear();
    scene.obstacles.clear();
    scene.settings.collisions = false;
    scene.velocities.fill(Vec3::new(20.0, 0.0, 3.0));
    let flying = simulate(&scene, 2, ExchangeMode::Halo, 5, cpu);
    assert!(flying.stats.iter().all(|stats| stats.substeps == 1), "{:?}", flying.stats);
}
