//! Runs that share a machine: other temp folders, little shared memory, stops before the first step.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

use support::process::{Place, Signal, flag, program, repository, signal};

/// The folder of a run is not seen under another TMPDIR, but its lock is.
#[test]
fn doctor_leaves_a_living_run_with_another_temp_folder_alone() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 1_000_000));
    fs::create_dir(place.path("elsewhere")).expect("a folder");
    let mut running = place.start("run flag.toml --executor cpu --workers 2 --out out");
    let doctor = |words: &str| {
        let mut command = place.command(words);
        let output = command.env("TMPDIR", place.path("elsewhere")).output().expect("the program starts");
        assert!(output.status.success());
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    // While it sets up, and while it runs.
    for frame in [0, 2] {
        if frame > 0 {
            running.wait_for_frame("out", frame);
        }
        doctor("doctor --clean");
    }
    let run = fs::read_dir(place.path("tmp")).expect("the temp folder").flatten().next().expect("a run").file_name();
    let id = run.to_string_lossy().trim_start_matches("loomtree-").to_string();
    let line = doctor("doctor").lines().find(|line| line.contains(&id)).expect("the run is listed").to_string();
    assert!(line.contains("running"), "{line}");
    running.wait_for_frame("out", 4);
    signal(running.pid(), Signal::TERM);
    running.wait().expect(143);
}

#[test]
fn the_next_run_removes_what_a_killed_coordinator_left() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 1));
    // It waits for workers that nobody starts: nobody but it is there to clean up.
    let mut running = place.start("coordinator flag.toml --workers 2 --executor cpu --out out");
    let locks: [PathBuf; 2] = running.wait_for("its locks", |_| {
        let folder = fs::read_dir(place.path("tmp")).ok()?.flatten().next()?;
        let id = folder.file_name().to_string_lossy().trim_start_matches("loomtree-").to_string();
        let locks = [folder.path().join("lock"), format!("/dev/shm/lt{id}_lock").into()];
        locks.iter().all(|lock| lock.exists()).then_some(locks)
    });
    signal(running.pid(), Signal::KILL);
    running.wait_for_own_end();
    // What is younger than a minute is left alone.
    for lock in locks {
        let made = std::time::SystemTime::now() - std::time::Duration::from_secs(120);
        fs::File::options().write(true).open(lock).and_then(|lock| lock.set_modified(made)).expect("an older lock");
    }
    place.run("run flag.toml --executor cpu --out other").expect(0);
    running.wait();
}

#[test]
fn a_stop_is_heard_before_the_first_step() {
    for (stop, code) in [(Signal::TERM, 143), (Signal::INT, 130)] {
        let place = Place::new();
        place.write("flag.toml", flag(500, 2, 1));
        let mut running = place.start("coordinator flag.toml --workers 2 --executor cpu --out out");
        running.wait_for("its run", |_| fs::read_dir(place.path("tmp")).ok()?.next().map(|_| ()));
        signal(running.pid(), stop);
        running.wait().expect(code).says(&["stopped by SIG", "before the first step"]);
        assert!(!place.path("out").exists());
    }
}

/// Many runs at once where the shared memory is small: each ends or is refused with a sentence, none dies of SIGBUS.
#[test]
fn runs_that_do_not_fit_together_are_refused_and_leave_nothing() {
    let may = Command::new("unshare").args(["-m", "true"]).status();
    if !may.is_ok_and(|status| status.success()) {
        println!("skipped: this test needs the right to mount (root)");
        return;
    }
    let place = Place::new();
    place.write("flag.toml", flag(2500, 2, 2));
    let binary = program("loomtree");
    place.write(
        "many.sh",
        format!(
            "mount -t tmpfs -o size=12m tmpfs /dev/shm || exit 9\n\
             for k in 1 2 3 4 5 6; do {binary} run flag.toml --executor cpu --threads 1 --workers 4 --out out$k 2>log$k & pids=\"$pids $!\"; done\n\
             for pid in $pids; do wait $pid; echo $?; done\n\
             ls /dev/shm | wc -l\n"
        ),
    );
    let ended = place.start_program("unshare", "-m bash many.sh", &[]).wait().expect(0);
    let lines: Vec<&str> = ended.stdout.lines().collect();
    println!("exit codes, files left: {lines:?}");
    let (left, codes) = lines.split_last().expect("lines");
    assert_eq!(*left, "0", "files in /dev/shm\n{}", ended.story);
    assert_eq!(codes.len(), 6);
    assert!(codes.contains(&"0"), "one fits\n{}", ended.story);
    for (k, code) in (1..).zip(codes) {
        let log = fs::read_to_string(place.path(&format!("log{k}"))).expect("a log");
        let refused = log.contains("/dev/shm has") && log.contains("this run needs");
        assert!(*code == "0" || ["1", "2"].contains(code) && refused, "run {k}: {code}\n{log}");
    }
}

