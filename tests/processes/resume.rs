//! Ctrl-C and `--resume`: what was interrupted goes on with the bits of a run that never was, on any number of workers.

use std::fs;

use loomtree::output::Checkpoint;
use support::process::{Place, Signal, flag, signal};

fn straight(place: &Place, frames: u32) -> Vec<(u64, String)> {
    place.run(&format!("run flag.toml --executor cpu --workers 1 --frames {frames} --out straight")).expect(0);
    place.hashes("straight")
}

#[test]
fn ctrl_c_stops_after_the_step_and_resume_goes_on_with_the_same_bits() {
    let place = Place::new();
    // Frames so long that the stop falls between two of them.
    place.write("flag.toml", flag(1000, 50, 1_000_000));
    let mut running =
        place.start("run flag.toml --executor cpu --threads 1 --workers 4 --out out --checkpoint-every 0");
    running.wait_for_frame("out", 1);
    signal(running.pid(), Signal::INT);
    let ended =
        running.wait().expect(130).says(&["stopping after the current step", "stopped; continue with --resume"]);
    assert!(!ended.stderr.contains("error"), "{}", ended.story);
    assert_eq!(place.report("out")["status"], "stopped");
    let (_, frame, step) = place.newest_checkpoint("out");
    assert!(step > 50 && frame == (step / 50) as u32, "frame {frame}, step {step}");
    // Fewer workers, the rest as recorded in run.toml.
    let frames = frame + 2;
    place.run(&format!("run --resume --out out --workers 2 --frames {frames}")).expect(0);
    assert_eq!(place.hashes("out"), straight(&place, frames));
    let report = place.report("out");
    assert_eq!((&report["status"], &report["resumed"][0]["step"]), (&"done".into(), &step.into()));
    assert_eq!(report["steps"].as_array().expect("steps").len() as u32, frames * 50);
}

#[test]
fn a_finished_run_goes_on_with_more_workers() {
    let place = Place::new();
    place.write("flag.toml", flag(1000, 3, 6));
    place.run("run flag.toml --executor cpu --workers 2 --out out").expect(0);
    place.run("run --resume --out out --workers 5 --frames 10").expect(0);
    place.run("run --resume --out out --workers 3 --frames 12").expect(0);
    assert_eq!(place.hashes("out"), straight(&place, 12));
    let trace = || fs::read(place.path("out/trace.json")).expect("a trace");
    let before = trace();
    place.run("run --resume --out out").expect(0).says(&["nothing is left to do"]);
    assert!(trace() == before, "a start without steps has no trace of its own");
}

#[test]
fn creases_go_on_with_the_same_bits() {
    let place = Place::new();
    place.write(
        "flag.toml",
        flag(1000, 3, 6).replace("fabric =", "yield_curvature = 1.0\n        hardening = 0.2\n        fabric ="),
    );
    place.run("run flag.toml --executor cpu --workers 2 --keep-states frames --out out").expect(0);
    let state = fs::read(place.path("out/states/step_00000018.ltc")).expect("a state");
    let creases = Checkpoint::from_bytes(&state).expect("a state").state.creases;
    assert!(creases.iter().filter(|crease| crease[1] > 0.0).count() > creases.len() / 20);
    place.run("run --resume --out out --workers 5 --frames 8").expect(0);
    place.run("run --resume --out out --workers 1 --frames 10").expect(0);
    assert_eq!(place.hashes("out"), straight(&place, 10));
}

