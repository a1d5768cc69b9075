//! What a run does when one of its processes dies or hangs, or the simulation diverges: the sentence, the exit code, what
//! is kept, and that nothing is left on the machine (`support::process` looks after every run).

use std::time::Instant;

use support::process::{Place, Running, Signal, flag, signal};

/// A flag that never ends by itself.
fn endless(place: &Place, flags: &str) -> String {
    place.write("flag.toml", flag(1000, 2, 1_000_000));
    format!("run flag.toml --executor cpu --threads 1 --out out --checkpoint-every 2 {flags}")
}

/// After a failure: report and checkpoint are whole, and the run can be taken up from there.
fn assert_resumable(place: &Place, why: &str) {
    let status = place.report("out")["status"].as_str().expect("a status").to_string();
    assert!(status.starts_with("failed: ") && status.contains(why), "{status}");
    let (_, frame, step) = place.newest_checkpoint("out");
    assert!(frame >= 1 && step == 2 * u64::from(frame));
    let frames = frame + 2;
    place.run(&format!("run --resume --out out --workers 1 --frames {frames}")).expect(0);
    place.run(&format!("run flag.toml --executor cpu --out straight --frames {frames}")).expect(0);
    assert_eq!(place.hashes("out"), place.hashes("straight"));
}

#[test]
fn a_killed_worker_is_named_and_the_rest_stops() {
    let place = Place::new();
    let mut running = place.start(&endless(&place, "--workers 4"));
    running.wait_for_frame("out", 3);
    let worker = running.worker(2);
    let start = Instant::now();
    signal(worker, Signal::KILL);
    let ended = running.wait().expect(1);
    println!("the run ended {:.3} s after the kill", start.elapsed().as_secs_f64());
    let error = ended.error();
    assert!(error.contains(&format!("worker 2 (process {worker}) ended unexpectedly in step ")), "{error}");
    assert!(error.contains(", killed by SIGKILL (by hand") && error.contains("continue with --resume"), "{error}");
    assert_resumable(&place, "worker 2");
}

#[test]
fn a_hung_worker_is_named_and_the_rest_stops() {
    let place = Place::new();
    let mut running = place.start(&endless(&place, "--workers 4 --heartbeat 1"));
    running.wait_for_frame("out", 3);
    let worker = running.worker(1);
    let start = Instant::now();
    signal(worker, Signal::STOP);
    let ended = running.wait().expect(1);
    println!("the run ended {:.3} s after the stop, with a heartbeat of 1 s", start.elapsed().as_secs_f64());
    let error = ended.error();
    assert!(error.contains(&format!("worker 1 (process {worker}) hangs in step ")), "{error}");
    assert!(error.contains("no sign of life for 1."), "{error}");
    assert_resumable(&place, "worker 1");
}

/// Not one rank of several but the only one: nobody else could notice.
#[test]
fn a_lone_hung_worker_is_named() {
    let place = Place::new();
    let mut running = place.start(&endless(&place, "--workers 1 --heartbeat 1"));
    running.wait_for_frame("out", 1);
    let worker = running.worker(0);
    signal(worker, Signal::STOP);
    let error = running.wait().expect(1).error().to_string();
    assert!(error.contains(&format!("worker 0 (process {worker}) hangs in step ")), "{error}");
}

#[test]
fn workers_of_a_killed_coordinator_leave_and_the_last_one_cleans_up() {
    let place = Place::new();
    let mut running = place.start(&endless(&place, "--workers 3"));
    running.wait_for_frame("out", 3);
    signal(running.pid(), Signal::KILL);
    let ended = running.wait();
    assert_eq!(ended.code, None, "{}", ended.story);
    assert_eq!(
        ended.stderr.lines().filter(|line| line.contains("the coordinator (process ")).count(),
        3,
        "{}",
        ended.story
    );
    // Nothing said so, but frames and checkpoints are whole.
    assert!(place.report("out")["frames"].as_array().is_some());
    let (_, frame, _) = place.newest_checkpoint("out");
    assert!(frame >= 2);
}

#[test]
fn a_coordinator_killed_during_the_start_leaves_no_worker() {
    let place = Place::new();
    let mut running = place.start(&endless(&place, "--workers 3"));
    for rank in 0..3 {
        running.worker(rank);
    }
    // All workers run; whether they have connected yet is left to chance.
    signal(running.pid(), Signal::KILL);
    assert_eq!(running.wait().code, None);
}

/// Holds the run in the middle of a step, so that signals meet it there: stops a worker.
fn hold(running: &mut Running) -> i32 {
    let worker = running.worker(1);
    signal(worker, Signal::STOP);
    worker
}

