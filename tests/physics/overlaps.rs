//! Cloth between obstacles that overlap: there, and only there, a vertex and an obstacle let go of each other, until
//! there is room again. Every step is looked at by the exact check of `mesh`.

use std::collections::BTreeSet;
use std::sync::Arc;

use loomtree::math::{DVec3, Vec3};
use loomtree::mesh::{Group, GroupKind, crossings};
use loomtree::model::GlobalModel;
use loomtree::scene::{Keyframe, Motion, Movement, Obstacle, Obstacles, Pin, Scene};
use loomtree::solver::ExchangeMode;
use loomtree::step::{Failure, Imposed};
use support::contact::{Watched, assert_free, ball, between_balls, contact_scene, obstacle, there_and_back, watch};
use support::physics::DOWN;
use support::{cpu, on_ranks, sheet};

/// Start, turn and end of what moves in and out again, seconds.
const TIMES_S: [f64; 3] = [0.0, 0.04, 0.08];

/// A sheet on a block, into which a ball moves, and out of it again.
fn on_a_block() -> Scene {
    let mesh = sheet(15, 15, [0.2; 2], Vec3::new(-0.1, -0.1, 1e-3), Vec3::X, Vec3::Y);
    let mut scene = contact_scene(mesh, 1.5e-3, 0.3, DOWN);
    let mut block = loomtree::mesh::shapes::cuboid([0.3, 0.3, 0.1], [3, 3, 1]);
    block.positions.iter_mut().for_each(|p| p.z -= 0.05);
    let body = ball(0.05, 6, Vec3::new(0.003, -0.002, 0.06), 0.3);
    scene.obstacles = vec![there_and_back(body, "ball", DVec3::Z * -0.016, TIMES_S), obstacle("block", block, 0.3)];
    scene
}

/// Fails if cloth crosses cloth, or a triangle that has let go of no obstacle crosses it, after any step.
fn assert_only_let_go(scene: &Scene, run: &Watched) {
    let obstacles = Obstacles::new(&scene.obstacles);
    let (cloth, first) = (scene.mesh.positions.len() as u32, scene.mesh.triangles.len());
    let mut triangles = scene.mesh.triangles.clone();
    triangles.extend(obstacles.triangles().iter().map(|t| t.map(|v| v + cloth)));
    let mut groups = vec![Group { triangles: 0..first, kind: GroupKind::Cloth }];
    groups.extend(
        obstacles
            .ranges()
            .into_iter()
            .map(|[_, range]| Group { triangles: range.start + first..range.end + first, kind: GroupKind::Obstacle }),
    );
    let mut at = Vec::new();
    for (step, (positions, let_go)) in run.positions.iter().zip(&run.let_go).enumerate() {
        obstacles.positions_at((step + 1) as f64 * scene.settings.step_s, &mut at);
        let mut all = positions.clone();
        all.extend(at.chunks_exact(3).map(Vec3::from_slice));
        let pairs: BTreeSet<(u32, u32)> = let_go.iter().map(|one| (one.vertex, one.obstacle)).collect();
        for [one, other] in crossings(&all, &triangles, &groups) {
            let [one, other] = [one, other].map(|t| t as usize);
            assert!(one < first && other >= first, "step {}: cloth crosses cloth", step + 1);
            let obstacle = groups[1..].iter().position(|group| group.triangles.contains(&other)).unwrap() as u32;
            let lets_go = triangles[one].iter().any(|&v| pairs.contains(&(v, obstacle)));
            assert!(lets_go, "step {}: triangle {one} crosses obstacle {obstacle}", step + 1);
        }
    }
}

/// Runs on one rank, two and four: the same bits, and the same is let go.
fn check(name: &str, scene: &Scene, steps: u32) -> Watched {
    let one = watch(scene, 1, steps, cpu);
    let counts = |run: &Watched| run.stats.iter().map(|s| (s.contacts, s.let_go)).collect::<Vec<_>>();
    println!("{name}: {}, let go {:?}", one.summary(), one.stats.iter().map(|s| s.let_go.pairs).collect::<Vec<_>>());
    assert_only_let_go(scene, &one);
    for ranks in [2, 4] {
        let more = watch(scene, ranks, steps, cpu);
        assert!(one.bits() == more.bits() && one.let_go == more.let_go, "{name}: {ranks} ranks give other bits");
        assert_eq!(counts(&one), counts(&more), "{name} on {ranks} ranks");
    }
    for (stats, let_go) in one.stats.iter().zip(&one.let_go) {
        assert_eq!(stats.let_go.pairs, let_go.len() as u64, "{name}: step {}", stats.step);
    }
    one
}

/// Checks that a sheet between two balls has let go of `obstacle` while they were in each other, and has not been
/// thrown anywhere.
fn assert_pinched_and_released(run: &Watched, obstacle: u32) {
    let most = run.let_go.iter().map(Vec::len).max().unwrap();
    // The balls share a circle of 17 mm around; cells are 12.5 mm.
    assert!((2..=25).contains(&most), "{most} vertices");
    assert!(run.let_go.iter().flatten().all(|one| (one.obstacle, one.inside) == (obstacle, 0)));
    assert!(run.let_go[..7].iter().all(Vec::is_empty), "before the balls meet");
    assert!(run.let_go.last().unwrap().is_empty(), "after they have parted: {:?}", run.let_go.last());
    let last = run.positions.last().unwrap();
    let farthest = last.iter().map(|x| x.y.abs()).fold(0.0, f32::max);
    assert!(farthest < 0.02, "{farthest} m from its plane");
}

