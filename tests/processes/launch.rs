//! `scripts/launch.sh`: coordinator and workers started one by one do what `loomtree run` does.

use std::path::Path;

use support::process::{Place, Running, Signal, flag, repository, signal};

fn launch<'a>(place: &'a Place, words: &str, environment: &[(&str, &str)]) -> Running<'a> {
    let script = repository("scripts/launch.sh");
    let folder = Path::new(env!("CARGO_BIN_EXE_loomtree-worker")).parent().expect("a folder").to_str().expect("text");
    assert_eq!(Path::new(env!("CARGO_BIN_EXE_loomtree-coordinator")).parent(), Some(Path::new(folder)));
    let environment: Vec<(&str, &str)> = environment.iter().copied().chain([("LOOMTREE_BIN", folder)]).collect();
    place.start_program("bash", &format!("{} {words}", script.display()), &environment)
}

#[test]
fn two_workers_give_the_bits_of_loomtree_run() {
    let place = Place::new();
    let scene = repository("scenes/flag.toml");
    let flags = "--resolution 1000 --frames 2 --executor cpu";
    launch(&place, &format!("{} 2 {flags} --out by-hand", scene.display()), &[])
        .wait()
        .expect(0)
        .says(&["done: 20 steps"]);
    place.run(&format!("run {} --workers 1 {flags} --out straight", scene.display())).expect(0);
    let hashes = place.hashes("by-hand");
    assert_eq!(hashes.len(), 3);
    assert_eq!(hashes, place.hashes("straight"));
    assert_eq!(place.report("by-hand")["workers"], 2);
}

#[test]
fn ctrl_c_to_the_script_stops_the_run_with_a_checkpoint() {
    for (stop, code) in [(Signal::INT, 130), (Signal::TERM, 143)] {
        let place = Place::new();
        place.write("flag.toml", flag(500, 5, 1_000_000));
        let mut running = launch(&place, "flag.toml 3 --executor cpu --threads 1 --out out", &[]);
        running.wait_for_frame("out", 1);
        signal(running.pid(), stop);
        running.wait().expect(code).says(&["stopped; continue with --resume"]);
        assert_eq!(place.report("out")["status"], "stopped");
        place.newest_checkpoint("out");
    }
}

#[test]
fn a_killed_worker_ends_the_script_with_the_code_of_the_coordinator() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 5, 1_000_000));
    let mut running = launch(&place, "flag.toml 2 --executor cpu --threads 1 --out out", &[]);
    running.wait_for_frame("out", 1);
    let worker = running.worker(1);
    signal(worker, Signal::KILL);
    let ended = running.wait().expect(1);
    assert!(ended.error().contains(&format!("worker 1 (process {worker}) ended unexpectedly")), "{}", ended.story);
}

#[test]
fn a_rank_left_out_can_be_started_by_hand() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 2));
    let mut running = launch(&place, "flag.toml 2 --executor cpu --out out", &[("LOOMTREE_BY_HAND", "1")]);
    let command = running.wait_for("the command of rank 1", |running| {
        let stderr = running.stderr();
        let (_, rest) = stderr.split_once("start rank 1 by hand: ")?;
        rest.split_once('\n').map(|(command, _)| command.to_string())
    });
    let (program, words) = command.split_once(' ').expect("a program and words");
    let worker = place.start_program(program, words, &[]);
    running.wait().expect(0);
    worker.wait().expect(0);
    assert_eq!(place.hashes("out").len(), 3);
}

#[test]
fn bad_input_and_bad_usage() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 2));
    let ended = launch(&place, "nowhere.toml 2 --out out", &[]).wait().expect(2);
    assert!(ended.error().contains("nowhere.toml"), "{}", ended.story);
    let ended = launch(&place, "flag.toml 2 --executor cpu --schedule clockwise --out out", &[]).wait().expect(2);
    assert!(ended.error().contains("clockwise"), "{}", ended.story);
    let ended = launch(&place, "flag.toml --out out", &[]).wait().expect(2);
    assert!(ended.error().contains("usage"), "{}", ended.story);
    assert!(!place.path("out").exists());
}
