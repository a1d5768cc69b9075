//! Skinned bodies in runs of processes: the same bits for any number of workers and after a resume within the clip,
//! frames that hold the body as it was, with the vertices of its file, and garments worn by it.

use std::fs;

use loomtree::collision::body::Body;
use loomtree::math::Vec3;
use loomtree::output::Checkpoint;
use loomtree::scene::{Obstacles, Overrides, load};
use support::numpy::test_data;
use support::process::Place;

use crate::sewing::assert_free;

/// A plate of two triangles below the cloth whose half at x > 0 hangs on a joint that turns up, and back; its vertices
/// are split along the seam, as exporters do.
const BODY: &str = r#"{
    "asset": {"version": "2.0"}, "scenes": [{"nodes": [0, 1, 2]}],
    "nodes": [{"name": "plate", "mesh": 0, "skin": 0}, {"name": "root"}, {"name": "arm"}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}}]}],
    "skins": [{"joints": [1, 2]}],
    "animations": [{"name": "lift", "samplers": [{"input": 3, "output": 4}],
        "channels": [{"sampler": 0, "target": {"node": 2, "path": "rotation"}}]}],
    "accessors": [
        {"bufferView": 0, "count": 6, "componentType": 5126, "type": "VEC3"},
        {"bufferView": 0, "byteOffset": 72, "count": 6, "componentType": 5121, "type": "VEC4"},
        {"bufferView": 0, "byteOffset": 96, "count": 6, "componentType": 5126, "type": "VEC4"},
        {"bufferView": 0, "byteOffset": 192, "count": 3, "componentType": 5126, "type": "SCALAR"},
        {"bufferView": 0, "byteOffset": 204, "count": 3, "componentType": 5126, "type": "VEC4"}],
    "bufferViews": [{"buffer": 0, "byteLength": 252}], "buffers": [{"byteLength": 252, "uri": "plate%20bytes.bin"}]}"#;

const SCENE: &str = r#"
[simulation]
steps_per_frame = 5
frames = 6
[[cloth]]
sheet = { size_m = [1, 1], triangles = 400 }
plane = "xz"
origin_m = [-0.5, 0.02, 0.5]
[[obstacle]]
name = "plate"
gltf = "plate.gltf"
clip = "lift"
"#;

fn place() -> Place {
    let place = Place::new();
    let corners: [[f32; 3]; 6] =
        [[-1., 0., -1.], [-1., 0., 1.], [1., 0., 1.], [-1., 0., -1.], [1., 0., 1.], [1., 0., -1.]];
    let mut bytes: Vec<u8> = corners.as_flattened().iter().flat_map(|x| x.to_le_bytes()).collect();
    corners.iter().for_each(|p| bytes.extend([u8::from(p[0] > 0.0), 0, 0, 0]));
    let mut floats: Vec<f32> = corners.iter().flat_map(|_| [1.0, 0.0, 0.0, 0.0]).collect();
    let (sin, cos) = 0.1f32.sin_cos();
    floats.extend([0.0, 0.05, 0.1]);
    floats.extend([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0]);
    bytes.extend(floats.iter().flat_map(|x| x.to_le_bytes()));
    place.write("plate.gltf", BODY);
    place.write("plate bytes.bin", bytes);
    place.write("scene.toml", SCENE);
    place
}

#[test]
fn the_same_bits_for_any_number_of_workers_and_after_a_resume_within_the_clip() {
    let place = place();
    place.run("run scene.toml --executor cpu --workers 1 --out one").expect(0);
    for workers in [2, 3, 8] {
        place.run(&format!("run scene.toml --executor cpu --workers {workers} --out w{workers}")).expect(0);
        assert_eq!(place.hashes(&format!("w{workers}")), place.hashes("one"), "{workers} workers");
    }
    place.run("run scene.toml --executor cpu --workers 2 --frames 3 --out part").expect(0);
    place.run("run --resume --frames 6 --workers 3 --out part").expect(0);
    assert_eq!(place.hashes("part"), place.hashes("one"));
    let steps = place.report("one")["steps"].clone();
    assert!(
        steps.as_array().unwrap().iter().any(|step| step["contacts"].as_u64() > Some(0)),
        "the cloth meets the body"
    );
}

#[test]
fn frames_hold_the_body_as_it_was_in_the_order_of_its_file() {
    let place = place();
    place.run("run scene.toml --executor cpu --workers 2 --frames 3 --format obj --out out").expect(0);
    // Frame 3 is at 0.06 s, a fifth of the way back from 0.2 rad.
    let text = std::fs::read_to_string(place.path("out/frames/obstacle_000003.obj")).unwrap();
    let numbers = |line: &str| -> Vec<f64> { line.split(' ').filter_map(|word| word.parse().ok()).collect() };
    let vertices: Vec<Vec<f64>> = text.lines().filter(|line| line.starts_with("v ")).map(numbers).collect();
    let (sin, cos) = 0.16f64.sin_cos();
    let expected = [[-1., 0., -1.], [-1., 0., 1.], [cos, sin, 1.], [-1., 0., -1.], [cos, sin, 1.], [cos, sin, -1.]];
    assert_eq!(vertices.len(), 6, "split vertices stay split");
    for (got, expected) in vertices.iter().zip(&expected) {
        assert!((0..3).all(|i| (got[i] - expected[i]).abs() < 1e-6), "{got:?}, not {expected:?}");
    }
    let faces: Vec<Vec<f64>> = text.lines().filter(|line| line.starts_with("f ")).map(numbers).collect();
    assert_eq!(faces, [[1., 2., 3.], [4., 5., 6.]]);
}