#[test]
fn a_sheet_between_two_balls_is_pinched_and_released() {
    let scene = between_balls(0.006, TIMES_S);
    let run = check("balls", &scene, 30);
    // Both are equally fast: the later one.
    assert_pinched_and_released(&run, 1);
}

/// The two balls as one obstacle, as a thigh and a belly are parts of one body.
#[test]
fn a_sheet_between_two_parts_of_a_body_is_pinched_and_released() {
    let depth_m = 0.006;
    let mut scene = between_balls(depth_m, TIMES_S);
    let [left, right] = [0, 1].map(|i| scene.obstacles[i].clone());
    let first = left.positions.len() as u32;
    let triangles = left.triangles.iter().copied().chain(right.triangles.iter().map(|t| t.map(|v| v + first)));
    let at = |share: f32| -> Vec<Vec3> {
        let moved = |ball: &Obstacle, side: f32| {
            let by = Vec3::Y * (-side * share * (0.01 + 0.5 * depth_m as f32));
            ball.positions.iter().map(|p| *p + by).collect::<Vec<_>>()
        };
        [moved(&left, -1.0), moved(&right, 1.0)].concat()
    };
    scene.obstacles = vec![Obstacle {
        name: "body".into(),
        friction: 0.3,
        positions: at(0.0),
        triangles: triangles.collect(),
        movement: Movement::Sequence { frames_per_s: 1.0 / TIMES_S[1], later: Arc::new(vec![at(1.0), at(0.0)]) },
    }];
    let run = check("body", &scene, 30);
    assert_pinched_and_released(&run, 0);
}

/// Vertices of the sheet follow the left ball, a centimeter before it. The balls do not overlap, but the right one
/// comes to where the held vertices are.
#[test]
fn cloth_that_follows_a_body_lets_go_of_what_comes_upon_it() {
    let mut scene = between_balls(-3e-4, TIMES_S);
    scene.followed = vec![0];
    let middle = Vec3::new(0.004, 0.0, -0.03);
    let near = (0..17 * 17).filter(|&v: &u32| scene.mesh.positions[v as usize].distance(middle) < 0.02);
    let held: Vec<u32> = near.collect();
    assert!(held.len() > 4);
    scene.pins.extend(held.iter().map(|&vertex| Pin::new(vertex, Some(0), 0.0, f64::INFINITY)));
    let run = check("followers", &scene, 30);
    let let_go: BTreeSet<u32> = run.let_go.iter().flatten().map(|one| one.vertex).collect();
    assert!(held.iter().any(|vertex| let_go.contains(vertex)), "{let_go:?}");
    assert!(run.let_go.iter().flatten().all(|one| one.obstacle == 1), "not the ball that they follow");
    assert!(run.let_go.last().unwrap().is_empty(), "after they have parted: {:?}", run.let_go.last());
}

#[test]
fn the_obstacle_that_moves_in_lets_go() {
    let scene = on_a_block();
    let run = check("block", &scene, 30);
    assert!(run.let_go.iter().any(|pairs| pairs.len() > 1));
    assert!(run.let_go.iter().flatten().all(|one| one.obstacle == 0), "the ball, not the block");
    assert!(run.let_go.last().unwrap().is_empty());
    for (step, x) in run.positions.iter().enumerate() {
        let lowest = x.iter().map(|x| x.z).fold(f32::MAX, f32::min);
        assert!(lowest > 0.0, "step {}: {lowest} m above the block", step + 1);
    }
}

#[test]
fn nothing_is_let_go_where_obstacles_do_not_overlap() {
    // The balls come as near as 0.3 mm, and the cloth stays between them.
    let scene = between_balls(-3e-4, TIMES_S);
    let run = check("near", &scene, 24);
    assert!(run.stats.iter().map(|s| s.contacts).max().unwrap() > 0);
    assert!(run.stats.iter().all(|s| (s.let_go.pairs, s.let_go.new) == (0, 0)));
    assert_free(&scene, &run);
}

#[test]
fn a_pin_without_room_between_obstacles_that_do_not_overlap_ends_the_run() {
    let mut scene = between_balls(-3e-4, TIMES_S);
    // Carried into the right ball.
    let vertex = (0..17 * 17).min_by(|&v, &w| {
        let off = |v: u32| (scene.mesh.positions[v as usize] - Vec3::new(0.004, 0.0, -0.03)).length();
        off(v).total_cmp(&off(w))
    });
    let motion = Motion {
        keyframes: vec![
            Keyframe::identity(0.0),
            Keyframe { translation_m: DVec3::Y * 0.02, ..Keyframe::identity(0.04) },
        ],
    };
    scene.motions = vec![motion];
    scene.pins.push(Pin::new(vertex.unwrap(), Some(0), 0.0, f64::INFINITY));
    let model = GlobalModel::new(&scene);
    let ends = on_ranks(&model, 2, ExchangeMode::Halo, cpu, |simulation, transport| {
        (1..=10).find_map(|step| simulation.step(transport, step, false).err().map(|error| (error, simulation.state())))
    });
    for end in ends {
        let (Failure::Squeezed { imposed, .. }, state) = end.expect("a failure") else { panic!("another failure") };
        assert!(imposed.contains(&Imposed::Obstacle("right".into())), "{imposed:?}");
        assert!(imposed.iter().any(|one| matches!(one, Imposed::Pin(_))), "{imposed:?}");
        assert!(state.let_go.is_empty());
    }
}
