//! `loomtree run --set FIELD=[..]`: a run for every value, a table, a sheet, and errors that name the flag.

use std::fs;

use support::process::{Place, Signal, flag, signal};

const OF: &str = "--executor cpu --workers 1 --threads 1";

#[test]
fn lists_make_runs_a_table_and_a_sheet() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 4));
    let lists = "--set simulation.friction=[0.1,0.4] --set cloth.0.fabric=[silk,denim]";
    let ended = place.run(&format!("run flag.toml {OF} {lists} --out sweep")).expect(0);
    for i in 1..=4 {
        assert_eq!(place.hashes(&format!("sweep/run_00{i}")).len(), 5);
    }
    let table = fs::read_to_string(place.path("sweep/sweep.csv")).unwrap();
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!(lines[0], "run,simulation.friction,cloth.0.fabric,status,steps,ms_per_step");
    assert!(lines[2].starts_with("run_002,0.1,denim,done,12,"), "{table}");
    assert_eq!(lines.len(), 5);
    assert!(ended.stdout.contains("run_004") && ended.stdout.contains("sweep/sweep.png"), "{}", ended.story);
    assert!(ended.stderr.contains("run 3 of 4: simulation.friction=0.4 cloth.0.fabric=silk"), "{}", ended.story);
    let sheet = fs::read(place.path("sweep/sweep.png")).unwrap();
    // Four rows of pictures 240 pixels high.
    assert_eq!(u32::from_be_bytes(sheet[20..24].try_into().unwrap()), 4 * 246 + 6);
    // Each is the run that its values alone would have made.
    let alone = "--set simulation.friction=0.4 --set cloth.0.fabric=denim --out alone";
    place.run(&format!("run flag.toml {OF} {alone}")).expect(0);
    assert_eq!(place.hashes("alone"), place.hashes("sweep/run_004"));
    assert_ne!(place.hashes("alone"), place.hashes("sweep/run_003"));
    // A second sweep is refused, or replaces the first.
    let ended = place.run(&format!("run flag.toml {OF} {lists} --out sweep")).expect(2);
    assert!(ended.error().contains("sweep/run_001 already holds a run"), "{}", ended.story);
    place.run(&format!("run flag.toml {OF} {lists} --frames 1 --out sweep --overwrite")).expect(0);
    assert_eq!(place.hashes("sweep/run_001").len(), 2);
}

#[test]
fn a_run_that_fails_does_not_end_the_sweep() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 2));
    let ended = place.run(&format!("run flag.toml {OF} --set simulation.friction=[0.2,-1,0.3] --out sweep")).expect(2);
    let sentence = "error: 1 of 3 runs failed: run_002 (simulation.friction=-1)";
    assert!(ended.stderr.lines().last().unwrap() == sentence, "{}", ended.story);
    assert!(
        ended.stderr.contains("flag.toml: --set simulation.friction=-1: field `simulation.friction`"),
        "{}",
        ended.story
    );
    assert_eq!(place.hashes("sweep/run_003").len(), 3);
    let table = fs::read_to_string(place.path("sweep/sweep.csv")).unwrap();
    assert!(table.contains("run_002,-1,refused,0,"), "{table}");
    // A vector stays one value; a list of vectors is two runs.
    place.run(&format!("run flag.toml {OF} --set air.wind_m_s=[1,0,0] --out plain")).expect(0);
    assert_eq!(place.hashes("plain").len(), 3);
    place.run(&format!("run flag.toml {OF} --set air.wind_m_s=[[1,0,0],[9,0,0]] --out winds")).expect(0);
    assert_eq!(place.hashes("plain"), place.hashes("winds/run_001"));
    for (words, sentence) in [
        (format!("run flag.toml {OF} --set simulation.friction=[]"), "the list is empty"),
        (format!("run flag.toml {OF} --set simulation.friction=[1,2] --view"), "--view is for one run"),
        ("run --resume --out sweep --set simulation.friction=[1,2]".into(), "--resume is for one run"),
    ] {
        let ended = place.run(&words).expect(2);
        assert!(ended.error().contains(sentence), "{}", ended.story);
    }
}

#[test]
fn a_signal_stops_the_run_under_way_and_the_sweep() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 2));
    let lists = "--set simulation.frames=[2,100000,3]";
    let mut running = place.start(&format!("run flag.toml {OF} {lists} --out sweep"));
    running.wait_for_frame("sweep/run_002", 2);
    signal(running.pid(), Signal::INT);
    let ended = running.wait().expect(130);
    assert!(ended.stderr.contains("stopping after the current step"), "{}", ended.story);
    let table = fs::read_to_string(place.path("sweep/sweep.csv")).unwrap();
    assert!(table.contains("run_001,2,done,6,") && table.contains("run_002,100000,stopped,"), "{table}");
    assert!(!place.path("sweep/run_003").exists() && place.path("sweep/sweep.png").exists());
    // What was stopped can go on.
    place.newest_checkpoint("sweep/run_002");
}

#[test]
fn a_wrong_field_names_its_flag_and_a_wrong_scene_its_line() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 2));
    place.write("wrong.toml", flag(256, 3, 2).replace("frames = 2", "frames = 2\nfriction = -3"));
    let more = "--set name=a --set cloth.0.friction=0.1";
    let of = |scene: &str, flag: &str| {
        let ended = place.run(&format!("run {scene} {OF} --set name=a {flag} --set cloth.0.friction=0.1 --out x"));
        ended.expect(2).error().to_string()
    };
    assert!(
        of("flag.toml", "--set simulation.step_s=0").contains(": --set simulation.step_s=0: field `simulation.step_s`")
    );
    assert!(of("flag.toml", "--set cloth.0.fabric=plaid").contains(": --set cloth.0.fabric=plaid: field "));
    assert!(
        of("wrong.toml", "").contains("wrong.toml, line 8: field `simulation.friction`"),
        "{}",
        of("wrong.toml", "")
    );
    // A split shot says the same.
    let ended =
        place.run(&format!("run flag.toml {OF} {more} --set simulation.step_s=0 --segments 2 --out x")).expect(2);
    assert!(ended.error().contains("--set simulation.step_s=0: field"), "{}", ended.story);
}
