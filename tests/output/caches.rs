//! Point caches and sequences as obstacles: files that other programs wrote against their truth, the fields that say
//! when they are played, and the sentence for every file that cannot be read.

use crate::one_obstacle::{positions, read};
use loomtree::math::Vec3;
use loomtree::scene::{Obstacles, Scene};
use support::numpy::{read_npz, test_data};

fn cache(form: &str, file: &str, more: &str) -> String {
    format!("{form} = {{ rest = \"wave_rest.obj\", cache = \"{file}\" }}\n{more}")
}

#[test]
fn caches_have_the_positions_of_their_samples_bit_by_bit() {
    let Some(folder) = test_data("garments/caches") else { return };
    let truth = read_npz(&folder.join("truth.npz"));
    for (obstacle, key) in [
        (cache("pc2", "wave.pc2", "frames_per_s = 24"), "wave"),
        (cache("pc2", "wave_start10_rate2.pc2", "frames_per_s = 24"), "wave_start10"),
        (cache("mdd", "wave.mdd", ""), "wave"),
    ] {
        let scene = read(&folder, &obstacle).unwrap();
        assert!(Obstacles::new(&scene.obstacles).moving());
        let samples = &truth[&format!("{key}_positions")];
        let times = &truth[&format!("{key}_times")].values;
        for (i, &time_s) in times.iter().enumerate() {
            // The time of a sample may be rounded in the file, so the bits are those a moment later on the way.
            let got = positions(&scene, time_s);
            let off = got.iter().zip(samples.entry(i)).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
            assert!(off < 1e-7, "{obstacle} at {time_s} s: {off:e} off");
        }
        // Before the first sample the cache waits, after the last it stays: there the numbers are those of the file.
        let ends = [(-1.0, 0), (0.0, 0), (99.0, times.len() - 1)];
        for (time_s, i) in ends {
            let expected: Vec<f32> = samples.entry(i).iter().map(|&x| x as f32).collect();
            assert_eq!(positions(&scene, time_s), expected, "{obstacle} at {time_s} s");
        }
    }
    // Half-way every vertex has gone half its way.
    let scene = read(&folder, &cache("pc2", "wave.pc2", "frames_per_s = 24")).unwrap();
    for (i, &time_s) in truth["wave_mid_times"].values.iter().enumerate() {
        let middle = truth["wave_mid_positions"].entry(i);
        let got = positions(&scene, time_s);
        assert!(got.iter().zip(middle).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6), "at {time_s} s");
    }
}

/// Largest difference of a coordinate.
fn off(got: &[f32], truth: &[f64]) -> f64 {
    assert_eq!(got.len(), truth.len());
    got.iter().zip(truth).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max)
}

