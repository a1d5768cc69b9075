//! Contact with bodies that turn: what a surface does under its own friction is told by its speed where it touches.

use loomtree::math::{DQuat, DVec3, Vec3};
use loomtree::mesh::{TriangleMesh, shapes};
use loomtree::scene::{Keyframe, Motion, Movement, Obstacle, Scene};
use support::contact::{contact_scene, obstacle};
use support::physics::OneRank;

const THICKNESS_M: f32 = 1.5e-3;
const RADIUS_M: f32 = 0.05;
/// Half the distance of the rollers' axes.
const HALF_M: f32 = 0.2;
const WIDTH_M: f32 = 0.1;
const RAD_S: f64 = 2.0;
const STEPS: u32 = 150;

/// A roller about the y axis that turns from time 0 on, so that its top goes to the right.
fn roller(x: f32) -> Obstacle {
    let length_m = 1.5 * f64::from(WIDTH_M);
    let profile: Vec<[f64; 2]> =
        (0..=3).map(|i| [f64::from(RADIUS_M), length_m * (f64::from(i) / 3.0 - 0.5)]).collect();
    let mut surface = shapes::revolution(&profile, 96);
    surface.positions.iter_mut().for_each(|p| *p += Vec3::X * x);
    let pivot_m = DVec3::X * f64::from(x);
    let key = |i: u32| {
        let time_s = f64::from(i) * 0.1;
        Keyframe { pivot_m, rotation: DQuat::from_rotation_y(RAD_S * time_s), ..Keyframe::identity(time_s) }
    };
    let movement = Movement::Keyframes(Motion { keyframes: (0..=7).map(key).collect() });
    Obstacle { movement, ..obstacle("roller", surface, 0.6) }
}

/// Distance from the middle line of the loop to the rollers' axes, and the length of the loop, meters.
fn loop_size() -> (f32, f32) {
    let out = RADIUS_M + 0.97 * THICKNESS_M;
    (out, 4.0 * HALF_M + std::f32::consts::TAU * out)
}

/// A point of the loop, `s` from the left end of its upper half, and how far round it a point is: inverse to each
/// other.
fn point(s: f32) -> [f32; 2] {
    let ((out, _), turn) = (loop_size(), std::f32::consts::PI);
    let (flat, round) = (2.0 * HALF_M, turn * out);
    if s < flat {
        [s - HALF_M, out]
    } else if s < flat + round {
        let (sin, cos) = ((s - flat) / out).sin_cos();
        [HALF_M + out * sin, out * cos]
    } else {
        let [x, z] = point(s - flat - round);
        [-x, -z]
    }
}

fn place([x, z]: [f32; 2]) -> f32 {
    let (out, length) = loop_size();
    if x > HALF_M {
        2.0 * HALF_M + (x - HALF_M).atan2(z) * out
    } else if x >= -HALF_M && z > 0.0 {
        x + HALF_M
    } else {
        place([-x, -z]) + 0.5 * length
    }
}

fn belt() -> Scene {
    let (around, across) = (96, 8);
    let (_, length) = loop_size();
    let mut mesh = TriangleMesh::default();
    let uv = |i: u32, j: u32| {
        loomtree::math::Vec2::new(length * i as f32 / around as f32, WIDTH_M * j as f32 / across as f32)
    };
    for j in 0..=across {
        for i in 0..around {
            let [x, z] = point(uv(i, j).x);
            mesh.positions.push(Vec3::new(x, uv(i, j).y - 0.5 * WIDTH_M, z));
        }
    }
    for j in 0..across {
        for i in 0..around {
            let at = |i: u32, j: u32| j * around + i % around;
            let (a, b, c, d) = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1));
            for corners in [[a, b, c], [a, c, d]] {
                mesh.triangles.push(corners.map(|(i, j)| at(i, j)));
                mesh.material_uv.push(corners.map(|(i, j)| uv(i, j)));
            }
        }
    }
    let mut scene = contact_scene(mesh, f64::from(THICKNESS_M), 0.0, Vec3::ZERO);
    scene.obstacles = vec![roller(-HALF_M), roller(HALF_M)];
    scene
}

/// Without gravity the belt keeps the length it has been laid with, and friction takes it along at the speed of the
/// rollers' surface.
#[test]
fn a_loop_goes_round_with_its_rollers() {
    assert!([0.05, 0.43, 0.6, 0.9].iter().all(|&s| (place(point(s)) - s).abs() < 1e-6));
    let mut cloth = OneRank::new(&belt());
    let (_, length) = loop_size();
    let places = |cloth: &OneRank| cloth.positions().iter().map(|x| place([x.x, x.z])).collect::<Vec<f32>>();
    let mut last = places(&cloth);
    let mut ways = vec![0.0f32; last.len()];
    let mut half_way = 0.0;
    let mean = |ways: &[f32]| ways.iter().map(|&way| f64::from(way)).sum::<f64>() / ways.len() as f64;
    for step in 1..=STEPS {
        cloth.step();
        let now = places(&cloth);
        for ((way, now), last) in ways.iter_mut().zip(&now).zip(&last) {
            let change = (now - last).rem_euclid(length);
            *way += if change > 0.5 * length { change - length } else { change };
        }
        last = now;
        if step == STEPS / 2 {
            half_way = mean(&ways);
        }
    }
    let surface_m = RAD_S * f64::from(RADIUS_M) * 0.004 * f64::from(STEPS / 2);
    let second_half = mean(&ways) - half_way;
    println!("{half_way:.4} m and {second_half:.4} m in each half, the rollers' surface {surface_m:.4} m");
    // It is half a thickness or less farther out than the surface, and starts from rest.
    assert!((0.99..1.04).contains(&(second_half / surface_m)), "{second_half} of {surface_m} m");
    assert!(half_way > 0.9 * surface_m && half_way < 1.02 * surface_m, "{half_way} of {surface_m} m");
    let spread = ways.iter().fold(0.0f64, |most, &way| most.max((f64::from(way) - mean(&ways)).abs()));
    assert!(spread < 2e-3, "parts of the loop are {spread} m apart from the mean");
}
