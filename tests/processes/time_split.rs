//! `run --segments`: a shot that is split in time, as a user runs it.

use std::path::Path;
use std::sync::Arc;

use loomtree::coordinator::session::{Next, StepDone, Watch, Way};
use loomtree::coordinator::{Launch, RunOptions, RunPlan, Session, SessionPlace};
use loomtree::mesh::{TriangleMesh, first_intersection};
use loomtree::model::State;
use loomtree::output::Checkpoint;
use loomtree::protocol::ExecutorChoice;
use loomtree::step::Guidance;
use support::process::{Place, Signal, flag, repository, signal};

/// A small sheet, pinned at one edge, that swings into a ball: it has contacts and takes a few seconds.
const SWING: &str = r#"
    name = "swing"
    resolution = 500
    [simulation]
    step_s = 0.004
    steps_per_frame = 5
    frames = 24
    [[cloth]]
    name = "sheet"
    sheet = { size_m = [0.5, 0.5] }
    plane = "xz"
    origin_m = [0.0, 0.5, 0.0]
    fabric = "cotton"
    [[pin]]
    edge = "left"
    [[obstacle]]
    name = "ball"
    sphere = { center_m = [0.1, 0.1, -0.25], radius_m = 0.1, triangles = 300 }
"#;

/// The same with a mesh from a file in place of the sheet.
const SWING_OF_FILE: &str = r#"
    name = "swing"
    [simulation]
    step_s = 0.004
    steps_per_frame = 5
    frames = 12
    [[cloth]]
    name = "sheet"
    mesh = "sheet.obj"
    origin_m = [0.0, 0.5, 0.0]
    fabric = "cotton"
    [[pin]]
    cloth = "sheet"
    vertices = [0, 1, 2, 3, 4, 5]
    [[obstacle]]
    name = "ball"
    sphere = { center_m = [0.1, 0.1, -0.25], radius_m = 0.1, triangles = 300 }
"#;

/// A level sheet of 0.5 m with n x n vertices, the first n of them at one edge.
fn level_sheet(n: u32) -> String {
    let at = |i: u32| 0.5 * f64::from(i) / f64::from(n - 1);
    let mut text = String::new();
    for row in 0..n {
        for column in 0..n {
            text += &format!("v {} 0 {}\n", at(row), -at(column));
        }
    }
    for row in 1..n {
        for column in 1..n {
            let corner = row * n + column + 1;
            let [back, left] = [corner - n, corner - 1];
            text += &format!("f {} {left} {corner}\nf {} {corner} {back}\n", back - 1, back - 1);
        }
    }
    text
}

const RUN: &str = "run swing.toml --executor cpu --threads 1";

fn place() -> Place {
    let place = Place::new();
    place.write("swing.toml", SWING);
    place
}

fn state(folder: &Path, step: u64) -> State {
    let path = folder.join(format!("states/step_{step:08}.ltc"));
    let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    Checkpoint::from_bytes(&bytes).expect("a state").state
}

/// `predict` of a shot of three segments of 40 steps on another machine: the clock by hand from what it says of steps.
fn is_predicted(place: &Place, run: &str) {
    let machine = |name: &str| format!("--topology {}", repository(&format!("topology/{name}.toml")).display());
    let topology = machine("dgx1_8");
    let said = place.run(&format!("predict {run} {topology} --json --kernels recorded")).expect(0).stdout;
    let found: serde_json::Value = serde_json::from_str(&said).expect("JSON");
    assert_eq!(found["steps"].as_array().map(Vec::len), Some(20), "steps that were recorded");
    let shot = &found["shot"];
    assert_eq!((&shot["segments"], &shot["workers_per_segment"]), (&3.into(), &1.into()));
    assert_eq!(shot["starts"], serde_json::json!([0, 40, 80]));
    let of = |name: &str| shot[name].as_f64().unwrap_or_else(|| panic!("no {name} in {shot}"));
    let plain_s = of("modelled_s") * of("speed_up");
    assert!((plain_s - 120.0 * of("step_modelled_s")).abs() < 1e-6 * plain_s, "{shot}");
    // How fast depends on what steps took here, but three processes are at most three times as fast as one.
    assert!(of("speed_up") > 0.0 && of("speed_up") < 3.0 && of("k") > 0.0, "{shot}");
    let text = place.run(&format!("predict {run} {topology}")).expect(0).stdout;
    assert!(text.contains("the shot, modelled: 3 segments of 1 workers"), "{text}");
    let small = place.run(&format!("predict {run} {}", machine("pcie_2"))).expect(2).stderr;
    assert!(small.contains("3 segments of 1 workers need 3 GPUs, pcie_2 has 2"), "{small}");
}