/// Files of USD's and Alembic's own writers and of Blender's.
#[test]
fn stages_and_archives_have_the_positions_of_their_samples() {
    let Some(folder) = test_data("garments/caches") else { return };
    let truth = read_npz(&folder.join("truth.npz"));
    let manifest = std::fs::read_to_string(folder.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    let mut read_files = 0;
    for case in manifest["cases"].as_array().unwrap().iter().filter(|case| case["expect"] == "read") {
        let file = case["file"].as_str().unwrap();
        let form = match file.rsplit('.').next() {
            Some("usda" | "usdc") => "usd",
            Some("abc") => "abc",
            _ => continue,
        };
        let scene = read(&folder, &format!("{form} = \"{file}\"")).unwrap();
        assert!(Obstacles::new(&scene.obstacles).moving());
        let key = case["truth"].as_str().unwrap();
        let samples = &truth[&format!("{key}_positions")];
        for (i, &time_s) in truth[&format!("{key}_times")].values.iter().enumerate() {
            let got = positions(&scene, time_s);
            match case["tolerance_m"].as_f64() {
                Some(tolerance) => assert!(off(&got, samples.entry(i)) <= tolerance, "{file} at {time_s} s"),
                None => {
                    let expected: Vec<f32> = samples.entry(i).iter().map(|&x| x as f32).collect();
                    assert_eq!(got, expected, "{file} at {time_s} s: equal bits");
                }
            }
        }
        for (i, &time_s) in truth["wave_mid_times"].values.iter().enumerate() {
            assert!(
                off(&positions(&scene, time_s), truth["wave_mid_positions"].entry(i)) < 1e-6,
                "{file} at {time_s} s"
            );
        }
        // Two triangles of every quad, wound as the faces are.
        let faces = truth["face_counts"].values.iter().map(|&n| n as usize - 2).sum::<usize>();
        assert_eq!(scene.obstacles[0].triangles.len(), faces, "{file}");
        let first: [f64; 3] = truth["face_indices"].values[..3].try_into().unwrap();
        let mut corners = scene.obstacles[0].triangles[0];
        let lowest = (0..3).min_by_key(|&i| corners[i]).unwrap();
        corners.rotate_left(lowest);
        assert_eq!(corners, first.map(|v| v as u32), "{file}: counter-clockwise");
        read_files += 1;
    }
    assert!(read_files >= 5);
}

#[test]
fn the_walk_as_stage_archive_and_skeleton() {
    let Some(folder) = test_data("garments/human") else { return };
    let truth = read_npz(&folder.join("human_truth.npz"));
    for (obstacle, per_s, tolerance) in [
        ("usd = \"human_walk_points.usdc\"", 5.0, 1.2e-7),
        ("abc = \"human_walk.abc\"", 5.0, 1.2e-7),
        // Joints are interpolated, so all times count.
        ("usd = \"human_walk_skel.usda\"", 0.0, 1e-5),
    ] {
        let scene = read(&folder, obstacle).unwrap();
        assert_eq!(scene.obstacles[0].triangles, truth["triangles"].triples(), "{obstacle}");
        let mut compared = 0;
        for (i, &time_s) in truth["walk_times"].values.iter().enumerate() {
            let frame: f64 = time_s * per_s;
            if (frame - frame.round()).abs() > 1e-6 {
                continue;
            }
            let off = off(&positions(&scene, time_s), truth["walk_positions"].entry(i));
            assert!(off <= tolerance, "{obstacle} at {time_s} s: {off:e} off");
            compared += 1;
        }
        assert!(compared >= 2, "{obstacle}: {compared} times");
    }
    let rest = read(&folder, "usd = \"human_walk_skel.usda\"\nstart_s = 1\nlead_in_s = 0.5").unwrap();
    assert!(off(&positions(&rest, 0.5), &truth["rest"].values) < 1e-5, "a skeleton has a rest pose to come from");
}

#[test]
fn broken_stages_and_archives_say_what_is_wrong() {
    let Some(folder) = test_data("garments/caches") else { return };
    for (form, file, words) in [
        ("abc", "truncated.abc", ["cut off", "3150 bytes"]),
        ("abc", "hdf5.abc", ["HDF5", "Ogawa"]),
        ("usd", "no_mesh.usda", ["no mesh", "no_mesh.usda"]),
        ("usd", "topology_changes.usda", ["faces change", "time code 2"]),
    ] {
        let error = read(&folder, &format!("{form} = \"broken/{file}\"")).unwrap_err();
        for word in words.iter().chain([&file]) {
            assert!(error.contains(word) && error.lines().count() == 1, "no '{word}' in: {error}");
        }
    }
    for (form, file, word) in [("usd", "wave.abc", "not a USD stage"), ("abc", "wave.usdc", "not an Alembic file")] {
        let error = read(&folder, &format!("{form} = \"{file}\"")).unwrap_err();
        assert!(error.contains(word) && error.lines().count() == 1, "{error}");
    }
}

#[test]
fn broken_caches_say_what_is_wrong() {
    let Some(folder) = test_data("garments/caches") else { return };
    for (form, file, words) in [
        ("pc2", "truncated.pc2", ["cut off", "9 samples of 35 points"]),
        ("pc2", "magic.pc2", ["not a PC2 cache", "POINTCACHE2"]),
        ("pc2", "points_34.pc2", ["34 points", "wave_rest.obj has 35 vertices"]),
        ("pc2", "nan.pc2", ["point 17 of sample 3", "not a finite number"]),
        ("pc2", "no_samples.pc2", ["no samples", "pc2"]),
        ("mdd", "truncated.mdd", ["cut off", "9 samples of 35 points"]),
    ] {
        let rate = if form == "pc2" { "frames_per_s = 24" } else { "" };
        let error = read(&folder, &cache(form, &format!("broken/{file}"), rate)).unwrap_err();
        for word in words.iter().chain([&file]) {
            assert!(error.contains(word) && error.lines().count() == 1, "no '{word}' in: {error}");
        }
    }
}

#[test]
fn the_walk_as_cache_and_as_sequence() {
    let Some(folder) = test_data("garments/human") else { return };
    let truth = read_npz(&folder.join("human_truth.npz"));
    let scene = |obstacle: &str| read(&folder, obstacle).unwrap();
    let cache = scene("pc2 = { rest = \"human_rest.obj\", cache = \"human_walk.pc2\" }\nframes_per_s = 10");
    let sequence = scene("sequence = \"walk_obj/frame_%04d.obj\"\nframes_per_s = 5");
    assert_eq!(cache.obstacles[0].triangles, truth["triangles"].triples());
    let mut compared = 0;
    for (i, &time_s) in truth["walk_times"].values.iter().enumerate() {
        let entry = truth["walk_positions"].entry(i);
        let off = |scene: &Scene| {
            let got = positions(scene, time_s);
            got.iter().zip(entry).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max)
        };
        let is_sample = |per_s: f64| (time_s * per_s - (time_s * per_s).round()).abs() < 1e-6;
        if is_sample(10.0) {
            assert!(off(&cache) <= 1.2e-7 + 1e-6, "cache at {time_s} s: {:e}", off(&cache));
            compared += 1;
        }
        if is_sample(5.0) && time_s <= 2.2 {
            assert!(off(&sequence) <= 5.1e-6, "sequence at {time_s} s: {:e}", off(&sequence));
        }
    }
    assert!(compared >= 4);
}

