//! `loomtree run --live`: changes while a run goes on, on any number of workers, recorded and made again by `--resume`,
//! `--replay` and a saved scene; requests that are wrong; clients that are rude; the socket.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixStream;

use loomtree::coordinator::live::connect;
use serde_json::{Value, json};
use support::process::{Place, Running, Signal, signal};

/// Two sheets over a ball, one held by two pins.
const SCENE: &str = r#"
name = "steered"
resolution = 400
[simulation]
step_s = 0.005
steps_per_frame = 3
frames = 12
[[cloth]]
name = "flag"
sheet = { size_m = [0.6, 0.4] }
fabric = "cotton"
[[cloth]]
name = "patch"
sheet = { size_m = [0.2, 0.2] }
origin_m = [0.2, 0.1, 0.05]
fabric = "silk"
[[pin]]
name = "left"
cloth = "flag"
corners = ["top-left"]
[[pin]]
cloth = "flag"
corners = ["top-right"]
[[obstacle]]
name = "ball"
sphere = { center_m = [0.3, -0.2, 0.0], radius_m = 0.1 }
"#;

/// A client of the run in `out`.
struct Client {
    stream: UnixStream,
    answers: BufReader<UnixStream>,
}

impl Client {
    fn new(place: &Place, running: &mut Running, out: &str) -> Client {
        let stream = running.wait_for("the socket", |_| connect(&place.path(out)).ok());
        let answers = BufReader::new(stream.try_clone().expect("a second end"));
        Client { stream, answers }
    }

    fn line(&mut self, line: &str) -> Value {
        self.stream.write_all(format!("{line}\n").as_bytes()).expect("a request");
        let mut answer = String::new();
        self.answers.read_line(&mut answer).expect("an answer");
        serde_json::from_str(&answer).unwrap_or_else(|error| panic!("{line}: {answer}: {error}"))
    }

    /// The step that the answer names.
    fn ask(&mut self, request: Value) -> u64 {
        let answer = self.line(&request.to_string());
        assert_eq!(answer["ok"], true, "{request}: {answer}");
        answer["step"].as_u64().expect("a step")
    }

    fn refused(&mut self, line: &str) -> String {
        let answer = self.line(line);
        answer["error"].as_str().unwrap_or_else(|| panic!("{line}: {answer}")).to_string()
    }
}

/// Changes of every kind that keeps the mesh, at steps of their own; the run then goes on.
fn steer(client: &mut Client) {
    assert_eq!(client.ask(json!({ "do": "gravity", "gravity_m_s2": [0, -4, 0.5] })), 0);
    assert_eq!(client.ask(json!({ "do": "step", "steps": 4 })), 4);
    assert_eq!(client.ask(json!({ "do": "wind", "wind_m_s": [2, 0, 3.1], "air_drag_kg_m2_s": 0.01 })), 4);
    assert_eq!(client.ask(json!({ "do": "unpin", "pin": "left" })), 4);
    assert_eq!(client.ask(json!({ "do": "step", "steps": 5 })), 9);
    assert_eq!(client.ask(json!({ "do": "friction", "friction": 0.05, "obstacle": "ball" })), 9);
    assert_eq!(client.ask(json!({ "do": "fabric", "cloth": "patch", "fabric": "denim", "damping_s": 0.001 })), 9);
    assert_eq!(client.ask(json!({ "do": "step" })), 10);
    assert_eq!(client.ask(json!({ "do": "gravity", "gravity_m_s2": [0, -9.81, 0] })), 10);
}

