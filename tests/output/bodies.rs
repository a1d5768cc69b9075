//! Bodies as obstacles: glTF files against positions that were computed in double precision by others' rules, the
//! fields that say when a clip is played, and the sentence for every file that cannot be read.

use std::path::{Path, PathBuf};

use crate::one_obstacle::{positions, read};
use loomtree::cli::check::{CheckArgs, check};
use loomtree::math::Vec3;
use loomtree::scene::{Obstacles, read_body};
use support::numpy::{Array, read_npz, test_data};

/// Largest distance of a vertex from its truth.
fn off(got: &[f32], truth: &[f64]) -> f64 {
    assert_eq!(got.len(), truth.len());
    let pairs = got.as_chunks::<3>().0.iter().zip(truth.as_chunks::<3>().0);
    let apart = |(a, b): (&[f32; 3], &[f64; 3])| (0..3).map(|i| (f64::from(a[i]) - b[i]).powi(2)).sum::<f64>().sqrt();
    pairs.map(apart).fold(0.0, f64::max)
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap().to_string_lossy().into_owned()
}

/// Every clip of a file against its truth at all of its times.
fn assert_truth(file: &Path, truth: &Path, tolerance: f64) {
    let (folder, name) = (file.parent().unwrap(), name_of(file));
    let arrays = read_npz(truth);
    let clips = arrays.keys().filter_map(|key| key.strip_suffix("_times"));
    let mut clips: Vec<String> = clips.map(str::to_owned).collect();
    assert!(!clips.is_empty());
    clips.sort();
    for clip in clips {
        let clip_field = if clip == "static" { String::new() } else { format!("clip = \"{clip}\"") };
        let scene = read(folder, &format!("gltf = \"{name}\"\n{clip_field}")).unwrap();
        assert_eq!(scene.obstacles[0].triangles, arrays["triangles"].triples(), "{name}: its triangles, in its order");
        let truth: &Array = &arrays[&format!("{clip}_positions")];
        for (i, &time_s) in arrays[&format!("{clip}_times")].values.iter().enumerate() {
            let off = off(&positions(&scene, time_s), truth.entry(i));
            assert!(off <= tolerance, "{name}, {clip} at {time_s} s: {off:e} off, {tolerance:e} allowed");
        }
    }
}

fn manifest() -> Option<(PathBuf, serde_json::Value)> {
    let folder = test_data("garments/gltf_small")?;
    let text = std::fs::read_to_string(folder.join("manifest.json")).unwrap();
    Some((folder, serde_json::from_str(&text).unwrap()))
}

#[test]
fn the_walking_spinning_kneeling_kicking_body_is_where_it_should_be() {
    let Some(folder) = test_data("garments/human") else { return };
    assert_truth(&folder.join("human.glb"), &folder.join("human_truth.npz"), 1e-6);
}

#[test]
fn small_files_have_the_positions_of_the_specification() {
    let Some((folder, manifest)) = manifest() else { return };
    let mut read = 0;
    for case in manifest["cases"].as_array().unwrap().iter().filter(|case| case["expect"] == "read") {
        let text = |key: &str| case[key].as_str().unwrap();
        let file = folder.join(text("file"));
        assert_truth(&file, &folder.join(text("truth")), case["tolerance"].as_f64().unwrap());
        let body = read_body(&file).unwrap();
        assert_eq!(
            body.counts().map(|count| count as u64),
            ["vertices", "triangles"].map(|key| case[key].as_u64().unwrap())
        );
        let clips: Vec<&str> = body.clips.iter().map(|clip| &clip.name[..]).collect();
        let expected: Vec<&str> = case["clips"].as_array().unwrap().iter().map(|clip| clip.as_str().unwrap()).collect();
        assert_eq!(clips, expected, "{}", file.display());
        read += 1;
    }
    assert!(read >= 18);
}