/// A triangle in three frames, 1 m further along x in each, numbered from 7; and the same as a cache whose rest is at
/// z = 5.
fn moving() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut cache = b"POINTCACHE2\0".to_vec();
    [1i32, 3].iter().for_each(|x| cache.extend(x.to_le_bytes()));
    [0f32, 1.0].iter().for_each(|x| cache.extend(x.to_le_bytes()));
    cache.extend(3i32.to_le_bytes());
    let triangle = |x: f32, z: f32| [[x, 0.0, z], [x + 1.0, 0.0, z], [x, 1.0, z]];
    let obj = |points: [[f32; 3]; 3]| {
        let lines: Vec<String> = points.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n")).collect();
        lines.concat() + "f 1 2 3\n"
    };
    for frame in 0..3u8 {
        let points = triangle(f32::from(frame), 0.0);
        points.as_flattened().iter().for_each(|x| cache.extend(x.to_le_bytes()));
        std::fs::write(folder.path().join(format!("f_{}.obj", frame + 7)), obj(points)).unwrap();
    }
    std::fs::write(folder.path().join("c.pc2"), cache).unwrap();
    std::fs::write(folder.path().join("r.obj"), obj(triangle(0.0, 5.0))).unwrap();
    folder
}

#[test]
fn every_field_of_a_cache_and_of_a_sequence_does_what_it_says() {
    let folder = moving();
    let near = |fields: &str, time_s: f64, expected: [f32; 3]| {
        let scene = read(folder.path(), fields).unwrap();
        let found = Vec3::from_slice(&positions(&scene, time_s)[..3]);
        assert!(found.distance(Vec3::from(expected)) < 1e-6, "{fields} at {time_s} s: {found}");
    };
    let cache = "pc2 = { rest = \"r.obj\", cache = \"c.pc2\" }\nframes_per_s = 2\n";
    near(cache, 0.25, [0.5, 0., 0.]);
    near(cache, 9.0, [2., 0., 0.]);
    near(&format!("{cache}start_s = 1"), 1.25, [0.5, 0., 0.]);
    near(&format!("{cache}rate = 2"), 0.25, [1., 0., 0.]);
    near(&format!("{cache}loop = true"), 1.25, [0.5, 0., 0.]);
    near(&format!("{cache}lead_in_s = 1"), 0.0, [0., 0., 5.]);
    near(&format!("{cache}lead_in_s = 1"), 0.5, [0., 0., 2.5]);
    near(&format!("{cache}lead_in_s = 1"), 1.25, [0.5, 0., 0.]);
    near(&format!("{cache}units_m = 0.1\nup = \"z\"\norigin_m = [0, 7, 0]\nlead_in_s = 1"), 0.0, [0., 7.5, 0.]);
    let sequence = "sequence = \"f_%d.obj\"\nframes_per_s = 2\n";
    near(sequence, 0.25, [0.5, 0., 0.]);
    near(&format!("{sequence}first = 8"), 0.25, [1.5, 0., 0.]);
    near(&format!("{sequence}start_s = 1"), 1.25, [0.5, 0., 0.]);
    near(&format!("{sequence}loop = true\nrate = 2"), 0.625, [0.5, 0., 0.]);
    let looped = read(folder.path(), &format!("{sequence}loop = true")).unwrap();
    assert!(looped.warnings.iter().any(|line| line.contains("jumps by up to 2.00 m")), "{:?}", looped.warnings);
}