#[test]
fn changes_are_made_again_with_the_same_bits_on_any_number_of_workers() {
    let place = Place::new();
    place.write("scene.toml", SCENE);
    place.run("run scene.toml --executor cpu --out plain").expect(0);
    let mut running = place.start("run scene.toml --executor cpu --workers 2 --live --paused --out out");
    let mut client = Client::new(&place, &mut running, "out");
    let mode = fs::metadata(place.path("out/live.sock")).expect("the socket").permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    steer(&mut client);
    client.ask(json!({ "do": "save", "file": "saved.toml" }));
    let status = client.line(r#"{"do":"status"}"#);
    assert_eq!((&status["state"], &status["step"], &status["frame"]), (&"paused".into(), &10.into(), &3.into()));
    assert_eq!((&status["pins"][0]["name"], &status["cloths"][1]["fabric"]), (&"1".into(), &"denim".into()));
    client.ask(json!({ "do": "continue" }));
    running.wait().expect(0).says(&["after step 4: unpin"]);
    assert!(!place.path("out/live.sock").exists());
    let hashes = place.hashes("out");
    let plain = place.hashes("plain");
    assert_eq!((hashes.len(), &hashes[0]), (13, &plain[0]));
    assert!((1..13).all(|frame| hashes[frame].1 != plain[frame].1), "every frame feels the first change");
    // From the start, on other numbers of workers, from the record and from the saved scene.
    for workers in [1, 3, 8] {
        let out = format!("by{workers}");
        let replay =
            format!("run scene.toml --executor cpu --workers {workers} --replay out/run_changes.toml --out {out}");
        place.run(&replay).expect(0);
        assert_eq!(place.hashes(&out), hashes, "{workers} workers");
    }
    place.run("run out/saved.toml --executor cpu --workers 2 --out saved").expect(0);
    assert_eq!(place.hashes("saved"), hashes);
    // Resumed from before, between and after the changes. A live run may go on without a socket, and with one.
    for (frames, more) in [(1, ""), (2, "--live"), (3, ""), (5, "")] {
        let out = format!("stopped{frames}");
        let start = format!("run scene.toml --executor cpu --workers 3 --frames {frames}");
        place.run(&format!("{start} --replay out/run_changes.toml --out {out}")).expect(0);
        place.run(&format!("run --resume --out {out} --workers 2 --frames 12 {more}")).expect(0);
        assert_eq!(place.hashes(&out), hashes, "after frame {frames}");
        place.run(&format!("run --resume --out {out} --workers 1 --frames 13")).expect(0);
        assert_eq!(place.hashes(&out)[..13], hashes, "once more");
    }
}

#[test]
fn a_command_waits_for_a_run_that_begins() {
    let place = Place::new();
    place.write("scene.toml", SCENE);
    let answered = std::thread::scope(|scope| {
        let asked = scope.spawn(|| place.run("live out stop"));
        std::thread::sleep(std::time::Duration::from_millis(200));
        place.run("run scene.toml --executor cpu --live --paused --out out").expect(0);
        asked.join().expect("an answer")
    });
    assert!(answered.expect(0).stdout.contains("\"ok\":true"));
}

#[test]
fn a_killed_run_loses_no_change() {
    let place = Place::new();
    place.write("scene.toml", SCENE);
    let start = "run scene.toml --executor cpu --workers 2 --checkpoint-every 1 --live --paused --out out";
    let mut running = place.start(start);
    let mut client = Client::new(&place, &mut running, "out");
    steer(&mut client);
    signal(running.pid(), Signal::KILL);
    running.wait();
    assert!(place.path("out/live.sock").exists(), "nobody could remove it");
    let ended = place.run("live out status").expect(2);
    assert!(ended.error().contains("no live run listens in out"), "{}", ended.story);
    place.run("run --resume --out out --workers 4").expect(0);
    assert!(!place.path("out/live.sock").exists());
    place.run("run scene.toml --executor cpu --replay out/run_changes.toml --out again").expect(0);
    assert_eq!(place.hashes("out"), place.hashes("again"));
    assert_eq!(place.hashes("out").len(), 13);
}

#[test]
fn ctrl_c_and_stop_end_a_run_that_stands_still() {
    let place = Place::new();
    place.write("scene.toml", SCENE);
    let mut running = place.start("run scene.toml --executor cpu --live --paused --out out");
    Client::new(&place, &mut running, "out").ask(json!({ "do": "step", "steps": 4 }));
    signal(running.pid(), Signal::INT);
    running.wait().expect(130).says(&["stopped; continue with --resume"]);
    assert!(!place.path("out/live.sock").exists());
    assert_eq!((place.report("out")["status"].as_str(), place.newest_checkpoint("out").2), (Some("stopped"), 4));
    let mut running = place.start("run --resume --out out --live --paused");
    let mut client = Client::new(&place, &mut running, "out");
    assert_eq!(client.ask(json!({ "do": "step", "steps": 2 })), 6);
    assert_eq!(client.ask(json!({ "do": "stop" })), 6);
    running.wait().expect(0).says(&["stopped; continue with --resume"]);
    assert!(!place.path("out/live.sock").exists());
    place.run("run --resume --out out").expect(0);
    place.run("run scene.toml --executor cpu --out plain").expect(0);
    assert_eq!(place.hashes("out"), place.hashes("plain"), "nothing was changed");
}

#[test]
fn wrong_requests_are_answered_and_change_nothing() {
    let place = Place::new();
    place.write("scene.toml", SCENE);
    let mut running = place.start("run scene.toml --executor cpu --live --paused --out out");
    let mut client = Client::new(&place, &mut running, "out");
    for (line, sentence) in [
        ("hello", "this is not JSON"),
        ("[]", "a request is a JSON object"),
        (r#"{"do":"dance"}"#, "field `change.do`: must be one of gravity, wind"),
        (r#"{"do":"gravity"}"#, "field `change.gravity_m_s2`: is missing"),
        (r#"{"do":"gravity","gravity_m_s2":[0,0,1e99]}"#, "must be a finite number"),
        (r#"{"do":"gravity","gravity_m_s2":[0,0,1],"wind_m_s":[0,0,1]}"#, "does not belong to `gravity`"),
        (r#"{"do":"friction","friction":-0.1}"#, "must be a number of at least 0"),
        (r#"{"do":"friction","friction":0.1,"cloth":"sail"}"#, "no cloth is named `sail` (flag, patch)"),
        (r#"{"do":"friction","friction":0.1,"obstacle":"box"}"#, "no obstacle is named `box` (ball)"),
        (r#"{"do":"fabric","fabric":"steel"}"#, "`steel` is no known fabric"),
        (r#"{"do":"fabric","density_kg_m2":0}"#, "must be a number above 0"),
        (r#"{"do":"unpin","pin":"right"}"#, "no pin is named `right` (left, 1)"),
        (r#"{"do":"step","steps":0}"#, "must be a whole number from 1"),
        (r#"{"do":"save","file":"scene.txt"}"#, "ends in .toml"),
    ] {
        let error = client.refused(line);
        assert!(error.contains(sentence), "{line}: {error}");
    }
    client.stream.write_all(b"\xff\xfe{}\n").expect("bytes");
    assert!(client.refused("").contains("not UTF-8"));
    // The shell's client says the same with exit code 2.
    let shell = |words: &str| place.command(words).output().expect("a client");
    let ended = shell("live out pin right off");
    assert_eq!(ended.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&ended.stderr).contains("error: no pin is named `right`"));
    assert_eq!(shell("live out wind 1,2").status.code(), Some(2));
    assert_eq!(String::from_utf8_lossy(&shell("live out step 2").stdout).trim(), r#"{"ok":true,"step":2}"#);
    client.ask(json!({ "do": "continue" }));
    running.wait().expect(0);
    place.run("run scene.toml --executor cpu --out plain").expect(0);
    assert_eq!(place.hashes("out"), place.hashes("plain"));
    place.write("bad.toml", "[[change]]\nstep = 3\ndo = \"unpin\"\npin = \"right\"\n");
    let ended = place.run("run scene.toml --executor cpu --replay bad.toml --out refused").expect(2);
    assert!(ended.error().contains("the change `unpin` of step 3 cannot be made: no pin is named `right`"));
    place.write("scene_bad.toml", format!("{SCENE}[[change]]\nstep = 3\ndo = \"wind\"\nwind_m_s = [0, 1]\n"));
    let ended = place.run("run scene_bad.toml --executor cpu --out refused").expect(2);
    let field = "field `change.wind_m_s`: must be an array of 3 numbers";
    assert!(ended.error().contains("scene_bad.toml, line") && ended.error().contains(field), "{}", ended.story);
    for (flags, word) in [
        ("--live --segments 2", "not a shot that is split"),
        ("--live --format pc2", "--format pc2 holds one mesh"),
        ("--paused", "--live"),
        ("--replay nowhere.toml", "nowhere.toml: cannot be read"),
    ] {
        let ended = place.run(&format!("run scene.toml --executor cpu --out refused {flags}")).expect(2);
        assert!(ended.stderr.contains(word), "{}", ended.story);
    }
    assert!(!place.path("refused").exists());
}

#[test]
fn rude_clients_hold_nobody_up() {
    let place = Place::new();
    // A folder whose socket would have too long a name.
    let out = format!("{}/out", "long".repeat(40));
    fs::create_dir_all(place.path(&out)).expect("a folder");
    place.write("scene.toml", SCENE);
    let mut running = place.start(&format!("run scene.toml --executor cpu --live --paused --out {out}"));
    let mut client = Client::new(&place, &mut running, &out);
    // One goes in the middle of a line, one while it waits for an answer.
    let mut gone = Client::new(&place, &mut running, &out);
    gone.stream.write_all(b"{\"do\":\"pau").expect("half a request");
    drop(gone);
    let mut gone = Client::new(&place, &mut running, &out);
    gone.stream.write_all(b"{\"do\":\"step\",\"steps\":5}\n{\"do\":\"unpin\",\"pin\":\"left\"}\n").expect("requests");
    drop(gone);
    // One asks and never reads.
    let mut deaf = Client::new(&place, &mut running, &out);
    deaf.stream.set_nonblocking(true).expect("a stream");
    while deaf.stream.write(b"{\"do\":\"status\"}\n").is_ok() {}
    running.wait_for("step 5", |_| (client.line(r#"{"do":"status"}"#)["step"] == 5).then_some(()));
    client.ask(json!({ "do": "continue" }));
    running.wait().expect(0);
    assert_eq!(place.hashes(&out).len(), 13);
    assert!(!place.path(&out).join("live.sock").exists());
    drop(deaf);
}

/// Two panels of different counts that face each other, without a seam.
const PANELS: &str = r#"
name = "panels"
[simulation]
step_s = 0.005
steps_per_frame = 4
frames = 24
thickness_m = 0.001
gravity_m_s2 = [0, 0, 0]
[air]
drag_kg_m2_s = 0.05
[[cloth]]
name = "front"
sheet = { size_m = [0.2, 0.16], triangles = 100 }
origin_m = [0, 0, 0.02]
[[cloth]]
name = "back"
sheet = { size_m = [0.2, 0.16], triangles = 60 }
rotate_deg = [180, 0, 1, 0]
origin_m = [0.2, 0, -0.02]
[[pin]]
cloth = "front"
corners = ["top-left"]
"#;

/// Interactive stitching: seams are added and taken out, welded by the run, the cloth is refined and sewn once more.
#[test]
fn seams_that_are_sewn_by_hand_are_sewn_again_with_the_same_bits() {
    let place = Place::new();
    place.write("panels.toml", PANELS);
    let mut running = place.start("run panels.toml --executor cpu --workers 2 --live --paused --out out");
    let mut client = Client::new(&place, &mut running, "out");
    let seam = |name: &str, front: &str, back: &str| {
        let side = |cloth: &str, edge: &str| json!({ "cloth": cloth, "edge": edge });
        json!({ "do": "sew", "name": name, "a": side("front", front), "b": side("back", back), "close_s": 0.1 })
    };
    for (request, sentence) in [
        (seam("x", "left", "middle"), "`back` has no edge named `middle` (left, right, bottom, top)"),
        (json!({ "do": "sew", "a": "left", "b": "top" }), "several cloths have an edge named `left`"),
        (
            json!({ "do": "sew", "a": { "frame_vertices": [0, 1] }, "b": { "frame_vertices": [0, 1] } }),
            "sewn onto itself",
        ),
        (
            json!({ "do": "sew", "a": { "frame_vertices": [0] }, "b": { "frame_vertices": [9, 3] } }),
            "at least 2 vertices",
        ),
        (json!({ "do": "sew", "pairs": [[0, 1]] }), "a seam must say which"),
        (json!({ "do": "unsew", "name": "x" }), "no seam is open"),
    ] {
        let error = client.refused(&request.to_string());
        assert!(error.contains(sentence), "{request}: {error}");
    }
    client.ask(seam("one side", "left", "right"));
    client.ask(json!({ "do": "step", "steps": 3 }));
    client.ask(seam("other side", "right", "left"));
    client.ask(seam("top", "top", "top"));
    let again = client.refused(&seam("top", "bottom", "bottom").to_string());
    assert!(again.contains("a seam is named `top` already"), "{again}");
    let twice = client.refused(&seam("twice", "left", "right").to_string());
    assert!(twice.contains("is in two seams, `one side` and `twice`"), "{twice}");
    client.ask(json!({ "do": "step", "steps": 4 }));
    client.ask(json!({ "do": "unsew", "name": "top" }));
    let open = client.refused(r#"{"do":"refine"}"#);
    assert!(open.contains("seams are open"), "{open}");
    // Until the run has welded them, which it does at a frame.
    let status = loop {
        client.ask(json!({ "do": "step" }));
        let status = client.line(r#"{"do":"status"}"#);
        if status["seams"].as_array().expect("seams").is_empty() {
            break status;
        }
        assert!(status["step"].as_u64() < Some(70), "the seams do not close");
    };
    let (step, triangles) = (status["step"].as_u64().unwrap(), status["triangles"].as_u64().unwrap());
    client.ask(json!({ "do": "refine" }));
    client.ask(json!({ "do": "gravity", "gravity_m_s2": [0, -2, 0] }));
    client.ask(seam("top", "top", "top"));
    assert_eq!(client.line(r#"{"do":"status"}"#)["triangles"], 4 * triangles);
    client.ask(json!({ "do": "save", "file": "saved.toml" }));
    client.ask(json!({ "do": "continue" }));
    running.wait().expect(0).says(&["the seams are closed after step", "the triangles are divided after step"]);
    let (hashes, report) = (place.hashes("out"), place.report("out"));
    let stages = report["stages"].as_array().expect("stages");
    assert_eq!(stages.last().expect("a stage")["triangles"], 4 * triangles);
    assert!(stages.iter().any(|stage| stage["step"] == step || stage["step"] == step - 1), "{step}: {stages:?}");
    for workers in [1, 3, 8] {
        let out = format!("by{workers}");
        let flags = format!("--executor cpu --workers {workers} --replay out/run_changes.toml --out {out}");
        place.run(&format!("run panels.toml {flags}")).expect(0);
        assert_eq!(place.hashes(&out), hashes, "{workers} workers");
        assert_eq!(place.report(&out)["stages"], report["stages"], "{workers} workers");
    }
    place.run("run out/saved.toml --executor cpu --workers 2 --out saved").expect(0);
    assert_eq!(place.hashes("saved"), hashes);
    let welded = step / 4;
    for (i, frames) in [1, 2, welded, welded + 1, welded + 3].into_iter().enumerate() {
        let out = format!("stopped{i}");
        let from = if i % 2 == 0 { "panels.toml --replay out/run_changes.toml" } else { "out/saved.toml" };
        place.run(&format!("run {from} --executor cpu --workers 2 --frames {frames} --out {out}")).expect(0);
        place.run(&format!("run --resume --out {out} --workers {} --frames 24", 1 + i)).expect(0);
        assert_eq!(place.hashes(&out), hashes, "after frame {frames}");
        assert_eq!(place.report(&out)["stages"], report["stages"], "after frame {frames}");
    }
    // Frames of every mesh can be read again.
    place.run("compare out by3").expect(0);
    place.run("render out --size 64x64").expect(0);
}
