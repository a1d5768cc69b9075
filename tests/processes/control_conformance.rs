//! One suite for the control channel and the launcher of every mechanism: workers as threads of this process, and
//! workers as processes of their own, for which this test binary starts itself again.

use std::process::{Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;

use loomtree::transport::{
    ControlCoordinator, ControlError, ControlWorker, Heartbeat, IceoryxCoordinator, IceoryxWorker, Launcher, Life,
    ProcessLauncher, RunName, Silence, ThreadJob, ThreadLauncher, thread_channel, worker_role,
};

use super::transport_control::Process;

/// Generous: it only turns a deadlock into a failure.
pub(crate) const WATCHDOG: Duration = Duration::from_secs(300);
/// Environment variable that makes a child of this test binary do a worker's or a coordinator's part.
pub(crate) const ROLE: &str = "LOOMTREE_TEST_ROLE";
/// How long a silent worker gives no sign of life.
const SILENT: Duration = Duration::from_millis(400);
/// Between two looks.
const LOOK: Duration = Duration::from_millis(5);

/// Runs `test` and fails if it takes longer than the watchdog allows.
pub(crate) fn watched(test: impl FnOnce() + Send + 'static) {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(test));
        let _ = sender.send(result);
    });
    if let Err(panic) = receiver.recv_timeout(WATCHDOG).expect("the watchdog bit: the test hangs") {
        std::panic::resume_unwind(panic);
    }
}

pub(crate) fn bytes(len: usize, seed: usize) -> Vec<u8> {
    (0..len).map(|i| (i.wrapping_mul(2_654_435_761).wrapping_add(seed * 97) >> 7) as u8).collect()
}

/// What a worker does, by name, whatever it is.
fn work(program: &str, worker: &mut dyn ControlWorker) {
    match program {
        // Sends everything back that it gets until it gets nothing but a full stop.
        "echo" => loop {
            let message = worker.receive(WATCHDOG).expect("receive").expect("a message");
            worker.progress(message.len() as u64);
            worker.send(message.clone()).expect("send");
            if message == b"." {
                return worker.flush().expect("flush");
            }
        },
        // Listens until there is no coordinator.
        "idle" => while worker.receive(WATCHDOG).is_ok() {},
        "silent" => {
            std::thread::sleep(SILENT);
            while worker.receive(WATCHDOG).is_ok() {}
        }
        "speak" => {
            (0..3).for_each(|number| worker.send(bytes(300_000, number)).expect("send"));
            worker.flush().expect("flush");
        }
        "leave" => {}
        "panic" => panic!("a worker that is to panic does"),
        other => panic!("unknown program {other}"),
    }
}

/// A run with its workers not yet started.
struct Run {
    control: Box<dyn ControlCoordinator>,
    launcher: Box<dyn Launcher>,
    /// What is left of it on the machine.
    left: Box<dyn Fn() -> usize>,
}

impl Run {
    fn start_all(&mut self) {
        (0..self.control.ranks()).for_each(|rank| self.launcher.start(rank).expect("a worker starts"));
    }

    fn receive(&mut self, rank: usize) -> Vec<u8> {
        loop {
            if let Some(message) = self.control.try_receive(rank).expect("receive") {
                return message;
            }
            self.control.wait(Duration::from_millis(50)).expect("wait");
        }
    }

    fn wait_until(&mut self, mut done: impl FnMut(&mut Run) -> bool) {
        while !done(self) {
            self.control.wait(LOOK).expect("wait");
        }
    }

    /// Kills who still runs; nothing may be left.
    fn end(mut self) {
        let ranks = self.control.ranks();
        (0..ranks).for_each(|rank| self.launcher.kill(rank));
        for rank in 0..ranks {
            self.launcher.wait(rank);
            assert_ne!(self.launcher.life(rank), Life::Running);
        }
        self.launcher.clean_up();
        let Run { control, launcher, left } = self;
        drop((control, launcher));
        assert_eq!(left(), 0, "left behind");
    }
}