#[test]
fn wrong_fields_of_a_cache_and_of_a_sequence_are_named() {
    let folder = moving();
    let cache = "pc2 = { rest = \"r.obj\", cache = \"c.pc2\" }\n";
    for (fields, words) in [
        (cache, ["obstacle.frames_per_s", "is missing"]),
        ("pc2 = { cache = \"c.pc2\" }\nframes_per_s = 2", ["obstacle.pc2.rest", "is missing"]),
        ("pc2 = { rest = \"r.obj\", cache = \"d.pc2\" }\nframes_per_s = 2", ["obstacle.pc2.cache", "d.pc2"]),
        ("mdd = { rest = \"r.obj\", cache = \"c.pc2\" }\nframes_per_s = 2", ["obstacle.frames_per_s", "`pc2`"]),
        ("mdd = { rest = \"r.obj\", cache = \"c.pc2\" }", ["c.pc2", "cut off"]),
        (&format!("{cache}frames_per_s = 2\nmotion = []"), ["obstacle.motion", "`pc2`"]),
        (&format!("{cache}frames_per_s = 2\nfirst = 1"), ["obstacle.first", "`sequence`"]),
        ("sequence = \"f_%d.obj\"\nframes_per_s = 2\nfirst = 3", ["obstacle.first", "number 3 is missing"]),
        ("sequence = \"f_%d.obj\"\nframes_per_s = 2\nlead_in_s = 1", ["obstacle.lead_in_s", "rest shape"]),
        ("mesh = \"r.obj\"\nstart_s = 1", ["obstacle.start_s", "`sequence`, `pc2`, `mdd`, `usd`, `abc`"]),
    ] {
        let error = read(folder.path(), fields).unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)), "{fields}: {error}");
    }
    std::fs::remove_file(folder.path().join("f_8.obj")).unwrap();
    let error = read(folder.path(), "sequence = \"f_%d.obj\"\nframes_per_s = 2").unwrap_err();
    assert!(error.contains("number 8 is missing"), "{error}");
}

