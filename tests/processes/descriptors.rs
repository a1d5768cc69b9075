//! Runs where few files may be open: they start or are refused with both numbers, at once; and the numbers are right.

use std::fs;
use std::time::{Duration, Instant};

use loomtree::transport::required_descriptors;
use support::process::{Place, flag, program};

/// Between two looks at what a process has open while it sets up.
const LOOK: Duration = Duration::from_millis(2);

#[test]
fn no_process_of_a_run_opens_more_files_than_computed() {
    for workers in [1, 2, 4, 8] {
        let place = Place::new();
        place.write("flag.toml", flag(1000, 2, 1));
        let mut running =
            place.start(&format!("run flag.toml --executor cpu --threads 1 --workers {workers} --out out"));
        let coordinator = running.pid();
        let pids: Vec<i32> = (0..workers).map(|rank| running.worker(rank)).chain([coordinator]).collect();
        let mut most = 0;
        let start = Instant::now();
        while !place.path("out/frames/frame_000000.ply").exists() && start.elapsed() < Duration::from_secs(60) {
            let open = |pid: &i32| fs::read_dir(format!("/proc/{pid}/fd")).map_or(0, |entries| entries.count() as u64);
            most = pids.iter().map(open).max().unwrap_or(0).max(most);
            std::thread::sleep(LOOK);
        }
        running.wait().expect(0);
        let computed = required_descriptors(workers);
        println!("{workers} workers: at most {most} open files, computed {computed}");
        assert!(most <= computed, "{workers} workers: {most} open files, computed {computed}");
    }
}

/// `loomtree run` in a shell with `ulimit -n`.
fn limited(place: &Place, files: u64, workers: usize) -> support::process::Ended {
    place.write("flag.toml", flag(1000, 2, 1));
    let words = format!("run flag.toml --executor cpu --threads 1 --workers {workers} --out out --overwrite");
    place.write("limited.sh", format!("ulimit -n {files}; exec {} {words}\n", program("loomtree")));
    place.start_program("bash", "limited.sh", &[]).wait()
}

#[test]
fn with_just_enough_files_a_run_starts() {
    let place = Place::new();
    limited(&place, 256, 4).expect(0);
    limited(&place, required_descriptors(8), 8).expect(0);
}

#[test]
fn with_too_few_files_a_run_is_refused_at_once() {
    for (files, workers) in [(1024, 64), (128, 4), (required_descriptors(4) - 1, 4)] {
        let place = Place::new();
        let start = Instant::now();
        let ended = limited(&place, files, workers).expect(2);
        println!("refused after {:.2} s", start.elapsed().as_secs_f64());
        let error = ended.error();
        let numbers =
            [format!("with {workers} workers"), format!("{}", required_descriptors(workers)), files.to_string()];
        for number in &numbers {
            assert!(error.contains(number.as_str()), "'{number}' is not in: {error}");
        }
        assert!(!place.path("out").exists(), "nothing is written");
    }
}

#[test]
fn the_soft_limit_is_raised() {
    let place = Place::new();
    place.write("flag.toml", flag(1000, 2, 1));
    let words = "run flag.toml --executor cpu --threads 1 --workers 4 --out out";
    place.write("limited.sh", format!("ulimit -Sn 64; exec {} {words}\n", program("loomtree")));
    place.start_program("bash", "limited.sh", &[]).wait().expect(0);
}