trait Mechanism {
    /// A run whose rank r will do `programs[r]`.
    fn run(programs: &[&'static str]) -> Run;
    /// A worker's end whose coordinator says "last words", and what ends that coordinator.
    fn orphan() -> (Box<dyn ControlWorker>, Box<dyn FnOnce()>);
}

struct Threads;

impl Mechanism for Threads {
    fn run(programs: &[&'static str]) -> Run {
        let (control, seats) = thread_channel(programs.len());
        let launcher = ThreadLauncher::new(seats, |rank| -> ThreadJob {
            let program = programs[rank];
            Box::new(move |seat| work(program, &mut seat.connect()))
        });
        Run { control: Box::new(control), launcher: Box::new(launcher), left: Box::new(|| 0) }
    }

    fn orphan() -> (Box<dyn ControlWorker>, Box<dyn FnOnce()>) {
        let (mut control, mut seats) = thread_channel(1);
        control.send(0, b"last words".to_vec()).expect("send");
        (Box::new(seats.remove(0).connect()), Box::new(move || drop(control)))
    }
}

struct Processes;

impl Mechanism for Processes {
    fn run(programs: &[&'static str]) -> Run {
        let ranks = programs.len();
        let programs = programs.to_vec();
        let command = move |run: &RunName, rank: usize| Ok(child_command(&format!("{} {run} {rank}", programs[rank])));
        let launcher = ProcessLauncher::new(ranks, Some(Box::new(command))).expect("a run");
        let run = launcher.run().clone();
        let control = IceoryxCoordinator::create(&run, ranks).expect("a channel");
        let left = move || run.shared_memory_files().len() + usize::from(run.root().exists());
        Run { control: Box::new(control), launcher: Box::new(launcher), left: Box::new(left) }
    }

    fn orphan() -> (Box<dyn ControlWorker>, Box<dyn FnOnce()>) {
        let (run, member) = RunName::create("test").expect("a run");
        let child = Process::start(&format!("coordinator {run} 0"));
        let worker = IceoryxWorker::connect(&run, 0, WATCHDOG).expect("connect");
        // Killed and reaped when it is dropped.
        (Box::new(worker), Box::new(move || drop((child, member))))
    }
}

/// This test binary as a child with `role` = what it does, run, rank.
pub(crate) fn child_command(role: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().expect("the test binary"));
    let (_, module) = module_path!().split_once("::").expect("a module of the test binary");
    command.args([&format!("{module}::child_process"), "--exact", "--nocapture", "--test-threads=1"]);
    command.env(ROLE, role).stdout(Stdio::null());
    command
}

/// Not a test of its own: the program of a child process.
#[test]
fn child_process() {
    let Ok(role) = std::env::var(ROLE) else {
        println!("skipped: only runs as a child of the other tests");
        return;
    };
    let words: Vec<&str> = role.split(' ').collect();
    let [program, run, rank] = words[..] else { panic!("bad role '{role}'") };
    let (run, rank): (RunName, usize) = (run.parse().expect("a run"), rank.parse().expect("a rank"));
    if program == "coordinator" {
        let _member = run.join(program).expect("the run");
        let mut coordinator = IceoryxCoordinator::create(&run, 1).expect("create");
        coordinator.send(0, b"last words".to_vec()).expect("send");
        loop {
            coordinator.wait(Duration::from_millis(50)).expect("wait");
        }
    }
    let _member = run.join(&worker_role(rank)).expect("the run");
    work(program, &mut IceoryxWorker::connect(&run, rank, WATCHDOG).expect("connect"));
}

fn messages_of_all_lengths_go_both_ways<M: Mechanism>() {
    let mut run = M::run(&["echo"; 3]);
    run.start_all();
    let lengths = [0, 1, 1000, 256 << 10, (256 << 10) + 1, 5_000_001, 12];
    // All at once: more than fits into any buffer of a process, so the channel has to take turns.
    for rank in 0..3 {
        for (number, &len) in lengths.iter().enumerate() {
            run.control.send(rank, bytes(len, number + rank)).expect("send");
        }
    }
    for rank in (0..3).rev() {
        for (number, &len) in lengths.iter().enumerate() {
            let message = run.receive(rank);
            assert!(message == bytes(len, number + rank), "rank {rank}: message {number} of {len} bytes differs");
        }
        assert!(run.control.all_sent(rank));
        assert_eq!(run.control.try_receive(rank).expect("receive"), None);
        assert_eq!(run.control.heartbeat(rank).step, 12);
    }
    for rank in 0..3 {
        run.control.send(rank, b".".to_vec()).expect("send");
        assert_eq!(run.receive(rank), b".");
        run.wait_until(|run| run.launcher.life(rank) == Life::Ended && run.control.has_ended(rank));
    }
    run.end();
}

fn ranks_that_do_not_exist<M: Mechanism>() {
    let mut run = M::run(&["idle"; 3]);
    assert!(matches!(run.control.send(3, Vec::new()), Err(ControlError::NoSuchRank { rank: 3, ranks: 3 })));
    assert!(matches!(run.control.try_receive(3), Err(ControlError::NoSuchRank { rank: 3, ranks: 3 })));
    assert_eq!(run.control.heartbeat(3), Heartbeat::default());
    assert!(!run.control.has_ended(3));
    run.end();
}

/// A worker is seen from before its start to its end.
fn a_life<M: Mechanism>() {
    let mut run = M::run(&["idle", "idle"]);
    assert_eq!(run.launcher.life(0), Life::NotStarted);
    assert_eq!((run.control.heartbeat(0), run.control.has_ended(0)), (Heartbeat::default(), false));
    run.launcher.start(0).expect("a worker starts");
    // It beats while it waits for a message, and more than once.
    run.wait_until(|run| run.control.heartbeat(0).counter > 5);
    assert_eq!((run.launcher.life(0), run.launcher.life(1)), (Life::Running, Life::NotStarted));
    assert!(run.launcher.describe(0).contains("process "), "{}", run.launcher.describe(0));
    assert!(!run.control.has_ended(0));
    run.launcher.kill(0);
    run.wait_until(|run| run.launcher.life(0) == Life::Ended && run.control.has_ended(0));
    run.launcher.wait(0);
    assert_eq!(run.launcher.life(0), Life::Ended);
    // Sending to it neither blocks nor fails, and its heart stands still.
    let last = run.control.heartbeat(0);
    (0..10).for_each(|seed| run.control.send(0, bytes(300_000, seed)).expect("send"));
    run.control.wait(Duration::from_millis(60)).expect("wait");
    assert!(!run.control.all_sent(0));
    assert_eq!((run.control.heartbeat(0), run.control.try_receive(0).expect("receive")), (last, None));
    run.end();
}

/// Ends that nobody asked for are noticed, and those who go on are not disturbed.
fn ends_are_noticed<M: Mechanism>() {
    let mut run = M::run(&["leave", "panic", "speak", "echo", "echo"]);
    run.start_all();
    for rank in [0, 1] {
        run.wait_until(|run| run.launcher.life(rank) == Life::Ended && run.control.has_ended(rank));
    }
    for number in 0..3 {
        assert!(run.receive(2) == bytes(300_000, number), "message {number} before the end");
    }
    run.wait_until(|run| run.launcher.life(2) == Life::Ended && run.control.has_ended(2));
    run.launcher.kill(3);
    run.wait_until(|run| run.launcher.life(3) == Life::Ended);
    run.control.send(4, bytes(1000, 1)).expect("send");
    assert_eq!(run.receive(4), bytes(1000, 1));
    assert_eq!(run.launcher.life(4), Life::Running);
    run.end();
}

fn silence_is_noticed<M: Mechanism>() {
    let mut run = M::run(&["silent"]);
    let mut silence = Silence::default();
    assert_eq!(silence.of(run.control.heartbeat(0)), None);
    run.start_all();
    run.wait_until(|run| silence.of(run.control.heartbeat(0)).is_some_and(|silence| silence >= SILENT / 2));
    assert!(run.launcher.life(0) == Life::Running && !run.control.has_ended(0));
    let last = run.control.heartbeat(0).counter;
    run.wait_until(|run| run.control.heartbeat(0).counter > last + 2);
    assert!(silence.of(run.control.heartbeat(0)).expect("it lives") < SILENT / 2);
    run.end();
}

fn a_worker_sees_its_coordinator_end<M: Mechanism>() {
    let (mut worker, end) = M::orphan();
    assert!(!worker.coordinator_has_ended());
    end();
    assert!(worker.coordinator_has_ended());
    // What it had said before is still heard, if it had said it.
    let error = match worker.receive(WATCHDOG) {
        Ok(message) => {
            assert_eq!(message.expect("the last message"), b"last words");
            worker.receive(WATCHDOG).expect_err("nobody speaks")
        }
        Err(error) => error,
    };
    assert!(matches!(error, ControlError::CoordinatorGone { .. }), "{error}");
    let error = worker.send(bytes(2_000_000, 1)).expect_err("nobody listens").to_string();
    assert!(error.contains("the coordinator (") && error.contains(") has ended"), "{error}");
}

macro_rules! suite {
    ($($case:ident,)*) => {
        mod threads {
            $(#[test] fn $case() { super::watched(super::$case::<super::Threads>); })*
        }
        mod processes {
            $(#[test] fn $case() { super::watched(super::$case::<super::Processes>); })*
        }
    };
}

suite!(
    messages_of_all_lengths_go_both_ways,
    ranks_that_do_not_exist,
    a_life,
    ends_are_noticed,
    silence_is_noticed,
    a_worker_sees_its_coordinator_end,
);