/// Creases and rest stretches in one cloth, and a limit that pulls triangles back in another.
#[test]
fn rest_stretches_and_limits_go_on_with_the_same_bits() {
    let place = Place::new();
    let fields = "yield_curvature = 1.0
        yield_strain = 0.002
        hardening = 0.2
        weakening = 0.5
        strain_limit = [0.9, 1.01]
        fabric =";
    let limited = r#"cloth = 0
        [[cloth]]
        name = "limited"
        sheet = { size_m = [1.0, 1.0] }
        origin_m = [0.0, 0.0, 3.0]
        fabric = "nylon"
        strain_limit = [0.95, 1.001]
        [[pin]]
        cloth = "limited"
        corners = ["top-left"]
        "#;
    place.write("flag.toml", flag(1000, 3, 6).replace("fabric =", fields) + limited);
    place.run("run flag.toml --executor cpu --workers 2 --keep-states frames --out out").expect(0);
    let state = fs::read(place.path("out/states/step_00000018.ltc")).expect("a state");
    let state = Checkpoint::from_bytes(&state).expect("a state").state;
    let yielded = state.stretches.iter().filter(|stretch| stretch[3] > 0.0).count();
    assert!(yielded > state.stretches.len() / 100, "{yielded} of {} triangles", state.stretches.len());
    place.run("run --resume --out out --workers 5 --frames 8").expect(0);
    place.run("run --resume --out out --workers 1 --frames 10").expect(0);
    assert_eq!(place.hashes("out"), straight(&place, 10));
    let report = place.report("out");
    let pulled = |step: &&serde_json::Value| step["limits"]["pulled"].as_u64().is_some_and(|pulled| pulled > 0);
    assert!(report["steps"].as_array().expect("steps").iter().filter(pulled).count() > 1, "limits have work");
}

#[test]
fn a_truncated_checkpoint_is_skipped_for_the_one_before() {
    let place = Place::new();
    place.write("flag.toml", flag(1000, 3, 10));
    place.run("run flag.toml --executor cpu --workers 2 --checkpoint-every 4 --out out").expect(0);
    let (newest, frame, _) = place.newest_checkpoint("out");
    assert_eq!(frame, 10);
    let bytes = fs::read(&newest).expect("a checkpoint");
    fs::write(&newest, &bytes[..bytes.len() / 2]).expect("a shorter checkpoint");
    let name = newest.file_name().expect("a name").to_string_lossy().into_owned();
    place.run("run --resume --out out --frames 12").expect(0).says(&[&name, "is skipped: it is cut off or damaged"]);
    assert_eq!(place.report("out")["resumed"][0]["frame"], 8);
    assert_eq!(place.hashes("out"), straight(&place, 12));
    // With none left there is nothing to go on from.
    for entry in fs::read_dir(place.path("out/checkpoint")).expect("checkpoints").flatten() {
        fs::write(entry.path(), "LOOMCKPT").expect("a damaged checkpoint");
    }
    let ended = place.run("run --resume --out out --frames 14").expect(2);
    assert!(ended.error().contains("holds no valid checkpoint to resume from"), "{}", ended.story);
}

#[test]
fn a_resume_that_does_not_fit_is_refused_and_changes_nothing() {
    let place = Place::new();
    place.write("flag.toml", flag(1000, 2, 3));
    place.write("other.toml", flag(1000, 2, 3).replace("nylon", "cotton"));
    place.run("run flag.toml --executor cpu --out out").expect(0);
    let before = (place.hashes("out"), fs::read(place.path("out/run.toml")).expect("run.toml"));
    for (flags, word) in [
        ("other.toml --out out", "belongs to another scene, resolution or setting"),
        ("flag.toml --resolution 2000 --out out", "belongs to another scene, resolution or setting"),
        ("--out nowhere", "nowhere"),
        ("", "--out DIR"),
    ] {
        let ended = place.run(&format!("run --resume --frames 5 {flags}")).expect(2);
        assert!(ended.error().contains(word), "{}", ended.story);
    }
    assert!(!place.path("nowhere").exists());
    assert_eq!((place.hashes("out"), fs::read(place.path("out/run.toml")).expect("run.toml")), before);
}

