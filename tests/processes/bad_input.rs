//! Bad input to the real program: one sentence that names the file or the field, exit code 2, nothing written.

use support::process::{Place, flag, repository};

/// Runs `loomtree run` with bad input: exactly one error, which holds all of `words`, and no run directory.
fn refused(place: &Place, flags: &str, words: &[&str]) {
    let ended = place.run(&format!("run {flags} --executor cpu --out out")).expect(2);
    let error = ended.error();
    for word in words {
        assert!(error.contains(word), "no '{word}' in: {error}\n{}", ended.story);
    }
    assert!(!place.path("out").exists(), "a run directory is left\n{}", ended.story);
    assert!(ended.stdout.is_empty(), "{}", ended.story);
}

#[test]
fn scenes() {
    let place = Place::new();
    for (from, to, words) in [
        ("damping_s = 0.001", "dampening_s = 0.001", ["line 13", "dampening_s"]),
        ("frames = 3", "frames = 3\nthickness_m = -0.001", ["line 8", "simulation.thickness_m"]),
        ("step_s = 0.004", "step_s = \"fast\"", ["line 5", "simulation.step_s"]),
        ("fabric = \"nylon\"", "fabric = \"granite\"", ["line 12", "granite"]),
        ("edge = \"left\"", "edge = \"inner\"", ["line 15", "edge"]),
        ("[air]", "[air", ["line 8", "bad.toml"]),
    ] {
        let good = flag(200, 2, 3);
        assert!(good.contains(from));
        place.write("bad.toml", good.replace(from, to));
        refused(&place, "bad.toml", &["bad.toml", words[0], words[1]]);
    }
    refused(&place, "nowhere.toml", &["nowhere.toml", "No such file"]);
    place.write("empty.toml", "");
    refused(&place, "empty.toml", &["empty.toml", "[[cloth]]"]);
    place.write("noise.toml", [0xff, 0xfe, 0x00, 0x80]);
    refused(&place, "noise.toml", &["noise.toml"]);
    refused(&place, "/", &["/"]);
}

#[test]
fn meshes() {
    let place = Place::new();
    place.write("scene.toml", "[[cloth]]\nmesh = \"m.obj\"\n");
    refused(&place, "scene.toml", &["scene.toml", "line 2", "m.obj"]);
    let corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nv 0 0 1\n";
    for (mesh, words) in [
        ("v 0 0 0\nv 1 0 0\nv 0 1", vec!["line 3"]),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", vec!["line 4", "4"]),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", vec!["line 4"]),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", vec!["area"]),
        ("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", vec!["line 3"]),
        (&format!("{corners}f 1 2 3\nf 2 1 4\nf 1 2 5\n"), vec!["1", "2"]),
        ("", vec!["no "]),
        ("v 0 0 0\n", vec!["no "]),
    ] {
        place.write("m.obj", mesh);
        refused(&place, "scene.toml", &[&["m.obj"], words.as_slice()].concat());
    }
}

#[test]
fn flags() {
    let place = Place::new();
    place.write("flag.toml", flag(200, 2, 3));
    place.write("tiny.toml", "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 2 }\n");
    place.write("rank.topology", "this is no topology");
    let pcie = repository("topology/pcie_4.toml");
    let pcie = pcie.display();
    for (flags, words) in [
        ("flag.toml --workers 0", vec!["--workers 0", "1 to "]),
        ("flag.toml --workers 1000", vec!["--workers 1000", "1 to "]),
        ("flag.toml --workers many", vec!["--workers", "many"]),
        ("tiny.toml --workers 5", vec!["--workers 5", "only 4 vertices"]),
        ("flag.toml --workers 3 --schedule fat-tree", vec!["--schedule", "fat-tree", "3"]),
        ("flag.toml --schedule clockwise", vec!["--schedule", "clockwise"]),
        (&format!("flag.toml --workers 5 --topology {pcie}"), vec!["--workers 5", "pcie_4.toml", "only 4 GPUs"]),
        ("flag.toml --workers 2 --topology nowhere.toml", vec!["nowhere.toml"]),
        ("flag.toml --workers 2 --topology rank.topology", vec!["rank.topology"]),
        ("flag.toml --format gif", vec!["--format", "gif", "obj, ply"]),
        ("flag.toml --format ,", vec!["--format"]),
        ("flag.toml --resolution 0", vec!["flag.toml", "resolution"]),
        ("flag.toml --heartbeat=-1", vec!["--heartbeat"]),
        ("flag.toml --heartbeat 1e300", vec!["--heartbeat"]),
        ("flag.toml --frames 4294967295", vec!["4294967295 frames", "steps"]),
        ("flag.toml --threads 0", vec!["--threads"]),
        ("flag.toml --resume --overwrite", vec!["--resume", "--overwrite"]),
        ("flag.toml --resume", vec!["out", "not a run directory"]),
    ] {
        refused(&place, flags, &words);
    }
}