#[test]
fn cloth_that_follows_the_body_stays_on_it_with_the_same_bits_for_any_number_of_workers() {
    let place = place();
    // The half of the cloth over the arm is held; its vertices hang on triangles that stretch and turn.
    let pin = "[[pin]]\nfollow = \"plate\"\nbox_m = [[0.2, 0, -1], [1, 1, 1]]\n";
    place.write("pinned.toml", format!("{SCENE}{pin}"));
    place.run("run pinned.toml --executor cpu --workers 1 --format obj --out one").expect(0);
    for workers in [2, 5] {
        place.run(&format!("run pinned.toml --executor cpu --workers {workers} --out w{workers}")).expect(0);
        assert_eq!(place.hashes(&format!("w{workers}")), place.hashes("one"), "{workers} workers");
    }
    place.run("run pinned.toml --executor cpu --workers 3 --frames 2 --out part").expect(0);
    place.run("run --resume --frames 6 --workers 2 --out part").expect(0);
    assert_eq!(place.hashes("part"), place.hashes("one"));
    let vertices = |frame: u32| -> Vec<[f64; 3]> {
        let text = std::fs::read_to_string(place.path(&format!("one/frames/frame_{frame:06}.obj"))).unwrap();
        let lines = text.lines().filter_map(|line| line.strip_prefix("v "));
        lines.map(|line| std::array::from_fn(|i| line.split(' ').nth(i).unwrap().parse().unwrap())).collect()
    };
    // At 0.06 s the edge at x = 1 has turned by 0.16 rad, so the plate goes straight from (-1, 0) to (cos, sin).
    let (sin, cos) = 0.16f64.sin_cos();
    let length = (1.0 + cos).hypot(sin);
    let (start, end) = (vertices(0), vertices(3));
    let held: Vec<usize> = (0..start.len()).filter(|&v| start[v][0] >= 0.2).collect();
    assert!(held.len() > 30);
    for v in held {
        let [x, y, z] = start[v];
        let along = (1.0 + x) / 2.0;
        let expected = [-1.0 + along * (1.0 + cos) - y * sin / length, along * sin + y * (1.0 + cos) / length, z];
        assert!((0..3).all(|i| (end[v][i] - expected[i]).abs() < 1e-6), "vertex {v}: {:?}, not {expected:?}", end[v]);
    }
}

/// A tunic and a skirt of other people on a body of other people that kicks, up to where the body begins to cross
/// itself (its `self_crossings.json`: 0.5 s).
#[test]
fn worn_garments_cross_neither_each_other_nor_the_body_and_the_waist_stays_on_it() {
    let Some(garments) = test_data("garments") else { return };
    let at = |file: &str| garments.join(file).display().to_string();
    let place = Place::new();
    let (tunic, skirt) = (at("worn/tunic_6k.obj"), at("worn/skirt_long_6k.obj"));
    let text = format!(
        "[simulation]\nstep_s = 0.004\nsteps_per_frame = 10\nframes = 11\n\
         [[cloth]]\nname = \"tunic\"\nmesh = \"{tunic}\"\n[[cloth]]\nname = \"skirt\"\nmesh = \"{skirt}\"\n\
         [[obstacle]]\nname = \"body\"\ngltf = \"{}\"\nclip = \"kick\"\n\
         [[pin]]\ncloth = \"skirt\"\nbox_m = [[-1, 1.03, -1], [1, 1.2, 1]]\nfollow = \"body\"\n",
        at("human/human.glb")
    );
    place.write("worn.toml", &text);
    place.run("run worn.toml --executor cpu --out out --keep-states 10").expect(0);
    let scene = load(&place.path("worn.toml"), &Overrides { resolution: None, frames: None }).unwrap();
    let obstacles = Obstacles::new(&scene.obstacles);
    let waist: Vec<usize> = scene.pins.iter().map(|pin| pin.vertex as usize).collect();
    assert!(waist.len() > 20, "{}", waist.len());
    // Distances of the waist from the body.
    let distances = |positions: &[Vec3], time_s: f64| -> Vec<f64> {
        let mut x = Vec::new();
        obstacles.positions_at(time_s, &mut x);
        let body = Body { x: &x, triangles: obstacles.triangles() };
        waist.iter().map(|&v| body.nearest(positions[v].as_dvec3()).unwrap().distance_m).collect()
    };
    let start = distances(&scene.mesh.positions, 0.0);
    let mut looked_at = 0;
    for entry in fs::read_dir(place.path("out/states")).unwrap() {
        let kept = Checkpoint::from_bytes(&fs::read(entry.unwrap().path()).unwrap()).unwrap();
        let (positions, time_s) = (&kept.state.positions, kept.time_s);
        assert_free(&scene, positions, time_s, &format!("the state at {time_s} s"));
        for (now, start) in distances(positions, time_s).iter().zip(&start) {
            assert!(
                (now - start).abs() < 1e-3,
                "the waist is {now} m from the body at {time_s} s, {start} m at the start"
            );
        }
        looked_at += 1;
    }
    assert!(looked_at >= 11, "{looked_at}");
}

#[test]
fn a_file_that_cannot_be_read_ends_with_code_2_and_leaves_nothing() {
    let place = place();
    std::fs::write(place.path("plate bytes.bin"), [0; 251]).unwrap();
    let ended = place.run("run scene.toml --executor cpu --out out").expect(2);
    let error = ended.error();
    assert!(error.contains("plate.gltf") && error.contains("251 bytes, 252 are declared"), "{error}");
    assert!(!place.path("out").exists() && ended.stdout.is_empty());
}
