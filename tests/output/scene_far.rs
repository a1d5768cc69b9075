//! Scenes far from the world's origin: computed about a local origin, with the bits of the same scene at the origin.

use std::fmt::Write as _;
use std::path::Path;

use loomtree::math::{DVec3, Vec3};
use loomtree::scene::{Obstacles, Overrides, Scene, load};

/// A multiple of the grid of local origins on every axis.
const OFFSET: [f64; 3] = [10_000.0, 0.0, -24_000.0];

/// A plate of two triangles, moved by `offset` in x and z, as text of an OBJ file in units of `unit_m` meters.
fn plate(offset: [f64; 3], unit_m: f64, y: f64) -> String {
    let mut text = String::new();
    for [x, z] in [[0.125, 0.25], [1.125, 0.25], [1.125, 1.25], [0.125, 1.25]] {
        let p = DVec3::new(x, y, z) + DVec3::from_array(offset);
        writeln!(text, "v {:?} {:?} {:?}", p.x / unit_m, p.y / unit_m, p.z / unit_m).unwrap();
    }
    text + "f 1 2 3\nf 1 3 4\n"
}

/// A scene with every kind of place in it, moved by `offset`.
fn scene(offset: [f64; 3]) -> Scene {
    let folder = tempfile::tempdir().unwrap();
    let at = |x: f64, y: f64, z: f64| format!("{:?}", (DVec3::new(x, y, z) + DVec3::from_array(offset)).to_array());
    let files = [
        ("cloth.obj", plate(offset, 1.0, 0.75)),
        ("mm.obj", plate(offset, 0.0009765625, -0.5)),
        ("part_1.obj", plate(offset, 1.0, -1.0)),
        ("part_2.obj", plate(offset, 1.0, -1.5)),
    ];
    let text = format!(
        r#"
        [[cloth]]
        name = "sheet"
        sheet = {{ size_m = [1, 1], triangles = 50 }}
        plane = "xz"
        origin_m = {corner}
        rotate_deg = [30, 0, 1, 0]
        [[cloth]]
        name = "file"
        mesh = "cloth.obj"
        [[pin]]
        cloth = "sheet"
        box_m = [{low}, {high}]
        motion = [{{ time_s = 0, pivot_m = {middle} }}, {{ time_s = 1, pivot_m = {middle}, rotate_deg = [90, 0, 1, 0] }}]
        [[pin]]
        cloth = "file"
        sphere = {{ center_m = {sphere}, radius_m = 0.5 }}
        motion = [{{ time_s = 0 }}, {{ time_s = 1, translate_m = [0.1, 0.2, 0.3] }}]
        [[obstacle]]
        sphere = {{ center_m = {ball}, radius_m = 0.2, triangles = 100 }}
        motion = [{{ time_s = 0.1 }}, {{ time_s = 1, translate_m = [0.1, 0.7, 0.3] }}]
        [[obstacle]]
        mesh = "mm.obj"
        scale = 0.0009765625
        [[obstacle]]
        sequence = "part_%d.obj"
        frames_per_s = 2
        "#,
        corner = at(-0.5, 0.35, 0.5),
        low = at(-0.6, 0.0, -1.0),
        high = at(0.0, 1.0, 1.0),
        middle = at(0.25, 0.0, 0.5),
        sphere = at(0.125, 0.75, 0.25),
        ball = at(0.5, -0.25, 0.0),
    );
    for (name, content) in files.iter().map(|(name, content)| (*name, content)).chain([("s.toml", &text)]) {
        std::fs::write(folder.path().join(name), content).unwrap();
    }
    load(&folder.path().join("s.toml"), &Overrides::default()).unwrap()
}

/// Positions of the obstacles at a time, xyz.
fn obstacles(scene: &Scene, time_s: f64) -> Vec<f32> {
    let mut positions = Vec::new();
    Obstacles::new(&scene.obstacles).positions_at(time_s, &mut positions);
    positions
}

#[test]
fn a_scene_moved_far_away_has_the_bits_of_the_one_at_the_origin() {
    let (near, far) = (scene([0.0; 3]), scene(OFFSET));
    assert_eq!((near.origin_m, far.origin_m), (DVec3::ZERO, DVec3::from_array(OFFSET)));
    assert_eq!(far.mesh, near.mesh);
    assert!(!near.pins.is_empty());
    assert_eq!(far.pins, near.pins);
    for time_s in [0.0, 0.3, 0.77, 2.0] {
        assert_eq!(obstacles(&far, time_s), obstacles(&near, time_s), "at {time_s} s");
        for (a, b) in far.motions.iter().zip(&near.motions) {
            let p = Vec3::new(0.3, 0.4, 0.5);
            assert_eq!(a.apply(time_s, p), b.apply(time_s, p), "at {time_s} s");
        }
    }
}

#[test]
fn the_local_origin_is_zero_near_the_origin_and_the_same_at_every_resolution() {
    let sheet = |corner: &str| format!("[[cloth]]\nsheet = {{ size_m = [2, 2] }}\norigin_m = {corner}");
    let read = |text: &str| loomtree::scene::read_str(text, Path::new("x.toml")).unwrap();
    for (corner, origin) in [
        ("[-100, 98, 0]", DVec3::ZERO),
        ("[99, 0, 0]", DVec3::new(104.0, 0.0, 0.0)),
        ("[1000, 98, -1e6]", DVec3::new(1000.0, 0.0, -1e6)),
    ] {
        let scene = read(&sheet(corner));
        for resolution in [Some(8), Some(5_000)] {
            assert_eq!(scene.at(&Overrides { resolution, frames: None }).unwrap().origin_m, origin, "{corner}");
        }
    }
}

#[test]
fn an_obstacle_that_comes_from_the_origin_keeps_its_digits() {
    let scene = |place: &str, way: &str| {
        let text = format!(
            "[[cloth]]\nsheet = {{ size_m = [1, 1] }}\norigin_m = [99999.5, 0, 0]\n[[obstacle]]\n\
             sphere = {{ center_m = {place}, radius_m = 0.25, triangles = 100 }}\n\
             motion = [{{ time_s = 0 }}, {{ time_s = 1, translate_m = {way} }}]"
        );
        loomtree::scene::parse(&text, Path::new("x.toml"), &Overrides::default()).unwrap()
    };
    let (moved, placed) = (scene("[0, 0.5, -1]", "[100000, 0, 0]"), scene("[100000, 0.5, -1]", "[0, 0, 0]"));
    assert_eq!(obstacles(&moved, 1.0), obstacles(&placed, 1.0));
    assert_eq!(obstacles(&moved, 0.0)[0], obstacles(&placed, 0.0)[0] - 1e5);
}
