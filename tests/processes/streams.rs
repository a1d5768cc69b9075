//! Streams that nobody reads or that are full, and places for results that are not files: results to a closed pipe end
//! quietly, a full disk is a sentence, a run never ends because its progress has no reader.

use std::fs::{self, File};
use std::os::unix::fs::{FileTypeExt, symlink};
use std::process::{Command, Output, Stdio};

use support::process::{Place, Signal, flag, program, signal};

const MATRIX: &str = "%%MatrixMarket matrix coordinate real symmetric\n2 2 2\n1 1 4\n2 2 3\n";

/// A pipe whose reader has left.
fn closed_pipe() -> Stdio {
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    writer.into()
}

/// A device that is full.
fn full() -> Stdio {
    File::options().write(true).open("/dev/full").expect("/dev/full").into()
}

/// Exit code and stderr. 101 is a panic.
fn end(command: &mut Command) -> (Option<i32>, String) {
    let Output { status, stderr, .. } = command.output().expect("the program starts");
    (status.code(), String::from_utf8_lossy(&stderr).into_owned())
}

/// Commands whose result goes to stdout.
fn printing(place: &Place) -> Vec<&'static str> {
    place.write("a.mtx", MATRIX);
    place.write("flag.toml", flag(200, 2, 2));
    place.write("queries.csv", "0,1,0,1,0,1\n1,1,0,1,0,1\n0,1,1,1,0,1\n1,1,1,1,1,1\n".repeat(2));
    place.run("run flag.toml --executor cpu --out out").expect(0);
    let topology = support::process::repository("topology/pcie_4.toml");
    fs::copy(topology, place.path("pcie_4.toml")).expect("a topology");
    vec![
        "solve a.mtx --executor cpu",
        "doctor",
        "doctor --format json",
        "topology detect",
        "check flag.toml",
        "schedule pcie_4.toml",
        "schedule pcie_4.toml --format json",
        "ccd queries.csv --kind vf",
        "render out --executor cpu --size 64x48",
        "predict out --topology pcie_4.toml",
    ]
}

#[test]
fn results_to_a_reader_that_left_end_quietly() {
    let place = Place::new();
    for words in printing(&place) {
        let (code, stderr) = end(place.command(words).stdout(closed_pipe()));
        assert_eq!(code, Some(0), "{words}: {stderr}");
        assert!(!stderr.contains("error"), "{words}: {stderr}");
    }
}

#[test]
fn results_to_a_full_device_are_a_sentence() {
    let place = Place::new();
    for words in printing(&place) {
        let (code, stderr) = end(place.command(words).stdout(full()));
        assert_eq!(code, Some(1), "{words}: {stderr}");
        assert!(stderr.contains("error: cannot write the result to stdout: No space left"), "{words}: {stderr}");
    }
}

#[test]
fn the_exit_code_survives_a_lost_stderr() {
    let place = Place::new();
    for stderr in [closed_pipe(), full()] {
        let status = place.command("check nowhere.toml").stderr(stderr).status().expect("the program starts");
        assert_eq!(status.code(), Some(2));
    }
    for stderr in [closed_pipe(), full()] {
        let mut command = place.command("run --bogus");
        assert_eq!(command.stderr(stderr).status().expect("the program starts").code(), Some(2));
    }
}

#[test]
fn a_run_outlives_the_reader_of_its_progress() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 6));
    for (out, stderr) in [("closed", closed_pipe()), ("full", full())] {
        let words = format!("run flag.toml --executor cpu --workers 2 --out {out}");
        let mut command = place.command(&words);
        // The solver's and the library's own log lines go the same way.
        command.env("LOOMTREE_LOG", "loomtree=debug").stderr(stderr);
        assert_eq!(command.status().expect("the program starts").code(), Some(0));
        assert_eq!(place.report(out)["status"], "done");
        assert_eq!(place.hashes(out).len(), 7);
        assert_eq!(place.newest_checkpoint(out).1, 6);
    }
    assert_eq!(fs::read_dir(place.path("tmp")).expect("the temp folder").count(), 0);
}

/// `nohup` and everything like it asks for that before the program starts.
#[test]
fn a_hangup_that_came_ignored_stays_ignored() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 1_000_000));
    let words = format!("{} run flag.toml --executor cpu --out out", program("loomtree"));
    let mut running = place.start_program("nohup", &words, &[]);
    running.wait_for_frame("out", 1);
    signal(running.pid(), Signal::HUP);
    let frames = fs::read_dir(place.path("out/frames")).expect("frames").count() as u32;
    running.wait_for_frame("out", frames + 2);
    assert!(!running.stderr().contains("stopping"), "{}", running.stderr());
    signal(running.pid(), Signal::TERM);
    running.wait().expect(143).says(&["stopped; continue with --resume"]);
}