#[test]
fn a_split_shot_has_all_frames_and_the_same_bits_however_it_is_run() {
    let place = place();
    place.run(&format!("{RUN} --out plain")).expect(0);
    place.run(&format!("{RUN} --segments 1 --coarse 2 --out one")).expect(0);
    assert_eq!(place.hashes("one"), place.hashes("plain"), "one segment is a plain run");
    let split = "--segments 3 --partition uniform --handover-steps 12";
    place.run(&format!("{RUN} {split} --sessions 2 --out split")).expect(0).says(&[
        "3 segments from a coarse run",
        "Eq. 16",
        "cut at the steps [0, 40, 80]",
        "seam 2 done",
    ]);
    let hashes = place.hashes("split");
    assert_eq!(hashes.iter().map(|(frame, _)| *frame).collect::<Vec<_>>(), (0..=24).collect::<Vec<u64>>());
    assert_eq!(hashes[..=8], place.hashes("plain")[..=8], "the first segment is that of the plain run");
    assert_ne!(hashes[9..], place.hashes("plain")[9..]);
    let report = place.report("split");
    let steps: Vec<u64> =
        report["steps"].as_array().expect("steps").iter().map(|step| step["step"].as_u64().expect("a step")).collect();
    assert_eq!(steps, (1..=120).collect::<Vec<u64>>(), "every step once");
    let segments = report["segments"].as_array().expect("segments");
    assert_eq!(segments.iter().map(|one| one["first_step"].as_u64().unwrap()).collect::<Vec<_>>(), [0, 40, 80]);
    assert!(segments[1..].iter().all(|one| one["recovery_steps"] == 10 && one["handover_steps"].as_u64() > Some(1)));
    let seams = report["seams"].as_array().expect("seams");
    assert!(seams.len() == 2 && seams.iter().all(|seam| seam["met"] == true), "{seams:?}");
    assert!(
        place.path("split/frames/frame_000024.ply").exists() && place.path("split/frames/obstacle_000024.ply").exists()
    );
    assert!(place.path("split/preview/frames/frame_000024.ply").exists());
    assert!(!place.path("split/segments").exists(), "intermediate states are gone");
    is_predicted(&place, "split");
    for frame in 0..=24 {
        let bytes = std::fs::read(place.path(&format!("split/frames/frame_{frame:06}.ply"))).expect("a frame");
        let mesh = loomtree::output::ply::read(&bytes).expect("a mesh");
        let mesh = TriangleMesh { positions: mesh.positions, triangles: mesh.triangles, ..TriangleMesh::default() };
        assert_eq!(first_intersection(&mesh), None, "frame {frame}");
    }
    for other in ["--sessions 1 --workers 2", "--sessions 3 --workers 1", "--sessions 2 --workers 3"] {
        place.run(&format!("{RUN} {split} {other} --overwrite --out again")).expect(0);
        assert_eq!(place.hashes("again"), hashes, "{other}");
    }
    place.run("run --resume --out again").expect(0).says(&["nothing is left to do"]);
}

/// Asks for one step in a given way.
struct Once(Option<Way>, Option<State>);

