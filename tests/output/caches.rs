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
        ("mesh = \"r.obj\"\nstart_s = 1", ["obstacle.start_s", "`sequence`, `pc2`, `mdd`"]),
    ] {
        let error = read(folder.path(), fields).unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)), "{fields}: {error}");
    }
    std::fs::remove_file(folder.path().join("f_8.obj")).unwrap();
    let error = read(folder.path(), "sequence = \"f_%d.obj\"\nframes_per_s = 2").unwrap_err();
    assert!(error.contains("number 8 is missing"), "{error}");
}
