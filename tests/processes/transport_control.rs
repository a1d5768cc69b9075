//! The control channel: messages of all lengths both ways, heartbeats, and what each side sees when the other one dies.

use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use loomtree::transport::{
    ControlCoordinator, ControlError, ControlWorker, Heartbeat, IceoryxOptions, IceoryxTransport, RunName, Transport,
    TransportError, decode, encode, items_of,
};

/// Generous: it only turns a deadlock into a failure.
const WATCHDOG: Duration = Duration::from_secs(300);
/// Environment variable that makes a child of this test binary do a worker's or a coordinator's part.
const ROLE: &str = "LOOMTREE_TEST_ROLE";

/// Runs `test` and fails if it takes longer than the watchdog allows.
fn watched(test: impl FnOnce() + Send + 'static) {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(test));
        let _ = sender.send(result);
    });
    if let Err(panic) = receiver.recv_timeout(WATCHDOG).expect("the watchdog bit: the test hangs") {
        std::panic::resume_unwind(panic);
    }
}

fn bytes(len: usize, seed: usize) -> Vec<u8> {
    (0..len).map(|i| (i.wrapping_mul(2_654_435_761).wrapping_add(seed * 97) >> 7) as u8).collect()
}

fn receive_from(coordinator: &mut ControlCoordinator, rank: usize) -> Vec<u8> {
    loop {
        if let Some(message) = coordinator.try_receive(rank).expect("receive") {
            return message;
        }
        coordinator.wait(Duration::from_millis(50)).expect("wait");
    }
}

/// A child process of this test, killed when the test fails.
struct Process(Child);