impl Watch for Once {
    fn way(&mut self, _step: u32, _blocked: bool) -> Result<Way, String> {
        self.0.take().ok_or_else(|| "asked twice".to_string())
    }
    fn wants_events(&self, _step: u32) -> bool {
        false
    }
    fn step(&mut self, _done: StepDone) -> Next {
        Next::State
    }
    fn state(&mut self, _step: u32, state: State) -> std::ops::ControlFlow<()> {
        self.1 = Some(state);
        std::ops::ControlFlow::Continue(())
    }
}

#[test]
fn every_two_successive_states_are_one_step_apart() {
    let place = place();
    let split = "--segments 2 --partition uniform --handover-steps 12 --keep-states 1";
    place.run(&format!("{RUN} {split} --out out")).expect(0);
    let options = RunOptions { executor: ExecutorChoice::Cpu, threads: Some(1), ..RunOptions::default() };
    let level = RunPlan::new(&place.path("swing.toml"), &options).expect("a level");
    let mut session = Session::assemble(SessionPlace::ALONE, &options.session(), &Launch::Threads).expect("a session");
    session.load(&level).expect("loaded");
    let report = place.report("out");
    let segment = place.path("out/segments/001");
    let (mut guided, mut arrived) = (0, 0);
    for record in report["steps"].as_array().expect("steps").iter().skip(50).take(40) {
        let step = record["step"].as_u64().expect("a step");
        let [before, after] = [step - 1, step].map(|step| state(&place.path("out"), step));
        let positions = |step| Arc::new(state(&segment, step).positions);
        let way = if record["arrived"] == true {
            arrived += 1;
            Way::Straight(Arc::new(state(&segment, step)))
        } else if let Some(guidance) = record.get("guidance") {
            guided += 1;
            let number = |name: &str| guidance[name].as_f64().expect("a number");
            let guidance = Guidance { weight: number("weight"), distance_left: number("distance_left") };
            Way::Guided { start: positions(step - 1), end: positions(step), guidance }
        } else {
            Way::Free
        };
        session.set_state(&before, step as u32 - 1).expect("a state");
        let mut once = Once(Some(way), None);
        session.advance(step as u32, &mut once).expect("a step");
        assert_eq!(once.1.expect("a state").hash(), after.hash(), "step {step}");
    }
    assert!(guided > 2 && arrived == 1, "{guided} guided steps, {arrived} that arrived");
    session.dismiss();
}

#[test]
fn what_was_interrupted_goes_on_with_the_same_bits() {
    let place = place();
    let split = "--segments 3 --handover-steps 12 --checkpoint-every 1";
    place.run(&format!("{RUN} {split} --out straight")).expect(0);
    for (number, seen) in
        ["coarse run: frame 5/", "segment 1: frame", "segment 2 done", "seam 1 done"].iter().enumerate()
    {
        let out = format!("out{number}");
        let mut running = place.start(&format!("{RUN} {split} --sessions 2 --out {out}"));
        running.wait_for(seen, |running| running.stderr().contains(seen).then_some(()));
        signal(running.pid(), Signal::INT);
        let ended = running.wait();
        if ended.code != Some(0) {
            ended.expect(130).says(&["continue with --resume"]);
            assert_eq!(place.report(&out)["status"], "stopped");
            place.run(&format!("run --resume --out {out} --sessions 1 --workers 2")).expect(0);
        }
        assert_eq!(place.hashes(&out), place.hashes("straight"), "stopped at {seen}");
        assert_eq!(place.report(&out)["steps"].as_array().expect("steps").len(), 120);
    }
}