#[test]
fn files_that_cannot_be_read_say_why() {
    let Some((folder, manifest)) = manifest() else { return };
    let mut refused = 0;
    for case in manifest["cases"].as_array().unwrap().iter().filter(|case| case["expect"] == "refuse") {
        let file = folder.join(case["file"].as_str().unwrap());
        let error = read(file.parent().unwrap(), &format!("gltf = \"{}\"", name_of(&file))).unwrap_err();
        assert_eq!(error.lines().count(), 1, "{error}");
        let words: &[&str] = match &name_of(&file)[..] {
            "nan_position.glb" | "inf_position.glb" => &["5 (from 0)", "accessor", "not a finite number"],
            "accessor_past_end.gltf" => &["accessor 0", "bufferView"],
            "no_such_view.gltf" => &["bufferView 77"],
            "index_out_of_range.gltf" => &["triangle 3 (from 0)", "vertex 8"],
            "points_only.gltf" => &["no triangles"],
            "version_1.gltf" => &["version 1.0"],
            "truncated.glb" => &["cut off"],
            _ => &[case["sentence_should_name"].as_str().unwrap()],
        };
        for word in [&name_of(&file)[..]].iter().chain(words) {
            assert!(error.contains(word), "no '{word}' in: {error}");
        }
        refused += 1;
    }
    assert!(refused >= 12);
}

/// A strip of two triangles that goes 2 m along x within 2 s, and is mirrored by its node; a second node does not move.
const MOVING: &str = r#"{
    "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1]}],
    "nodes": [{"name": "carrier", "mesh": 0, "scale": [-1, 1, 1]},
        {"name": "other", "mesh": 0, "translation": [0, 5, 0]}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]}],
    "animations": [{"name": "go", "samplers": [{"input": 1, "output": 2}],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]}],
    "accessors": [
        {"bufferView": 0, "count": 4, "componentType": 5126, "type": "VEC3"},
        {"bufferView": 0, "byteOffset": 48, "count": 2, "componentType": 5126, "type": "SCALAR"},
        {"bufferView": 0, "byteOffset": 56, "count": 2, "componentType": 5126, "type": "VEC3"}],
    "bufferViews": [{"buffer": 0, "byteLength": 80}], "buffers": [{"byteLength": 80, "uri": "b.bin"}]}"#;

fn moving_body() -> tempfile::TempDir {
    let numbers: [f32; 20] = [
        0., 0., 0., 1., 0., 0., 0., 1., 0., 1., 1., 0., // points
        0., 2., // times
        0., 0., 0., 2., 0., 0., // translations
    ];
    let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("b.bin"), bytes).unwrap();
    std::fs::write(folder.path().join("b.gltf"), MOVING).unwrap();
    folder
}

#[test]
fn every_field_of_a_body_does_what_it_says() {
    let folder = moving_body();
    let at = |fields: &str, vertex: usize, time_s: f64| {
        let scene = read(folder.path(), &format!("gltf = \"b.gltf\"\n{fields}")).unwrap();
        Vec3::from_slice(&positions(&scene, time_s)[3 * vertex..])
    };
    let near = |fields: &str, vertex: usize, time_s: f64, expected: [f32; 3]| {
        let found = at(fields, vertex, time_s);
        assert!(found.distance(Vec3::from(expected)) < 1e-6, "{fields} at {time_s} s: {found}");
    };
    let go = "clip = \"go\"\n";
    // Vertex 1 starts at x = -1, because its node mirrors it.
    near(go, 1, 0.5, [-0.5, 0., 0.]);
    near(go, 1, 9.0, [1., 0., 0.]);
    near(go, 5, 0.5, [1., 5., 0.]);
    near(&format!("{go}node = \"other\""), 1, 0.5, [1., 5., 0.]);
    near(&format!("{go}start_s = 1"), 1, 1.25, [-0.75, 0., 0.]);
    near(&format!("{go}rate = 2"), 1, 0.5, [0., 0., 0.]);
    near(&format!("{go}loop = true"), 1, 2.5, [-0.5, 0., 0.]);
    // Clip and rest pose are one at its start, so only the delay shows.
    near(&format!("{go}lead_in_s = 1"), 1, 1.5, [-0.5, 0., 0.]);
    near(&format!("{go}units_m = 0.01\nscale = 10"), 1, 2.0, [0.1, 0., 0.]);
    near(&format!("{go}up = \"z\""), 2, 0.0, [0., 0., -1.]);
    near(&format!("{go}up = \"x\""), 1, 2.0, [0., 1., 0.]);
    near(&format!("{go}origin_m = [0, 3, 0]\nrotate_deg = [90, 0, 0, 1]"), 1, 2.0, [0., 4., 0.]);
    // Without a clip it is a mesh like others, which keyframes may move.
    near("motion = [{ time_s = 0 }, { time_s = 1, translate_m = [0, 0, 4] }]", 1, 0.5, [-1., 0., 2.]);
    let still = read(folder.path(), "gltf = \"b.gltf\"").unwrap();
    assert!(!Obstacles::new(&still.obstacles).moving());
    assert!(still.left_out[0].contains("plays none of its clips (go)"), "{:?}", still.left_out);
    // The second triangle of a strip is wound the other way, and all of the mirrored node once more.
    assert_eq!(still.obstacles[0].triangles, [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6]]);
    assert!(Obstacles::new(&read(folder.path(), &format!("gltf = \"b.gltf\"\n{go}")).unwrap().obstacles).moving());
}