/// A sheet between two balls that move into each other and apart again.
const PINCHED: &str = r#"
name = "pinched"
resolution = 512
[simulation]
step_s = 0.004
steps_per_frame = 2
frames = 10
thickness_m = 0.0015
[[cloth]]
sheet = { size_m = [0.2, 0.2] }
origin_m = [-0.1, -0.1, 0.0]
fabric = "cotton"
[[pin]]
edge = "top"
[[obstacle]]
name = "arm"
sphere = { center_m = [0.004, 0.0, 0.06], radius_m = 0.05 }
motion = [{ time_s = 0.0 }, { time_s = 0.04, translate_m = [0.0, 0.0, -0.013] }, { time_s = 0.08 }]
[[obstacle]]
name = "body"
sphere = { center_m = [0.004, 0.0, -0.06], radius_m = 0.05 }
motion = [{ time_s = 0.0 }, { time_s = 0.04, translate_m = [0.0, 0.0, 0.013] }, { time_s = 0.08 }]
"#;

#[test]
fn what_is_let_go_between_obstacles_goes_on_on_other_workers() {
    let place = Place::new();
    place.write("pinched.toml", PINCHED);
    place.run("run pinched.toml --executor cpu --workers 1 --out straight").expect(0);
    place
        .run("run pinched.toml --executor cpu --workers 3 --frames 5 --out out")
        .expect(0)
        .says(&["let go between obstacles"]);
    place.run("run --resume --out out --workers 2 --frames 10").expect(0);
    assert_eq!(place.hashes("out"), place.hashes("straight"));
    let [report, straight] = ["out", "straight"].map(|out| place.report(out)["frames"].clone());
    assert_eq!(report, straight);
    let listed = |frame: usize| &report[frame]["let_go"];
    assert_eq!((&listed(5)[0]["obstacle"], &listed(5)[0]["side"]), (&"body".into(), &"outside".into()), "{report}");
    assert!(!listed(5)[0]["vertices"].as_array().expect("vertices").is_empty());
    assert!(listed(2).is_null() && listed(10).is_null(), "before and after: {report}");
    let steps = place.report("out")["steps"].clone();
    let sum = |field: &str| {
        let steps = steps.as_array().expect("steps").iter();
        steps.map(|step| step["let_go"][field].as_u64().unwrap_or(0)).sum::<u64>()
    };
    assert!(sum("new") > 0 && sum("new") == sum("taken_up"), "{} and {}", sum("new"), sum("taken_up"));
}

/// Both kinds of what a state may hold besides positions and velocities, in one checkpoint.
#[test]
fn creases_and_what_is_let_go_go_on_together() {
    let place = Place::new();
    let creased =
        PINCHED.replace("[[cloth]]", "[[cloth]]\nyield_curvature = 0.5\nhardening = 0.1\nstrain_limit = [0.9, 1.03]");
    place.write("pinched.toml", creased);
    place.run("run pinched.toml --executor cpu --workers 1 --out straight").expect(0);
    place.run("run pinched.toml --executor cpu --workers 3 --keep-states frames --frames 5 --out out").expect(0);
    let kept = fs::read_dir(place.path("out/states")).expect("states").map(|entry| entry.expect("an entry").path());
    let last = fs::read(kept.max().expect("a state")).expect("a state");
    let state = Checkpoint::from_bytes(&last).expect("a state").state;
    assert!(!state.let_go.is_empty(), "pairs are let go where the run is interrupted");
    let yielded = state.creases.iter().filter(|crease| crease[1] > 0.0).count();
    assert!(yielded > 0, "none of {} hinges has yielded where the run is interrupted", state.creases.len());
    place.run("run --resume --out out --workers 2 --frames 7").expect(0);
    place.run("run --resume --out out --workers 8 --frames 10").expect(0);
    assert_eq!(place.hashes("out"), place.hashes("straight"));
}