#[test]
fn a_killed_worker_costs_one_segment_at_most() {
    let place = place();
    let split = "--segments 3 --handover-steps 12";
    let mut running = place.start(&format!("{RUN} {split} --sessions 2 --out out"));
    running.wait_for("a segment", |running| running.stderr().contains("segment 1: frame").then_some(()));
    let worker = running.worker(0);
    signal(worker, Signal::KILL);
    let ended = running.wait().expect(1);
    let error = ended.error();
    assert!(error.contains("worker 0") && error.contains("ended unexpectedly"), "{error}");
    place.run("run --resume --out out").expect(0);
    place.run(&format!("{RUN} {split} --out straight")).expect(0);
    assert_eq!(place.hashes("out"), place.hashes("straight"));
}

#[test]
fn what_cannot_be_split_is_refused() {
    let place = place();
    place.write("grid.toml", SWING.replace("size_m = [0.5, 0.5] }", "size_m = [0.5, 0.5], mesh = \"grid\" }"));
    place.write("flag.toml", flag(20, 3, 4));
    place.write("sheet.obj", level_sheet(6));
    place.write("file.toml", SWING_OF_FILE);
    place.write("table.toml", format!("{SWING}\n[time]\nsegments = 2\ncoarse = 3\n"));
    let cases = [
        ("run grid.toml --segments 2", "the sheet has no level that is 2 times coarser"),
        ("run file.toml --segments 2", "meshes that divide the triangles of a coarser one into 16"),
        ("run table.toml", "field `time.coarse`: must be 2, 4 or 8, not 3"),
        ("run swing.toml --segments 0", "0 is not in 1..=4096"),
        ("run swing.toml --segments 2 --coarse 3", "expected 2, 4 or 8"),
        ("run swing.toml --segments 2 --coarse-steps 2", "a frame has 5 steps, which is no multiple of it"),
        ("run swing.toml --segments 2 --untangle", "--untangle and --segments do not go together"),
        ("run flag.toml --segments 2 --coarse 8", "no level that is 3 times coarser"),
    ];
    for (words, sentence) in cases {
        let error = place.run(&format!("{words} --out bad")).expect(2).stderr;
        assert!(error.contains(sentence), "{words}: {error}");
        assert!(!place.path("bad").exists(), "{words}");
    }
    place.run(&format!("{RUN} --segments 2 --frames 4 --out out")).expect(0);
    let other = place.run("run --resume --out out --segments 3").expect(2).stderr;
    assert!(other.contains("split in time in another way"), "{other}");
    let longer = place.run("run --resume --out out --frames 6").expect(2).stderr;
    assert!(longer.contains("its --frames cannot change"), "{longer}");
}

#[test]
fn true_start_states_give_the_bits_of_a_plain_run() {
    let place = place();
    place.run(&format!("{RUN} --keep-states 1 --out plain")).expect(0);
    for seam in ["cut", "hand-over"] {
        let split = format!("--segments 3 --sessions 2 --workers 2 --seam {seam} --start-states plain");
        place.run(&format!("{RUN} {split} --overwrite --out out")).expect(0);
        assert_eq!(place.hashes("out"), place.hashes("plain"), "{seam}");
    }
}

#[test]
fn segments_made_one_by_one_are_joined_to_the_same_bits() {
    let place = place();
    let split = "--segments 3 --handover-steps 12";
    place.run(&format!("{RUN} {split} --out straight")).expect(0);
    place.run(&format!("{RUN} {split} --coarse-only --out out")).expect(0).says(&["loomtree join out"]);
    place.run("join out").expect(2).says(&["of its segments 0, 1, 2 are not done"]);
    place.run("run --out out --only-segment 3").expect(2).says(&["has the segments 0 to 2"]);
    place.run("run --out out --only-segment 2 --workers 2").expect(0);
    let first = place.start("run --out out --only-segment 0");
    place.run("run --out out --only-segment 1").expect(0);
    first.wait().expect(0);
    place.run("join out").expect(0);
    assert_eq!(place.hashes("out"), place.hashes("straight"));
    assert_eq!(place.report("out")["status"], "done");
    place.run("run swing.toml --only-segment 1 --out straight").expect(0).says(&["nothing is left to do"]);
}