/// A stage whose own file is sound, but not a layer that it refers to, or that lies in it.
#[test]
fn damaged_layers_that_a_stage_refers_to_are_refused() {
    let Some(folder) = test_data("garments/caches") else { return };
    let sound = std::fs::read(folder.join("wave.usdc")).unwrap();
    let mut damaged = sound.clone();
    let word = |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
    // The count of the first section, and of every one after it.
    let table = word(&sound, 16);
    for section in 0..word(&sound, table) {
        let start = word(&sound, table + 8 + 32 * section + 16);
        damaged[start..start + 8].copy_from_slice(&(1u64 << 44).to_le_bytes());
    }
    let place = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| std::fs::write(place.path().join(name), bytes).unwrap();
    write("sound.usdc", &sound);
    write("damaged.usdc", &damaged);
    for layer in ["sound", "damaged"] {
        let head = "#usda 1.0\n(metersPerUnit = 1)\n";
        write(&format!("{layer}_below.usda"), format!("#usda 1.0\n(subLayers = [@{layer}.usdc@])\n").as_bytes());
        write(
            &format!("{layer}_refers.usda"),
            format!("{head}def Xform \"x\" (references = @{layer}.usdc@</World>) {{}}\n").as_bytes(),
        );
        write(
            &format!("{layer}_pays.usda"),
            format!("{head}def Xform \"x\" (payload = @{layer}.usdc@</World>) {{}}\n").as_bytes(),
        );
        write(
            &format!("{layer}.usdz"),
            &packed(&format!("{layer}.usdc"), if layer == "sound" { &sound } else { &damaged }),
        );
    }
    read(place.path(), "usd = \"sound_below.usda\"").unwrap();
    read(place.path(), "usd = \"sound.usdz\"").unwrap();
    for name in ["damaged_below.usda", "damaged_refers.usda", "damaged_pays.usda", "damaged.usdz"] {
        let error = read(place.path(), &format!("usd = \"{name}\"")).unwrap_err().to_string();
        assert!(
            error.contains(name) && error.contains("is damaged: it counts") && !error.contains('\n'),
            "{name}: {error}"
        );
        let told = name.ends_with("usdz") || error.contains("damaged.usdc");
        assert!(told, "{name}: {error}");
    }
}

/// A package with one file in it, as it is.
fn packed(name: &str, bytes: &[u8]) -> Vec<u8> {
    let crc = bytes.iter().fold(!0u32, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 & 0u32.wrapping_sub(crc & 1)))
    });
    let (size, length) = ((bytes.len() as u32).to_le_bytes(), (name.len() as u16).to_le_bytes());
    // Data begin at a multiple of 64 bytes.
    let padding = (64 - (30 + name.len()) % 64) % 64;
    let fields = |extra: u16| {
        let mut fields = vec![0, 0, 0, 0, 0, 0, 0x21, 0];
        [&(!crc).to_le_bytes()[..], &size, &size, &length, &extra.to_le_bytes()]
            .iter()
            .for_each(|part| fields.extend(*part));
        fields
    };
    let mut all = b"PK\x03\x04\x0a\0".to_vec();
    all.extend(fields(padding as u16));
    all.extend(name.as_bytes());
    all.extend(vec![0; padding]);
    all.extend(bytes);
    let directory = all.len() as u32;
    all.extend(b"PK\x01\x02\x0a\0\x0a\0");
    all.extend(fields(0));
    all.extend([0; 14]);
    all.extend(name.as_bytes());
    let directory_size = all.len() as u32 - directory;
    all.extend(b"PK\x05\x06\0\0\0\0\x01\0\x01\0");
    all.extend(directory_size.to_le_bytes());
    all.extend(directory.to_le_bytes());
    all.extend([0, 0]);
    all
}

/// A stage in centimeters with z up: two triangles whose points move along z, below a transform that turns them about z
/// by a right angle within a second and then moves them; a mesh that is mirrored and stands still; one that is hidden.
const STAGE: &str = r#"#usda 1.0
(
    metersPerUnit = 0.01
    timeCodesPerSecond = 10
    upAxis = "Z"
)
def Xform "World"
{
    float xformOp:rotateZ.timeSamples = { 0: 0, 10: 90 }
    double3 xformOp:translate = (100, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
    def Mesh "moving"
    {
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(0, 0, -50), (100, 0, -50), (100, 100, -50), (0, 100, -50)]
        point3f[] points.timeSamples = {
            0: [(0, 0, 0), (100, 0, 0), (100, 100, 0), (0, 100, 0)],
            20: [(0, 0, 200), (100, 0, 200), (100, 100, 200), (0, 100, 200)],
        }
    }
    def Mesh "hidden"
    {
        token visibility = "invisible"
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (100, 0, 0), (100, 100, 0)]
    }
}
def Mesh "still"
{
    uniform token orientation = "leftHanded"
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 2, 1]
    point3f[] points = [(0, 0, 0), (100, 0, 0), (100, 100, 0)]
    float3 xformOp:scale = (-1, 1, 1)
    uniform token[] xformOpOrder = ["xformOp:scale"]
}
"#;

