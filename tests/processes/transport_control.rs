//! What only the control channel between processes has: bounded shared memory, places that are taken once, a start
//! without a coordinator. What every mechanism has is in `control_conformance.rs`.

use std::process::Child;
use std::time::{Duration, Instant};

use loomtree::transport::{
    ControlCoordinator, ControlError, ControlWorker, IceoryxCoordinator, IceoryxOptions, IceoryxTransport,
    IceoryxWorker, Launcher, Life, ProcessLauncher, RunName, Transport, TransportError, decode, encode, items_of,
};

use super::control_conformance::{WATCHDOG, bytes, child_command, watched};

/// A child process of this test, killed when it is dropped.
pub(crate) struct Process(Child);

impl Process {
    pub(crate) fn start(role: &str) -> Process {
        Process(child_command(role).spawn().expect("a child process"))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn receive(coordinator: &mut IceoryxCoordinator) -> Vec<u8> {
    loop {
        if let Some(message) = coordinator.try_receive(0).expect("receive") {
            return message;
        }
        coordinator.wait(Duration::from_millis(50)).expect("wait");
    }
}

#[test]
fn a_message_of_64_mb_needs_no_more_shared_memory() {
    watched(|| {
        let (run, _member) = RunName::create("coordinator").unwrap();
        let mut coordinator = IceoryxCoordinator::create(&run, 1).unwrap();
        let _child = Process::start(&format!("echo {run} 0"));
        let array = bytes(64_000_000, 5);
        let message = encode(&("positions".to_string(), 17u64), &[&array, b"tail"]).unwrap();
        let files = run.shared_memory_files();
        coordinator.send(0, message.clone()).unwrap();
        let back = receive(&mut coordinator);
        assert!(back == message);
        let ((name, step), arrays) = decode::<(String, u64)>(&back).unwrap();
        assert_eq!((name.as_str(), step, arrays.len()), ("positions", 17, 2));
        assert!(arrays[0] == array && *items_of::<u8>(arrays[1]).unwrap() == *b"tail");
        let size = |files: &[(std::path::PathBuf, u64)]| files.iter().map(|file| file.1).sum::<u64>();
        let grown = size(&run.shared_memory_files()) - size(&files);
        assert!(grown < 8 << 20, "shared memory grew by {grown} bytes");
        coordinator.send(0, b".".to_vec()).unwrap();
        assert_eq!(receive(&mut coordinator), b".");
    });
}

/// Workers that others start are named and killed like children.
#[test]
fn workers_that_others_start_are_known_by_the_run() {
    watched(|| {
        let mut launcher = ProcessLauncher::new(2, None).unwrap();
        let mut coordinator = IceoryxCoordinator::create(launcher.run(), 2).unwrap();
        launcher.start(0).unwrap();
        let child = Process::start(&format!("idle {} 0", launcher.run()));
        while coordinator.heartbeat(0).counter == 0 {
            coordinator.wait(Duration::from_millis(5)).unwrap();
        }
        assert_eq!((launcher.life(0), launcher.describe(0)), (Life::NotStarted, format!("process {}", child.0.id())));
        assert_eq!(launcher.describe(1), "unknown process");
        launcher.kill(1);
        assert!(!coordinator.has_ended(0));
        launcher.kill(0);
        while !coordinator.has_ended(0) {
            coordinator.wait(Duration::from_millis(5)).unwrap();
        }
        assert_eq!(launcher.describe(0), format!("process {}", child.0.id()));
        launcher.clean_up();
    });
}

#[test]
fn a_waiting_rank_beats_and_stops_with_the_coordinator() {
    watched(|| {
        let (run, _member) = RunName::create("test").unwrap();
        let mut child = Some(Process::start(&format!("coordinator {run} 0")));
        let worker = IceoryxWorker::connect(&run, 0, WATCHDOG).unwrap();
        let beats = std::rc::Rc::new(std::cell::Cell::new(0));
        let counted = beats.clone();
        let on_wait = Box::new(move || {
            worker.beat();
            counted.set(counted.get() + 1);
            if counted.get() == 3 {
                child.take();
            }
            worker.coordinator_has_ended()
        });
        let options = IceoryxOptions { rank: 0, ranks: 2, epoch: 0, max_len: 1, deadline: WATCHDOG, on_wait };
        let error = IceoryxTransport::connect(&run, options).map(|transport| transport.rank()).unwrap_err();
        assert!(matches!(error, TransportError::Aborted { .. }), "{error}");
        assert!(beats.get() >= 3);
    });
}

#[test]
fn without_a_coordinator_a_worker_gives_up() {
    let (run, _member) = RunName::create("test").unwrap();
    let start = Instant::now();
    match IceoryxWorker::connect(&run, 0, Duration::from_millis(100)) {
        Err(ControlError::TimedOut { .. }) => assert!(start.elapsed() >= Duration::from_millis(100)),
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("connected to nobody"),
    }
}

#[test]
fn a_place_is_made_for_every_rank_and_taken_once() {
    let (run, _member) = RunName::create("test").unwrap();
    let _coordinator = IceoryxCoordinator::create(&run, 1).unwrap();
    let _worker = IceoryxWorker::connect(&run, 0, WATCHDOG).unwrap();
    let twice = IceoryxWorker::connect(&run, 0, WATCHDOG).err().expect("the place is taken").to_string();
    assert!(twice.contains("rank 0 is taken"), "{twice}");
    let outside = IceoryxWorker::connect(&run, 1, WATCHDOG).err().expect("no such place").to_string();
    assert!(outside.contains("no place for rank 1"), "{outside}");
}