#[test]
fn a_run_that_a_signal_stops_says_which_by_its_exit_code() {
    for (stop, code) in [(Signal::HUP, 129), (Signal::INT, 130), (Signal::TERM, 143)] {
        let place = Place::new();
        place.write("flag.toml", flag(500, 2, 1_000_000));
        // Tests may be run with SIGHUP ignored.
        let words = format!("--default-signal=HUP {} run flag.toml --executor cpu --out out", program("loomtree"));
        let mut running = place.start_program("env", &words, &[]);
        running.wait_for_frame("out", 1);
        signal(running.pid(), stop);
        running.wait().expect(code).says(&["stopped; continue with --resume"]);
        assert_eq!(place.report("out")["status"], "stopped");
        place.newest_checkpoint("out");
    }
}

/// A file that must not grow is an error of that file, not the death of the process by SIGXFSZ.
#[test]
fn a_limit_on_file_sizes_is_a_sentence() {
    let place = Place::new();
    // Frames of 1.9 MB; the control channel needs 0.8 MB.
    place.write("flag.toml", flag(100_000, 2, 2));
    let words = "run flag.toml --executor cpu --out out";
    let limited = format!("ulimit -f 1500; exec {} {words}", program("loomtree"));
    let mut command = place.command("");
    let Output { status, stderr, .. } = Command::new("bash")
        .args(["-c", &limited])
        .envs(command.get_envs().filter_map(|(key, value)| Some((key, value?))))
        .current_dir(command.stdin(Stdio::null()).get_current_dir().expect("the place"))
        .output()
        .expect("bash starts");
    let stderr = String::from_utf8_lossy(&stderr);
    assert_eq!(status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("error: ") && stderr.contains("File too large"), "{stderr}");
}

/// What follows a name of a result must be there as it was: a link as a link, a device as a device.
#[test]
fn results_never_replace_links_devices_and_pipes() {
    let place = Place::new();
    place.write("a.mtx", MATRIX);
    place.write("flag.toml", flag(200, 2, 2));
    place.write("crossing.toml", "[[cloth]]\nsheet = { size_m = [3.0, 2.0] }\n".repeat(2));
    let topology = support::process::repository("topology/pcie_4.toml");
    fs::copy(topology, place.path("pcie_4.toml")).expect("a topology");
    for (words, code) in [
        ("solve a.mtx --executor cpu --solution", 0),
        ("schedule pcie_4.toml --svg", 0),
        ("topology detect --out", 0),
        ("check crossing.toml --write-crossings", 2),
    ] {
        // A link to a file, to a file that is not there yet, to a link.
        place.write("target", "old");
        for (link, to) in [("link", "target"), ("dangling", "new"), ("twice", "link")] {
            symlink(to, place.path(link)).expect("a link");
        }
        for link in ["link", "dangling", "twice"] {
            let (ended, stderr) = end(&mut place.command(&format!("{words} {link}")));
            assert_eq!(ended, Some(code), "{words} {link}: {stderr}");
            assert!(fs::symlink_metadata(place.path(link)).expect("the link").is_symlink(), "{words} {link}");
        }
        let text = fs::read_to_string(place.path("target")).expect("the result");
        // Measured figures differ from one call to the next; the first line does not.
        let same = |other: &str| match words.starts_with("topology") {
            true => other.lines().next() == text.lines().next(),
            false => other == text,
        };
        assert!(text != "old" && same(&fs::read_to_string(place.path("new")).expect("the result")), "{words}");
        // A pipe: its reader gets the same.
        let pipe = place.path("pipe");
        assert!(Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || fs::read_to_string(pipe).expect("what came through the pipe")
        });
        let (ended, stderr) = end(&mut place.command(&format!("{words} pipe")));
        assert_eq!(ended, Some(code), "{words} pipe: {stderr}");
        assert!(fs::symlink_metadata(&pipe).expect("the pipe").file_type().is_fifo(), "{words}");
        assert!(same(&reader.join().expect("the reader")), "{words}");
        // A device. A link to it is enough to see whether it would be replaced.
        symlink("/dev/full", place.path("device")).expect("a link");
        let (_, stderr) = end(&mut place.command(&format!("{words} device")));
        assert!(stderr.contains("No space left on device"), "{words}: {stderr}");
        assert!(fs::metadata("/dev/full").expect("the device").file_type().is_char_device());
        for name in ["link", "dangling", "twice", "target", "new", "pipe", "device"] {
            fs::remove_file(place.path(name)).expect("a file of the test");
        }
    }
}