#[test]
fn a_point_cache_has_all_frames_of_a_split_shot() {
    let place = place();
    let run = format!("{RUN} --frames 8 --segments 2 --format pc2");
    place.run(&format!("{run} --out out")).expect(0);
    assert_eq!(loomtree::output::pc2::samples(&place.path("out/cloth.pc2")).expect("a point cache"), 9);
    assert!(!place.path("out/frames/frame_000003.ply").exists() && place.path("out/rest.obj").exists());
}

#[test]
fn without_recovery_a_seam_is_closed_as_well() {
    let place = place();
    let run = format!("{RUN} --segments 2 --partition static --recovery none --coarse 2 --out out");
    place.run(&run).expect(0);
    let report = place.report("out");
    assert_eq!((&report["segments"][1]["recovery_steps"], &report["seams"][0]["met"]), (&0.into(), &true.into()));
}

#[test]
fn detail_recovered_at_the_cut_has_the_same_bits_however_it_is_run() {
    let place = place();
    let split = "--segments 2 --partition uniform --recovery paper --recovery-steps 4";
    place.run(&format!("{RUN} {split} --seam cut --out out")).expect(0);
    assert_eq!(place.report("out")["segments"][1]["recovery_steps"], 4);
    place.run(&format!("{RUN} {split} --seam cut --workers 2 --out again")).expect(0);
    assert_eq!(place.hashes("again"), place.hashes("out"));
    // It starts elsewhere than at the refined coarse state.
    place.run(&format!("{RUN} --segments 2 --partition uniform --recovery none --seam cut --out none")).expect(0);
    assert_ne!(place.hashes("none")[13..], place.hashes("out")[13..]);
    place.run(&format!("{RUN} {split} --sessions 2 --out over")).expect(0);
    assert_eq!(place.report("over")["seams"][0]["met"], true);
}

#[test]
fn a_coarse_run_is_split_in_time_itself() {
    let place = place();
    let split = "--segments 2 --partition uniform --coarse 2 --handover-steps 12";
    place
        .run(&format!("{RUN} {split} --levels 3 --out out"))
        .expect(0)
        .says(&["the coarse run is split in time, too", "seam 1 done"]);
    let hashes = place.hashes("out");
    assert_eq!(hashes.len(), 25);
    let preview = place.report("out/preview");
    assert_eq!(preview["segments"].as_array().expect("segments").len(), 2);
    let triangles = |out: &str| place.report(out)["triangles"].as_u64().expect("a number");
    assert_eq!(triangles("out"), 4 * triangles("out/preview"));
    assert_eq!(triangles("out"), 16 * triangles("out/preview/preview"));
    assert!(!place.path("out/preview/states").exists() && !place.path("out/preview/segments").exists());
    // Stopped within the coarse run, then made on other workers.
    let mut running = place.start(&format!("{RUN} {split} --levels 3 --out again"));
    running.wait_for("a segment", |running| running.stderr().contains("segment 0: frame").then_some(()));
    signal(running.pid(), Signal::INT);
    if running.wait().code != Some(0) {
        place.run("run --resume --out again --workers 2").expect(0);
    }
    assert_eq!(place.hashes("again"), hashes);
    place.run(&format!("{RUN} --segments 2 --coarse 4 --levels 3 --out bad")).expect(2);
}

#[test]
fn after_k_sweeps_the_first_segments_are_those_of_the_plain_run() {
    let place = place();
    place.run(&format!("{RUN} --keep-states 1 --out plain")).expect(0);
    let plain = place.hashes("plain");
    let split = "--segments 3 --partition uniform --sessions 2";
    place.run(&format!("{RUN} {split} --sweeps 1 --out one")).expect(0).says(&["sweep 1 of segment 2 done"]);
    let one = place.hashes("one");
    assert_eq!(one[..=16], plain[..=16], "two segments");
    assert_ne!(one[17..], plain[17..]);
    place.run(&format!("{RUN} {split} --sweeps 2 --workers 2 --out two")).expect(0);
    assert_eq!(place.hashes("two"), plain, "all three");
    // What has not changed is not made again.
    let told = place.run(&format!("{RUN} {split} --sweeps 2 --start-states plain --out same")).expect(0).stderr;
    assert!(!told.contains("sweep") && place.hashes("same") == plain, "{told}");
}

