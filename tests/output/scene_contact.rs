//! The shipped contact scenes: they load at every size, start with air between all that could touch, and their obstacles
//! move no faster than things do.

use std::path::Path;

use loomtree::collision::elementary::{CandidateKind, closest_points};
use loomtree::math::Vec3;
use loomtree::scene::{Obstacles, Overrides, Scene, load};

/// Name of the file, name of the scene, cloths, obstacles, step of the paper's table where it has the scene.
const SCENES: [(&str, &str, usize, usize, f64); 7] = [
    ("sphere", "sphere", 3, 1, 1.0 / 200.0),
    ("sphere_1m", "sphere-1m", 1, 1, 1.0 / 200.0),
    ("funnel", "funnel", 3, 2, 1.0 / 2000.0),
    ("twisting", "twisting", 3, 2, 1.0 / 2000.0),
    ("drape", "drape", 1, 1, 1.0 / 250.0),
    ("stack", "stack", 10, 2, 1.0 / 250.0),
    ("pinch", "pinch", 1, 2, 1.0 / 250.0),
];

fn scene(file: &str, resolution: Option<u64>) -> Scene {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes").join(file).with_extension("toml");
    load(&path, &Overrides { resolution, frames: None }).unwrap()
}

fn points(obstacles: &Obstacles, time_s: f64) -> Vec<Vec3> {
    let mut values = Vec::new();
    obstacles.positions_at(time_s, &mut values);
    values.chunks_exact(3).map(Vec3::from_slice).collect()
}

#[test]
fn they_load_at_every_size() {
    for (file, name, cloths, obstacles, step_s) in SCENES {
        for wanted in [2_000, 30_000, 700_000] {
            let scene = scene(file, Some(wanted));
            assert_eq!((scene.name.as_str(), scene.cloths.len(), scene.obstacles.len()), (name, cloths, obstacles));
            assert_eq!((scene.settings.step_s, scene.settings.collisions), (step_s, true));
            // Every sheet has a multiple of 64 triangles.
            let off = (scene.mesh.triangles.len() as u64).abs_diff(wanted);
            assert!(off <= 32 * cloths as u64, "{file}: {} triangles for {wanted}", scene.mesh.triangles.len());
        }
    }
}

#[test]
fn frames_come_at_the_rate_of_a_film_for_a_few_seconds() {
    for (file, ..) in SCENES {
        let settings = scene(file, None).settings;
        let rate = 1.0 / (settings.step_s * f64::from(settings.steps_per_frame));
        let seconds = f64::from(settings.frames) / rate;
        assert!((24.9..=50.1).contains(&rate) && (1.9..=5.0).contains(&seconds), "{file}: {rate} fps, {seconds} s");
    }
}

/// Smallest distance of a vertex of one surface to a triangle of another.
fn gap(vertices: &[Vec3], corners: &[[Vec3; 3]]) -> f32 {
    let mut least = f32::INFINITY;
    for &p in vertices {
        for &[a, b, c] in corners {
            let low = a.min(b).min(c) - least;
            let high = a.max(b).max(c) + least;
            if p.cmpge(low).all() && p.cmple(high).all() {
                let closest = closest_points(CandidateKind::VertexFace, [p, a, b, c]);
                least = least.min(closest.distance_squared.sqrt());
            }
        }
    }
    least
}

#[test]
fn at_the_start_there_is_air_between_everything() {
    for (file, ..) in SCENES {
        let scene = scene(file, Some(2_000));
        let obstacles = Obstacles::new(&scene.obstacles);
        let obstacle_points = points(&obstacles, 0.0);
        let mut surfaces: Vec<(Vec<Vec3>, Vec<[Vec3; 3]>)> = Vec::new();
        for cloth in &scene.cloths {
            let of = |r: &std::ops::Range<u32>| r.start as usize..r.end as usize;
            let corners = |t: &[u32; 3]| t.map(|v| scene.mesh.positions[v as usize]);
            surfaces.push((
                scene.mesh.positions[of(&cloth.vertices)].to_vec(),
                scene.mesh.triangles[of(&cloth.triangles)].iter().map(corners).collect(),
            ));
        }
        let corners = obstacles.triangles().iter().map(|t| t.map(|v| obstacle_points[v as usize])).collect();
        surfaces.push((obstacle_points, corners));
        for i in 0..surfaces.len() {
            for j in 0..surfaces.len() {
                let gap = if i == j { f32::INFINITY } else { gap(&surfaces[i].0, &surfaces[j].1) };
                let thickness = scene.settings.thickness_m as f32;
                assert!(gap > 3.0 * thickness, "{file}: {gap} m between parts {i} and {j}, cloth of {thickness} m");
            }
        }
    }
}

#[test]
fn obstacles_move_at_most_two_metres_a_second() {
    for (file, ..) in SCENES {
        let scene = scene(file, Some(2_000));
        let obstacles = Obstacles::new(&scene.obstacles);
        let settings = &scene.settings;
        let steps = settings.frames * settings.steps_per_frame;
        let mut before = points(&obstacles, 0.0);
        let mut fastest = 0.0f64;
        for step in 1..=steps {
            let now = points(&obstacles, f64::from(step) * settings.step_s);
            let moved = now.iter().zip(&before).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
            fastest = fastest.max(f64::from(moved) / settings.step_s);
            before = now;
        }
        assert!(fastest < 2.0, "{file}: {fastest} m/s");
        assert_eq!(fastest > 0.1, obstacles.moving(), "{file}");
    }
}

#[test]
fn the_ball_turns_once_and_the_plates_stop_at_the_gap() {
    let twisting = Obstacles::new(&scene("twisting", Some(2_000)).obstacles);
    // One turn: every point is back where it was two seconds before.
    let (early, late) = (points(&twisting, 1.0), points(&twisting, 3.0));
    assert!(early.iter().zip(&late).all(|(a, b)| a.distance(*b) < 1e-5));
    assert!(early.iter().zip(&points(&twisting, 2.0)).any(|(a, b)| a.distance(*b) > 0.49));
    let pinch = Obstacles::new(&scene("pinch", Some(2_000)).obstacles);
    let z: Vec<f32> = points(&pinch, 3.0).iter().map(|p| p.z).collect();
    let front = z.iter().copied().filter(|z| *z > 0.0).fold(f32::INFINITY, f32::min);
    let back = z.iter().copied().filter(|z| *z < 0.0).fold(f32::NEG_INFINITY, f32::max);
    assert!((front - back - 0.02).abs() < 1e-5, "the gap is {}", front - back);
}
