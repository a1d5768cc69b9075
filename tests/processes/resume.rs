//! Ctrl-C and `--resume`: what was interrupted goes on with the bits of a run that never was, on any number of workers.

use std::fs;

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