impl Process {
    fn start(role: &str) -> Process {
        let child = Command::new(std::env::current_exe().expect("the test binary"))
            .args(["child_process", "--exact", "--nocapture", "--test-threads=1"])
            .env(ROLE, role)
            .stdout(Stdio::null())
            .spawn();
        Process(child.expect("a child process"))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Not a test of its own: the program of a child process.
#[test]
fn child_process() {
    let Ok(role) = std::env::var(ROLE) else {
        println!("skipped: only runs as a child of the other tests");
        return;
    };
    let words: Vec<&str> = role.split(' ').collect();
    let [kind, run, rank] = words[..] else { panic!("bad role '{role}'") };
    let (run, rank): (RunName, usize) = (run.parse().unwrap(), rank.parse().unwrap());
    let _member = run.join(kind).expect("the run");
    match kind {
        // Sends everything back that it gets until it gets nothing but a full stop.
        "echo" => {
            let mut worker = ControlWorker::connect(&run, rank, WATCHDOG).expect("connect");
            loop {
                let message = worker.receive(WATCHDOG).expect("receive").expect("a message");
                worker.heartbeat().progress(message.len() as u64, 3);
                worker.send(message.as_slice()).expect("send");
                if message == b"." {
                    worker.flush().expect("flush");
                    return;
                }
            }
        }
        // Keeps its heart beating for ever.
        "idle" => {
            let mut worker = ControlWorker::connect(&run, rank, WATCHDOG).expect("connect");
            let _ = worker.receive(WATCHDOG);
        }
        "coordinator" => {
            let mut coordinator = ControlCoordinator::create(&run, 1).expect("create");
            coordinator.send(0, b"last words").expect("send");
            loop {
                coordinator.wait(Duration::from_millis(50)).expect("wait");
            }
        }
        other => panic!("unknown role {other}"),
    }
}

#[test]
fn messages_of_all_lengths_go_both_ways() {
    watched(|| {
        let (run, member) = RunName::create("coordinator").unwrap();
        let mut coordinator = ControlCoordinator::create(&run, 3).unwrap();
        let mut children: Vec<Process> = (0..3).map(|rank| Process::start(&format!("echo {run} {rank}"))).collect();
        let lengths = [0, 1, 1000, 256 << 10, (256 << 10) + 1, 5_000_001, 12];
        // All at once: more than fits into any buffer, so the channel has to take turns.
        for rank in 0..3 {
            for (number, &len) in lengths.iter().enumerate() {
                coordinator.send(rank, bytes(len, number + rank)).unwrap();
            }
        }
        for rank in (0..3).rev() {
            for (number, &len) in lengths.iter().enumerate() {
                let message = receive_from(&mut coordinator, rank);
                assert!(message == bytes(len, number + rank), "rank {rank}: message {number} of {len} bytes differs");
            }
            assert!(coordinator.all_sent(rank));
            assert_eq!(coordinator.try_receive(rank).unwrap(), None);
            let heartbeat = coordinator.heartbeat(rank);
            assert_eq!((heartbeat.step, heartbeat.phase), (12, 3));
            assert_eq!(heartbeat.pid, u64::from(children[rank].0.id()));
        }
        for rank in 0..3 {
            coordinator.send(rank, b".").unwrap();
            assert_eq!(receive_from(&mut coordinator, rank), b".");
            while !coordinator.has_ended(rank) {
                coordinator.wait(Duration::from_millis(5)).unwrap();
            }
            assert!(children[rank].0.wait().unwrap().success());
        }
        assert!(matches!(coordinator.send(3, b""), Err(ControlError::NoSuchRank { rank: 3, ranks: 3 })));
        drop((coordinator, member));
        assert!(!run.root().exists() && run.shared_memory_files().is_empty());
    });
}

#[test]
fn a_message_of_64_mb() {
    watched(|| {
        let (run, _member) = RunName::create("coordinator").unwrap();
        let mut coordinator = ControlCoordinator::create(&run, 1).unwrap();
        let _child = Process::start(&format!("echo {run} 0"));
        let array = bytes(64_000_000, 5);
        let message = encode(&("positions".to_string(), 17u64), &[&array, b"tail"]).unwrap();
        let files = run.shared_memory_files();
        coordinator.send(0, message.as_slice()).unwrap();
        let back = receive_from(&mut coordinator, 0);
        assert!(back == message);
        let ((name, step), arrays) = decode::<(String, u64)>(&back).unwrap();
        assert_eq!((name.as_str(), step, arrays.len()), ("positions", 17, 2));
        assert!(arrays[0] == array && *items_of::<u8>(arrays[1]).unwrap() == *b"tail");
        let size = |files: &[(std::path::PathBuf, u64)]| files.iter().map(|file| file.1).sum::<u64>();
        let grown = size(&run.shared_memory_files()) - size(&files);
        assert!(grown < 8 << 20, "shared memory grew by {grown} bytes");
        coordinator.send(0, b".").unwrap();
        assert_eq!(receive_from(&mut coordinator, 0), b".");
    });
}

#[test]
fn the_coordinator_sees_a_worker_die() {
    watched(|| {
        let (run, _member) = RunName::create("coordinator").unwrap();
        let mut coordinator = ControlCoordinator::create(&run, 2).unwrap();
        assert_eq!(coordinator.heartbeat(0), Heartbeat::default());
        assert_eq!(coordinator.silence(0), None);
        assert!(!coordinator.has_ended(0));
        let mut child = Process::start(&format!("idle {run} 0"));
        while coordinator.heartbeat(0).counter < 5 {
            coordinator.wait(Duration::from_millis(5)).unwrap();
        }
        assert!(!coordinator.has_ended(0));
        assert!(coordinator.silence(0).is_some());
        child.0.kill().unwrap();
        while !coordinator.has_ended(0) {
            coordinator.wait(Duration::from_millis(5)).unwrap();
        }
        // Its heart stands still from now on, and sending to it still does not block.
        let last = coordinator.heartbeat(0);
        coordinator.silence(0);
        std::thread::sleep(Duration::from_millis(60));
        assert_eq!(coordinator.heartbeat(0), last);
        assert!(coordinator.silence(0).unwrap() >= Duration::from_millis(60));
        for _ in 0..10 {
            coordinator.send(0, bytes(300_000, 1)).unwrap();
        }
        assert!(!coordinator.all_sent(0));
        assert!(!coordinator.has_ended(1));
    });
}

#[test]
fn a_worker_sees_the_coordinator_die() {
    watched(|| {
        let (run, _member) = RunName::create("test").unwrap();
        let mut child = Process::start(&format!("coordinator {run} 0"));
        let mut worker = ControlWorker::connect(&run, 0, WATCHDOG).unwrap();
        assert!(!worker.coordinator_has_ended());
        child.0.kill().unwrap();
        child.0.wait().unwrap();
        assert!(worker.coordinator_has_ended());
        // What it had said before is still heard, if it had said it.
        let end = match worker.receive(WATCHDOG) {
            Ok(message) => {
                assert_eq!(message.unwrap(), b"last words");
                worker.receive(WATCHDOG).unwrap_err()
            }
            Err(error) => error,
        };
        assert!(matches!(end, ControlError::CoordinatorGone { pid } if pid == child.0.id()));
        let error = worker.send(bytes(2_000_000, 1)).unwrap_err();
        assert!(error.to_string().contains("has ended"), "{error}");
    });
}

#[test]
fn a_waiting_rank_beats_and_stops_with_the_coordinator() {
    watched(|| {
        let (run, _member) = RunName::create("test").unwrap();
        let mut child = Process::start(&format!("coordinator {run} 0"));
        let worker = ControlWorker::connect(&run, 0, WATCHDOG).unwrap();
        let heartbeat = worker.heartbeat();
        let beats = std::rc::Rc::new(std::cell::Cell::new(0));
        let counted = beats.clone();
        let on_wait = Box::new(move || {
            heartbeat.beat();
            counted.set(counted.get() + 1);
            if counted.get() == 3 {
                child.0.kill().unwrap();
            }
            worker.coordinator_has_ended()
        });
        let options = IceoryxOptions { rank: 0, ranks: 2, max_len: 1, deadline: WATCHDOG, on_wait };
        let error = IceoryxTransport::connect(&run, options).map(|transport| transport.rank()).unwrap_err();
        assert!(matches!(error, TransportError::Aborted { .. }), "{error}");
        assert!(beats.get() >= 3);
    });
}

#[test]
fn without_a_coordinator_a_worker_gives_up() {
    let (run, _member) = RunName::create("test").unwrap();
    let start = Instant::now();
    match ControlWorker::connect(&run, 0, Duration::from_millis(100)) {
        Err(ControlError::TimedOut { .. }) => assert!(start.elapsed() >= Duration::from_millis(100)),
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("connected to nobody"),
    }
}

#[test]
fn a_place_is_made_for_every_rank_and_taken_once() {
    let (run, _member) = RunName::create("test").unwrap();
    let _coordinator = ControlCoordinator::create(&run, 1).unwrap();
    let _worker = ControlWorker::connect(&run, 0, WATCHDOG).unwrap();
    let twice = ControlWorker::connect(&run, 0, WATCHDOG).err().expect("the place is taken").to_string();
    assert!(twice.contains("rank 0 is taken"), "{twice}");
    let outside = ControlWorker::connect(&run, 1, WATCHDOG).err().expect("no such place").to_string();
    assert!(outside.contains("no place for rank 1"), "{outside}");
}