#[test]
fn a_stage_is_read_with_its_units_axis_and_transforms() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("s.usda"), STAGE).unwrap();
    let near = |fields: &str, vertex: usize, time_s: f64, expected: [f64; 3]| {
        let scene = read(folder.path(), &format!("usd = \"s.usda\"\n{fields}")).unwrap();
        let found = Vec3::from_slice(&positions(&scene, time_s)[3 * vertex..][..3]);
        let off = found.as_dvec3().distance(expected.into());
        assert!(off < 4e-5, "{fields}, vertex {vertex} at {time_s} s: {found}, {off:e} off");
    };
    // z up: (x, y, z) is at (x, z, -y).
    near("", 0, 0.0, [1., 0., 0.]);
    near("", 1, 0.0, [2., 0., 0.]);
    near("", 1, 1.0, [1., 1., -1.]);
    near("", 1, 9.0, [1., 2., -1.]);
    near("", 1, 2.0, [1., 2., -1.]);
    let (sine, cosine) = (0.3 * std::f64::consts::FRAC_PI_2).sin_cos();
    near("", 1, 0.3, [1.0 + cosine, 0.3, -sine]);
    near("units_m = 1\nup = \"y\"", 1, 0.0, [200., 0., 0.]);
    // The mirrored mesh, whose winding is that of the file.
    near("node = \"still\"", 2, 0.0, [-1., 0., -1.]);
    let still = read(folder.path(), "usd = \"s.usda\"\nnode = \"still\"\nmotion = [{ time_s = 1 }]").unwrap();
    let mut corners = still.obstacles[0].triangles[0];
    let start = corners.iter().position(|&v| v == 0).unwrap();
    corners.rotate_left(start);
    assert_eq!(corners, [0, 2, 1], "left-handed and mirrored: turned over twice");
    near("node = \"hidden\"", 1, 0.0, [2., 0., 0.]);
    near("node = \"/World/moving\"\nlead_in_s = 1", 1, 0.0, [2., -0.5, 0.]);
    let all = read(folder.path(), "usd = \"s.usda\"").unwrap();
    assert_eq!((all.obstacles[0].positions.len(), all.obstacles[0].triangles.len()), (7, 3), "without the hidden one");
}

#[test]
fn wrong_fields_of_a_stage_are_named() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("s.usda"), STAGE).unwrap();
    let stage = "usd = \"s.usda\"\n";
    let without =
        |line: &str| STAGE.lines().filter(|one| !one.contains(line)).map(|one| format!("{one}\n")).collect::<String>();
    std::fs::write(folder.path().join("bare.usda"), without("metersPerUnit")).unwrap();
    std::fs::write(
        folder.path().join("far.usda"),
        STAGE.replace("def Mesh \"still\"", "def \"x\" (references = @none.usda@) {}\ndef Mesh \"still\""),
    )
    .unwrap();
    std::fs::write(folder.path().join("nan.usda"), STAGE.replace("(0, 0, 200)", "(nan, 0, 200)")).unwrap();
    for (fields, words) in [
        (format!("{stage}node = \"nobody\""), ["no mesh in `nobody`", "/World/moving"]),
        (format!("{stage}clip = \"walk\""), ["obstacle.clip", "`gltf` or `body`"]),
        (format!("{stage}motion = [{{ time_s = 1 }}]"), ["obstacle.motion", "meshes that move"]),
        (format!("{stage}node = \"still\"\nstart_s = 1"), ["obstacle.start_s", "stand still"]),
        ("usd = \"t.usda\"".into(), ["obstacle.usd", "t.usda"]),
        ("usd = \"far.usda\"".into(), ["far.usda", "none.usda"]),
        ("usd = \"nan.usda\"".into(), ["point 0", "not a finite number"]),
    ] {
        let result = read(folder.path(), &fields);
        let error = result.unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)) && error.lines().count() == 1, "{fields}: {error}");
    }
    let bare = read(folder.path(), "usd = \"bare.usda\"").unwrap();
    assert!(bare.warnings.iter().any(|line| line.contains("does not say its unit")), "{:?}", bare.warnings);
}
