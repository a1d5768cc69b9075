//! Jobs that are suspended and continued, and workers that compute for long: neither is a hang.

use std::time::Duration;

use loomtree::coordinator::{Crew, CrewError};
use loomtree::transport::{ControlCoordinator, ControlError, Heartbeat, Launcher, Life, OneProcess};
use support::process::{Place, Running, Signal, flag, signal};

/// A run that never ends by itself, on `workers` workers, with frames to see that it goes on.
fn endless<'a>(place: &'a Place, workers: usize) -> (Running<'a>, Vec<i32>) {
    place.write("flag.toml", flag(1000, 2, 1_000_000));
    let mut running = place.start(&format!(
        "run flag.toml --executor cpu --threads 1 --workers {workers} --heartbeat 1 --out out --format ply"
    ));
    let pids = (0..workers).map(|rank| running.worker(rank)).collect();
    running.wait_for_frame("out", 1);
    (running, pids)
}

/// Waits for two more frames.
fn goes_on(place: &Place, running: &mut Running) {
    let frames = std::fs::read_dir(place.path("out/frames")).expect("frames").count() as u32;
    running.wait_for_frame("out", frames + 2);
}

#[test]
fn a_job_that_is_stopped_and_continued_goes_on() {
    let place = Place::new();
    let (mut running, workers) = endless(&place, 4);
    for stop in 0..4 {
        // A batch system stops and continues in an order of its own: once the coordinator wakes first, once last.
        let mut all = workers.clone();
        all.insert(if stop % 2 == 0 { 0 } else { workers.len() }, running.pid());
        all.iter().for_each(|&pid| signal(pid, Signal::STOP));
        std::thread::sleep(Duration::from_millis(1700));
        for &pid in &all {
            signal(pid, Signal::CONT);
            std::thread::sleep(Duration::from_millis(50));
        }
        goes_on(&place, &mut running);
    }
    signal(running.pid(), Signal::TERM);
    running.wait().expect(143);
}

/// Ctrl-Z reaches the coordinator only: its workers have a process group of their own.
#[test]
fn a_coordinator_that_is_stopped_and_continued_goes_on() {
    let place = Place::new();
    let (mut running, _) = endless(&place, 2);
    signal(running.pid(), Signal::STOP);
    std::thread::sleep(Duration::from_millis(2500));
    signal(running.pid(), Signal::CONT);
    goes_on(&place, &mut running);
    signal(running.pid(), Signal::TERM);
    running.wait().expect(143);
}

/// Workers that have connected and then say nothing.
struct Silent;

impl ControlCoordinator for Silent {
    fn ranks(&self) -> usize {
        1
    }
    fn send(&mut self, _: usize, _: Vec<u8>) -> Result<(), ControlError> {
        Ok(())
    }
    fn all_sent(&self, _: usize) -> bool {
        true
    }
    fn try_receive(&mut self, _: usize) -> Result<Option<Vec<u8>>, ControlError> {
        Ok(None)
    }
    fn wait(&mut self, _: Duration) -> Result<(), ControlError> {
        std::thread::sleep(Duration::from_millis(5));
        Ok(())
    }
    fn heartbeat(&self, _: usize) -> Heartbeat {
        Heartbeat { counter: 1, step: 7 }
    }
    fn has_ended(&mut self, _: usize) -> bool {
        false
    }
}

/// A worker that uses processor time, or none.
struct Worker {
    computes: bool,
    start: std::time::Instant,
}

impl Launcher for Worker {
    fn start(&mut self, _: usize) -> std::io::Result<()> {
        Ok(())
    }
    fn life(&mut self, _: usize) -> Life {
        Life::Running
    }
    fn work_of(&self, _: usize) -> Option<u64> {
        Some(if self.computes { self.start.elapsed().as_millis() as u64 } else { 3 })
    }
    fn describe(&self, _: usize) -> String {
        "a worker of this test".into()
    }
    fn kill(&mut self, _: usize) {}
    fn wait(&mut self, _: usize) {}
    fn clean_up(&mut self) {}
}

/// Seconds of silence after which a worker is given up, with a limit of 0.1 s.
fn patience(computes: bool) -> f64 {
    let limit = Duration::from_millis(100);
    let worker = Worker { computes, start: std::time::Instant::now() };
    let mut crew = Crew::start(Box::new(Silent), Box::new(worker), Box::new(OneProcess), limit).expect("a crew");
    match crew.collect(limit, |_, _, _| true) {
        Err(CrewError::Hung { silence_s, .. }) => silence_s,
        other => panic!("{other:?}"),
    }
}

#[test]
fn who_computes_is_given_more_time_and_not_all_the_time() {
    let (idle, computing) = (patience(false), patience(true));
    println!("given up after {idle:.2} s idle, {computing:.2} s computing");
    assert!(idle > 0.1 && idle < computing);
    assert!(computing > 3.0);
}
