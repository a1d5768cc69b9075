//! Runs far from the world's origin: the states have the bits of the run at the origin, files hold world coordinates.

use support::process::Place;

const FAR_M: f64 = 10_000.0;

/// A cloth that falls on a ball which rises, `far_m` from the origin in x and z.
fn scene(far_m: f64) -> String {
    format!(
        r#"
        [simulation]
        steps_per_frame = 5
        frames = 6
        [[cloth]]
        sheet = {{ size_m = [1, 1], triangles = 400 }}
        plane = "xz"
        origin_m = [{x}, 0.26, {z}]
        [[obstacle]]
        sphere = {{ center_m = [{far_m}, 0, {far_m}], radius_m = 0.25, triangles = 300 }}
        motion = [{{ time_s = 0 }}, {{ time_s = 0.1, translate_m = [0, 0.05, 0] }}]
        "#,
        x = far_m - 0.5,
        z = far_m + 0.5,
    )
}

/// Vertices of an OBJ file.
fn vertices(text: &str) -> Vec<[f64; 3]> {
    let lines = text.lines().filter_map(|line| line.strip_prefix("v "));
    lines.map(|line| std::array::from_fn(|i| line.split(' ').nth(i).unwrap().parse().unwrap())).collect()
}

#[test]
fn ten_kilometers_away_a_run_has_the_bits_of_the_run_at_the_origin() {
    let place = Place::new();
    place.write("near.toml", scene(0.0));
    place.write("far.toml", scene(FAR_M));
    place.run("run near.toml --executor cpu --workers 1 --format obj --out near").expect(0);
    let ended =
        place.run("run far.toml --executor cpu --workers 2 --format obj,ply,pc2 --out far --frames 4").expect(0);
    ended.says(&["computed about the local origin [10000, 0, 10000] m", "by up to 0.49 mm"]);
    place.run("run --resume --out far --workers 3 --frames 6").expect(0);
    assert_eq!(place.hashes("far"), place.hashes("near"));
    assert_eq!(place.report("far")["local_origin_m"], serde_json::json!([FAR_M, 0.0, FAR_M]));
    assert!(place.report("near").get("local_origin_m").is_none());

    for name in ["frame_000006.obj", "obstacle_000006.obj"] {
        let read = |run: &str| vertices(&std::fs::read_to_string(place.path(&format!("{run}/frames/{name}"))).unwrap());
        // The file of the run at the origin has the fewest digits that read back to the same f32.
        let (near, far) = (read("near"), read("far"));
        assert_eq!(near.len(), far.len());
        for (n, f) in near.iter().zip(&far) {
            assert!((f[0] - FAR_M - n[0]).abs() < 1e-7 && (f[1] - n[1]).abs() < 1e-7, "{n:?} and {f:?}");
        }
    }
    // PLY and the point cache round to f32, by half the distance of its numbers at most.
    let near = vertices(&std::fs::read_to_string(place.path("near/frames/frame_000006.obj")).unwrap());
    let ply = std::fs::read(place.path("far/frames/frame_000006.ply")).unwrap();
    let cache = std::fs::read(place.path("far/cloth.pc2")).unwrap();
    let header = ply.windows(11).position(|bytes| bytes == b"end_header\n").unwrap() + 11;
    let sample = near.len() * 12;
    for bytes in [&ply[header..header + sample], &cache[32 + 6 * sample..]] {
        for (n, f) in near.iter().zip(bytes.as_chunks::<12>().0) {
            let x = f64::from(f32::from_le_bytes([f[0], f[1], f[2], f[3]]));
            assert!((x - FAR_M - n[0]).abs() <= 0.5 / 1024.0, "{x} for {}", n[0]);
        }
    }
    // A picture shows the same, though positions of PLY files are a millimeter apart.
    place.run("render far --frames 6..6 --executor cpu --size 64x64").expect(0);
}