/// What the machine lacks is in the sentence, whatever name iceoryx2 has for it.
#[test]
fn a_folder_that_takes_no_more_files_is_named() {
    let may = Command::new("unshare").args(["-m", "true"]).status();
    if !may.is_ok_and(|status| status.success()) {
        println!("skipped: this test needs the right to mount (root)");
        return;
    }
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 2));
    let binary = program("loomtree");
    let run = format!("{binary} run flag.toml --executor cpu --workers 2 --out out");
    place.write(
        "few.sh",
        format!(
            "mount -t tmpfs -o size=64m,nr_inodes=12 tmpfs /dev/shm || exit 9\n\
             {run}; echo $?; ls /dev/shm | wc -l\n\
             mount -o remount,ro,nr_inodes=0 /dev/shm || mount -o remount,ro /dev/shm || exit 9\n\
             {run}; echo $?; {binary} doctor | grep 'shared memory  '\n"
        ),
    );
    let ended = place.start_program("unshare", "-m bash few.sh", &[]).wait().expect(0);
    let lines: Vec<&str> = ended.stdout.lines().collect();
    assert_eq!(lines[..3], ["1", "0", "1"], "{}", ended.story);
    assert!(lines[3].ends_with("it is read-only, so no run can start"), "{}", ended.story);
    ended.says(&["more files only (df -i /dev/shm)", "Read-only file system"]);
}

#[test]
fn a_temp_folder_that_is_not_there_is_a_sentence() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 1));
    let mut command = place.command("run flag.toml --executor cpu --workers 2 --out out");
    let output = command.env("TMPDIR", "/nowhere/at/all").output().expect("the program starts");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("error: cannot create /nowhere/at/all/loomtree-") && stderr.contains("No such file"));
}

#[test]
fn a_temp_folder_with_letters_beyond_ascii_works() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 1));
    fs::create_dir(place.path("gr\u{fc}n")).expect("a folder");
    let mut command = place.command("run flag.toml --executor cpu --workers 2 --out out");
    let output = command.env("TMPDIR", place.path("gr\u{fc}n")).output().expect("the program starts");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
}

/// The matrix comes through a pipe, which can be read once.
#[test]
fn solve_reads_a_matrix_from_a_pipe() {
    let place = Place::new();
    place.write("a.mtx", "%%MatrixMarket matrix coordinate real symmetric\n2 2 2\n1 1 4\n2 2 3\n");
    let binary = program("loomtree");
    place.write("pipe.sh", format!("cat a.mtx | {binary} solve /dev/stdin --executor cpu\n"));
    let ended = place.start_program("bash", "pipe.sh", &[]).wait().expect(0);
    assert!(ended.stdout.contains("\"converged\": true"), "{}", ended.story);
}

#[test]
fn a_worker_killed_in_a_solve_is_named_with_its_signal() {
    let place = Place::new();
    let matrix = (1..=3000).map(|row| format!("{row} {row} 2\n")).collect::<String>();
    place.write("a.mtx", format!("%%MatrixMarket matrix coordinate real symmetric\n3000 3000 3000\n{matrix}"));
    let mut running = place.start("solve a.mtx --executor cpu --workers 2 --repeat 10000 --rtol 1e-9");
    let worker = running.worker(1);
    // The sentence tells set-up and solve apart, so the signal must come late enough: a worker computes by then.
    std::thread::sleep(std::time::Duration::from_millis(1500));
    signal(worker, Signal::KILL);
    let ended = running.wait().expect(1);
    let error = ended.error();
    assert!(error.contains(&format!("worker 1 (process {worker}) ended unexpectedly while solving")), "{error}");
    assert!(error.contains("killed by SIGKILL (by hand, or by the system because memory ran out)"), "{error}");
}

#[test]
fn a_scene_whose_name_run_toml_cannot_hold_is_refused() {
    use std::os::unix::ffi::OsStrExt;
    let place = Place::new();
    let name = std::ffi::OsStr::from_bytes(b"sc\xe9ne.toml");
    fs::copy(repository("scenes/flag.toml"), place.path("").join(name)).expect("a scene");
    let output = place.command("run").arg(name).args(["--out", "out"]).output().expect("the program starts");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("not UTF-8") && !place.path("out").exists(), "{stderr}");
}