#[test]
fn a_scene_says_how_its_mesh_is_split() {
    let place = Place::new();
    place.write("sheet.obj", level_sheet(6));
    let scene = SWING_OF_FILE.replace("mesh = \"sheet.obj\"", "mesh = \"sheet.obj\"\nsubdivide = 2");
    place.write("plain.toml", &scene);
    let table = "[time]\nsegments = 2\ncoarse = 2\npartition = \"uniform\"\nhandover_steps = 12\n";
    place.write("swing.toml", format!("{scene}\n{table}"));
    place.run(&format!("{RUN} --out out")).expect(0).says(&["2 segments from a coarse run of 200 triangles"]);
    assert_eq!(place.report("out")["triangles"], 800);
    let flags = "--segments 2 --coarse 2 --partition uniform --handover-steps 12";
    place.run(&format!("run plain.toml --executor cpu --threads 1 {flags} --out flags")).expect(0);
    assert_eq!(place.hashes("flags"), place.hashes("out"));
    // The command line counts more than the scene.
    place.run(&format!("{RUN} --segments 1 --out one")).expect(0);
    place.run("run plain.toml --executor cpu --threads 1 --out plain").expect(0);
    assert_eq!(place.hashes("one"), place.hashes("plain"));
    assert_eq!(place.hashes("out")[..=6], place.hashes("plain")[..=6]);
    // A file that holds the divided mesh already has the same coarse level.
    let fine = std::fs::read(place.path("out/frames/frame_000000.ply")).expect("a frame");
    let fine = loomtree::output::ply::read(&fine).expect("a mesh");
    let (coarse, up) = loomtree::mesh::coarser(
        &TriangleMesh {
            material_uv: loomtree::mesh::flatten_triangles(&fine.positions, &fine.triangles),
            positions: fine.positions,
            triangles: fine.triangles,
        },
        true,
    )
    .expect("a coarser mesh");
    assert_eq!((coarse.triangles.len(), up.parts), (200, 4));
}

#[test]
fn what_is_still_coarse_is_marked() {
    let place = place();
    let split = "--segments 2 --partition uniform --coarse 2 --frames 8";
    place.run(&format!("{RUN} {split} --coarse-only --out out")).expect(0);
    place.run("run --out out --only-segment 0").expect(0);
    place.run("join out").expect(2);
    let drawn = place.run("render out --size 64x48 --executor cpu").expect(0);
    assert!(drawn.stderr.contains("9 of the frames are those of the coarse run"), "{}", drawn.stderr);
    let mut running = place.start(&format!("{RUN} {split} --out again"));
    running.wait_for("a segment", |running| running.stderr().contains("segment 0 done").then_some(()));
    signal(running.pid(), Signal::INT);
    running.wait();
    // It may have been done before it heard of the stop.
    if !place.path("again/frames/frame_000008.ply").exists() {
        let drawn = place.run("render again --size 64x48 --executor cpu").expect(0);
        assert!(drawn.stderr.contains("of the frames are those of the coarse run"), "{}", drawn.stderr);
        place.run("run --resume --out again").expect(0);
    }
    let drawn = place.run("render again --size 64x48 --executor cpu").expect(0);
    assert!(!drawn.stderr.contains("coarse run"), "{}", drawn.stderr);
    let trace = std::fs::read_to_string(place.path("again/trace.json")).expect("a trace");
    let events: Vec<serde_json::Value> = serde_json::from_str(&trace).expect("JSON");
    assert!(events.iter().any(|event| event["ph"] == "X" && event["name"].as_str().unwrap().starts_with("seam 1")));
}