#[test]
fn a_clip_that_does_not_end_as_it_begins_is_named_when_it_starts_over() {
    let folder = moving_body();
    let looped = read(folder.path(), "gltf = \"b.gltf\"\nclip = \"go\"\nname = \"wall\"\nloop = true").unwrap();
    assert!(looped.warnings[0].contains("`wall` jumps by up to 2.00 m"), "{:?}", looped.warnings);
    assert!(read(folder.path(), "gltf = \"b.gltf\"\nclip = \"go\"").unwrap().warnings.is_empty());
}

#[test]
fn wrong_fields_of_a_body_are_named() {
    let folder = moving_body();
    for (fields, words) in [
        ("gltf = \"none.glb\"", ["obstacle.gltf", "none.glb"]),
        ("gltf = \"b.gltf\"\nclip = \"run\"", ["obstacle.clip", "no clip is named `run`; the file has go"]),
        ("gltf = \"b.gltf\"\nnode = \"x\"", ["obstacle.node", "those that do are carrier, other"]),
        ("gltf = \"b.gltf\"\nrate = 2", ["obstacle.rate", "`clip`"]),
        ("gltf = \"b.gltf\"\nclip = \"go\"\nrate = 0", ["obstacle.rate", "above 0"]),
        ("gltf = \"b.gltf\"\nclip = \"go\"\nup = \"w\"", ["obstacle.up", "y, z, x"]),
        ("gltf = \"b.gltf\"\nclip = \"go\"\nmotion = []", ["obstacle.motion", "`clip`"]),
        ("gltf = \"b.gltf\"\nmesh = \"a.obj\"", ["obstacle", "exactly one of"]),
        ("sphere = { center_m = [0, 0, 0], radius_m = 1 }\nclip = \"go\"", ["obstacle.clip", "`gltf`"]),
        ("sphere = { center_m = [0, 0, 0], radius_m = 1 }\nunits_m = 1", ["obstacle.units_m", "mesh, sequence, gltf"]),
    ] {
        let error = read(folder.path(), fields).unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)), "{fields}: {error}");
    }
}

#[test]
fn check_lists_the_clips_of_a_file() {
    let folder = moving_body();
    let args =
        |file: PathBuf| CheckArgs { file, resolution: None, write_crossings: None, untangle: None, obstacle: false };
    let mut out = Vec::new();
    check(&args(folder.path().join("b.gltf")), &mut out).unwrap();
    let text = String::from_utf8(out).unwrap();
    for words in
        ["b.gltf: valid", "vertices    8", "triangles   4", "clips       go (2 s)", "nodes       carrier, other"]
    {
        assert!(text.contains(words), "no '{words}' in: {text}");
    }
    let broken = folder.path().join("c.glb");
    std::fs::write(&broken, b"glTF\x02\0\0\0\xff\0\0\0").unwrap();
    assert!(check(&args(broken), &mut Vec::new()).unwrap_err().to_string().contains("cut off"));
}

#[test]
fn wrong_fields_of_a_pin_that_follows_are_named() {
    let folder = moving_body();
    let body = "name = \"body\"\ngltf = \"b.gltf\"\nclip = \"go\"\n[[pin]]\n";
    for (pin, words) in [
        ("follow = \"wall\"\nedge = \"top\"", ["pin.follow", "no obstacle is named `wall` (body)"]),
        ("follow = \"body\"\nedge = \"top\"\nmotion = []", ["pin.motion", "`follow`"]),
        ("follow = \"body\"\nattach = \"body\"\nedge = \"top\"", ["pin.attach", "either `follow` or `attach`"]),
        ("nearest = 4", ["pin.nearest", "`follow`"]),
        ("follow = \"body\"\nnearest = 0", ["pin.nearest", "1 to"]),
        ("follow = \"body\"", ["pin", "exactly one of"]),
    ] {
        let error = read(folder.path(), &format!("{body}{pin}")).unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)), "{pin}: {error}");
    }
    let scene = read(folder.path(), &format!("{body}follow = \"body\"\nnearest = 4")).unwrap();
    assert_eq!((scene.pins.len(), &scene.followed[..]), (4, &[0][..]));
}
