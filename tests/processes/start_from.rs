//! `run --start-from`: a run whose cloth begins where that of another one was, with other physics or another
//! resolution.

use std::fs;

use loomtree::math::Vec3;
use loomtree::output::Checkpoint;
use support::process::Place;

const SCENE: &str = r#"
[simulation]
steps_per_frame = 5
frames = 6
[[cloth]]
sheet = { size_m = [1, 1], triangles = 256 }
plane = "xz"
fabric = "silk"
[[pin]]
corners = ["top-left", "top-right"]
"#;

/// A run with the states of all frames in `first`.
fn place() -> Place {
    let place = Place::new();
    place.write("hang.toml", SCENE);
    place.run("run hang.toml --executor cpu --workers 2 --keep-states frames --out first").expect(0);
    place
}

fn state(place: &Place, file: &str) -> Checkpoint {
    Checkpoint::from_bytes(&fs::read(place.path(file)).expect("a state")).expect("a state")
}

fn farthest(a: &[Vec3], b: &[Vec3]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
}

#[test]
fn a_run_begins_with_the_state_of_another_and_goes_on_alike_with_any_number_of_workers() {
    let place = place();
    let go_on = "run hang.toml --executor cpu --start-from first:3 --keep-states frames";
    place.run(&format!("{go_on} --frames 3 --workers 1 --out next")).expect(0).says(&["step_00000015.ltc"]);
    assert_eq!(place.hashes("next")[0].1, place.hashes("first")[3].1, "the state of frame 3");
    let [end, same] =
        ["next/states/step_00000015.ltc", "first/states/step_00000030.ltc"].map(|file| state(&place, file));
    let off = farthest(&end.state.positions, &same.state.positions);
    assert!(off < 2e-4, "after three frames more it is where the first run was after six, but for {off} m");
    place.run(&format!("{go_on} --frames 3 --workers 3 --out other")).expect(0);
    assert_eq!(place.hashes("other"), place.hashes("next"));
    // What was taken is kept: the first run may go away.
    place.run(&format!("{go_on} --frames 1 --workers 2 --out part")).expect(0);
    fs::remove_dir_all(place.path("first")).unwrap();
    place.run("run --resume --out part --frames 3 --workers 3").expect(0);
    assert_eq!(place.hashes("part"), place.hashes("next"));
}

#[test]
fn without_a_kept_state_velocities_are_differences_of_frames() {
    let place = place();
    let exact = state(&place, "first/states/step_00000010.ltc");
    fs::remove_dir_all(place.path("first/states")).unwrap();
    fs::remove_dir_all(place.path("first/checkpoint")).unwrap();
    let words = "run hang.toml --executor cpu --start-from first:2 --frames 0 --keep-states frames --out next";
    place.run(words).expect(0).says(&["differences of frames 1 and 2"]);
    let start = state(&place, "next/states/step_00000000.ltc");
    assert_eq!(start.state.positions, exact.state.positions);
    // Cloth that falls changes its speed by g times the half of a frame.
    let off = farthest(&start.state.velocities, &exact.state.velocities);
    assert!(off > 0.0 && off < 9.81 * 0.02, "{off} m/s");
}

#[test]
fn finer_sheets_other_physics_and_other_pins() {
    let place = Place::new();
    place.write("hang.toml", SCENE.replace("256", "1024"));
    // The coarse run of a split shot has the next level of its sheets.
    let coarse = "--segments 2 --coarse 2 --coarse-steps 1 --coarse-only";
    place.run(&format!("run hang.toml --executor cpu {coarse} --out shot")).expect(0);
    assert_eq!(place.report("shot/preview")["triangles"], 256);
    place
        .write("other.toml", SCENE.replace("256", "1024").replace("silk", "denim").replace("top-right", "bottom-left"));
    let words = "run other.toml --executor cpu --start-from shot/preview:4 --frames 2 --out fine";
    place.run(words).expect(0).says(&["4 times its triangles"]);
    assert_eq!(place.report("fine")["triangles"], 1024);
    let [start, coarse] = ["fine/start.ltc", "shot/preview/states/step_00000020.ltc"].map(|file| state(&place, file));
    let vertices = coarse.state.positions.len();
    assert_eq!(start.state.positions[..vertices], coarse.state.positions, "vertices of the coarse level come first");
}

#[test]
fn other_meshes_of_the_same_pieces_take_their_places_from_the_nearest_points() {
    let place = place();
    for (triangles, workers) in [(64, 1), (1600, 1), (1600, 2)] {
        let words = format!("run hang.toml --executor cpu --resolution {triangles} --workers {workers}");
        let out = format!("of_{triangles}_{workers}");
        place
            .run(&format!("{words} --start-from first:4 --frames 1 --out {out}"))
            .expect(0)
            .says(&["of 256 triangles"]);
    }
    assert_eq!(place.hashes("of_1600_1"), place.hashes("of_1600_2"));
    let [coarse, fine] =
        ["first/states/step_00000020.ltc", "of_1600_1/start.ltc"].map(|file| state(&place, file).state);
    // The sheet hangs as it did: the same mean height and speed, and the pinned corners where they were.
    let mean = |all: &[Vec3]| all.iter().map(|p| p.y).sum::<f32>() / all.len() as f32;
    assert!((mean(&coarse.positions) - mean(&fine.positions)).abs() < 0.004);
    assert!((mean(&coarse.velocities) - mean(&fine.velocities)).abs() < 0.05 * mean(&coarse.velocities).abs());
    let corner =
        |all: &[Vec3]| all.iter().copied().fold(Vec3::INFINITY, |a, b| if b.x + b.z < a.x + a.z { b } else { a });
    assert!(corner(&coarse.positions).distance(corner(&fine.positions)) < 1e-5);
}

#[test]
fn mistakes_are_named() {
    let place = place();
    place.write("small.toml", SCENE.replace("size_m = [1, 1]", "size_m = [1, 2]"));
    for (words, what) in [
        ("hang.toml --start-from nowhere", "nowhere"),
        ("hang.toml --start-from first:99", "has no frame 99, only 0 to 6"),
        ("small.toml --start-from first", "is another cloth or lies elsewhere"),
        ("hang.toml --start-from :3", "names no run"),
        ("hang.toml --start-from first --segments 2", "--start-from and --segments do not go together"),
    ] {
        place.run(&format!("run {words} --executor cpu --out refused")).expect(2).says(&[what]);
        assert!(!place.path("refused").exists(), "{words}");
    }
}