/// An adapter that is not there is found out by a worker, after the run directory was tried.
#[test]
fn an_adapter_that_is_not_there() {
    let place = Place::new();
    place.write("flag.toml", flag(200, 2, 3));
    for out in ["out", "one/two"] {
        let ended =
            place.run(&format!("run flag.toml --workers 2 --executor gpu --adapter 4711 --out {out}")).expect(2);
        assert!(
            !ended.error().is_empty() && !place.path(out).exists() && !place.path("one").exists(),
            "{}",
            ended.story
        );
    }
}

#[test]
fn places_that_cannot_be_written() {
    let place = Place::new();
    place.write("flag.toml", flag(200, 2, 3));
    place.write("file", "");
    for (out, word) in [
        ("file", "is a file"),
        ("file/below", "cannot write to file/below"),
        ("/proc/loomtree", "cannot write to /proc/loomtree"),
    ] {
        let ended = place.run(&format!("run flag.toml --executor cpu --out {out}")).expect(2);
        assert!(ended.error().contains(word) && ended.error().contains("--out"), "{}", ended.story);
    }
}

#[test]
fn a_run_that_is_there_is_not_overwritten_by_accident() {
    let place = Place::new();
    place.write("flag.toml", flag(200, 2, 3));
    place.run("run flag.toml --executor cpu --out out").expect(0);
    let hashes = place.hashes("out");
    let ended = place.run("run flag.toml --executor cpu --out out --frames 1").expect(2);
    assert!(
        ["already holds a run", "--resume", "--overwrite"].iter().all(|word| ended.error().contains(word)),
        "{}",
        ended.story
    );
    assert_eq!(place.hashes("out"), hashes);
    place.run("run flag.toml --executor cpu --out out --frames 1 --overwrite").expect(0);
    assert_eq!(place.hashes("out"), hashes[..2]);
    assert!(!place.path("out/frames/frame_000002.ply").exists());
}

/// Places that only a mount makes: needs the right to mount in a namespace of its own.
#[test]
fn too_little_shared_memory_and_a_read_only_place() {
    let place = Place::new();
    place.write("flag.toml", flag(2000, 2, 3));
    std::fs::create_dir(place.path("locked")).expect("a folder");
    let program = env!("CARGO_BIN_EXE_loomtree");
    place.write("probe.sh", "mount -t tmpfs -o size=1M tmpfs /dev/shm && mount -t tmpfs -o ro tmpfs locked\n");
    let words = "run flag.toml --executor cpu --workers 4 --out";
    place.write("small.sh", format!("mount -t tmpfs -o size=1M tmpfs /dev/shm && exec {program} {words} out\n"));
    place.write("locked.sh", format!("mount -t tmpfs -o ro tmpfs locked && exec {program} {words} locked/out\n"));
    let probe =
        std::process::Command::new("unshare").args(["-m", "sh", "probe.sh"]).current_dir(place.path("")).output();
    if !probe.is_ok_and(|output| output.status.success()) {
        println!("skipped: no right to mount in a namespace of its own");
        return;
    }
    let ended = place.start_program("unshare", "-m sh small.sh", &[]).wait().expect(2);
    let error = ended.error();
    assert!(error.contains("/dev/shm has 1.0 MiB free and this run needs ") && error.contains("--shm-size"), "{error}");
    assert!(!place.path("out").exists());
    let ended = place.start_program("unshare", "-m sh locked.sh", &[]).wait().expect(2);
    assert!(ended.error().contains("cannot write to locked/out: Read-only file system"), "{}", ended.story);
}