/// A checkpoint may be newer than the last report that was due, and the coordinator may be killed right after it.
#[test]
fn a_killed_coordinator_leaves_no_hole_in_the_report() {
    let place = Place::new();
    place.write("flag.toml", flag(1000, 2, 1_000_000));
    let mut running = place.start("run flag.toml --executor cpu --threads 1 --checkpoint-every 1 --out out");
    running.wait_for_frame("out", 5);
    signal(running.pid(), Signal::KILL);
    running.wait();
    let (_, frame, _) = place.newest_checkpoint("out");
    let frames = frame + 3;
    place.run(&format!("run --resume --out out --frames {frames}")).expect(0);
    let report = place.report("out");
    assert_eq!(place.hashes("out"), straight(&place, frames));
    let steps: Vec<u64> =
        report["steps"].as_array().expect("steps").iter().filter_map(|s| s["step"].as_u64()).collect();
    assert_eq!(steps, (1..=u64::from(2 * frames)).collect::<Vec<_>>());
}

#[test]
fn a_moved_run_goes_on_without_its_scene_file() {
    let place = Place::new();
    place.write("flag.toml", flag(1000, 2, 3));
    let expected = straight(&place, 6);
    place.run("run flag.toml --executor cpu --out out").expect(0);
    fs::rename(place.path("out"), place.path("moved")).expect("moves");
    // Changed first, then gone.
    place.write("flag.toml", flag(1000, 2, 3).replace("nylon", "cotton"));
    place.run("run --resume --out moved --frames 5").expect(0).says(&["flag.toml has changed since"]);
    fs::remove_file(place.path("flag.toml")).expect("removes");
    place.run("run --resume --out moved --frames 6 --checkpoint-every 1 --workers 2").expect(0);
    assert_eq!(place.hashes("moved"), expected);
}

#[test]
fn a_resumed_run_takes_up_other_formats() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 3));
    place.run("run flag.toml --executor cpu --out out").expect(0);
    place
        .run("run --resume --out out --frames 5 --format pc2,obj")
        .expect(0)
        .says(&["cloth.pc2: frames 0 to 3 converted", "obj files begin with frame 4; earlier frames are there as ply"]);
    place.run("run flag.toml --executor cpu --out straight --frames 6 --format pc2,obj").expect(0);
    let read = |path: &str| fs::read(place.path(path)).expect(path);
    // What was changed is recorded: the next start goes on with it.
    place.run("run --resume --out out").expect(0).says(&["nothing is left to do", "checkpoint is of frame 5"]);
    place.run("run --resume --out out --frames 6").expect(0);
    assert!(read("out/cloth.pc2") == read("straight/cloth.pc2"), "the same point cache");
    assert!(read("out/frames/frame_000006.obj") == read("straight/frames/frame_000006.obj"));
    assert!(!place.path("out/frames/frame_000006.ply").exists());
    assert!(read("out/frames/frame_000005.obj") == read("straight/frames/frame_000005.obj"));
    // Frames that are not there cannot be converted.
    place.run("run flag.toml --executor cpu --out holes").expect(0);
    fs::remove_file(place.path("holes/frames/frame_000001.ply")).expect("removes");
    let ended = place.run("run --resume --out holes --frames 5 --format pc2").expect(1);
    assert!(ended.error().contains("frame 4 does not follow the 1 frames"), "{}", ended.story);
    // Nor those of another mesh, here with one triangle wound the other way.
    place.run("run flag.toml --executor cpu --out turned").expect(0);
    let mut frame = read("turned/frames/frame_000002.ply");
    let indices = frame.len() - 8;
    frame[indices..].rotate_left(4);
    place.write("turned/frames/frame_000002.ply", frame);
    let ended = place.run("run --resume --out turned --frames 5 --format pc2").expect(1);
    assert!(ended.error().contains("frame 2 in turned/frames is of another mesh than the run"), "{}", ended.story);
    assert!(!place.path("turned/cloth.pc2").exists() && !place.path("turned/.cloth.pc2.part").exists());
}