#[test]
fn the_second_ctrl_c_leaves_at_once() {
    let place = Place::new();
    let mut running = place.start(&endless(&place, "--workers 2 --heartbeat 1000"));
    running.wait_for_frame("out", 2);
    let worker = hold(&mut running);
    signal(running.pid(), Signal::INT);
    running.wait_for("the answer to Ctrl-C", |running| {
        running.stderr().contains("stopping after the current step").then_some(())
    });
    signal(running.pid(), Signal::INT);
    running.wait_for_own_end();
    // The held worker finds itself alone.
    signal(worker, Signal::CONT);
    running.wait().expect(130);
    place.newest_checkpoint("out");
}

/// A sheet whose neighbours fly apart: the forces of the second step leave the range of f32 (collision detection would
/// refuse coordinates like these before).
const FLIES_APART: &str = r#"
    resolution = 200
    [simulation]
    collisions = false
    steps_per_frame = 1
    frames = 50
    [[cloth]]
    name = "sheet"
    sheet = { size_m = [1, 1] }
    velocity_m_s = [0, 0, 1e25]
    [[pin]]
    edge = "left"
"#;

/// No force at all; the first step leaves the range of f32. Coarse, because weights of shorter edges would take the forces
/// out of it before.
const FLIES_AWAY: &str = r#"
    [simulation]
    step_s = 100
    steps_per_frame = 1
    frames = 50
    gravity_m_s2 = [0, 0, 0]
    [[cloth]]
    sheet = { size_m = [1, 1], triangles = 2 }
    velocity_m_s = [0, 0, 1e37]
"#;

fn diverges(scene: &str, workers: usize) -> String {
    let place = Place::new();
    place.write("scene.toml", scene);
    let ended = place.run(&format!("run scene.toml --executor cpu --workers {workers} --out out")).expect(1);
    let error = ended.error().to_string();
    assert!(
        error.contains("step ") && error.contains(" of vertex ") && error.contains("likely too large: "),
        "{error}"
    );
    assert!(error.contains("is not finite") && error.contains("continue with --resume"), "{error}");
    let status = place.report("out")["status"].as_str().expect("a status").to_string();
    assert!(status.starts_with("failed: step "), "{status}");
    // Finite, which `newest_checkpoint` checks.
    place.newest_checkpoint("out");
    error
}

#[test]
fn a_diverged_run_names_step_vertex_and_field() {
    for workers in [1, 3] {
        diverges(FLIES_APART, workers);
    }
}

#[test]
fn a_state_that_is_not_finite_is_no_frame_and_no_checkpoint() {
    let error = diverges(FLIES_AWAY, 2);
    assert!(error.contains("step 1: the position of vertex ") && error.contains("simulation.step_s"), "{error}");
}

/// Two plates that close on a cloth, and on each other.
/// The plates are open surfaces: between closed ones that overlap cloth is let go.
const CRUSHED: &str = r#"
    resolution = 200
    [simulation]
    steps_per_frame = 2
    frames = 50
    thickness_m = 0.001
    [[cloth]]
    sheet = { size_m = [0.2, 0.2] }
    plane = "xz"
    origin_m = [-0.1, 0.0, 0.1]
    [[obstacle]]
    name = "upper plate"
    plane = { point_m = [0.0, 0.02, 0.0], normal = [0.0, -1.0, 0.0], size_m = [0.5, 0.5], triangles = 100 }
    motion = [ { time_s = 0.0 }, { time_s = 0.1, translate_m = [0.0, -0.03, 0.0] } ]
    [[obstacle]]
    name = "lower plate"
    plane = { point_m = [0.0, -0.02, 0.0], size_m = [0.5, 0.5], triangles = 100 }
    motion = [ { time_s = 0.0 }, { time_s = 0.1, translate_m = [0.0, 0.03, 0.0] } ]
"#;

#[test]
fn plates_that_leave_no_room_are_named_and_the_last_good_state_is_kept() {
    let mut ends = Vec::new();
    for workers in [1, 3] {
        let place = Place::new();
        place.write("crushed.toml", CRUSHED);
        let ended = place.run(&format!("run crushed.toml --executor cpu --workers {workers} --out out")).expect(1);
        let error = ended.error().to_string();
        for word in ["step ", "`upper plate`", "`lower plate`", "--resume"] {
            assert!(error.contains(word), "'{word}' is not in: {error}");
        }
        let status = place.report("out")["status"].as_str().expect("a status").to_string();
        assert!(status.starts_with("failed: step "), "{status}");
        let (path, _, step) = place.newest_checkpoint("out");
        // 40 mm of air, closed at 0.6 m/s after 67 ms; a step takes 4 ms.
        assert!((14..=16).contains(&step), "the last good state is that of step {step}: {error}");
        // Between the plates at that time, not beyond them.
        let checkpoint = loomtree::output::checkpoint::latest(path.parent().expect("a folder")).found.expect("one").1;
        let room_m = (0.02 - 0.3 * 0.004 * step as f64) as f32;
        assert!(checkpoint.state.positions.iter().all(|x| x.y.abs() < room_m), "step {step}: within {room_m} m");
        ends.push((step, error));
    }
    assert_eq!(ends[0], ends[1], "one worker and three end alike");
}
