//! Groups of ranks for tests of transports: threads of one process, emulated links on top of them, iceoryx2 (each rank
//! on its own thread here; `transport_processes.rs` uses real processes).

use std::sync::mpsc;
use std::time::Duration;

use loomtree::interconnect::{RankLinks, ScheduleKind, Topology, Traffic, plan};
use loomtree::transport::{
    EmulatedTransport, IceoryxOptions, IceoryxTransport, InProcessTransport, RunName, Transport,
};

/// Most values of a message in these tests.
pub(crate) const MAX_LEN: usize = 5000;
/// Generous: it only turns a deadlock into a failure.
pub(crate) const WATCHDOG: Duration = Duration::from_secs(300);
/// Deadline of a wait that is expected to end well.
pub(crate) const PATIENT: Duration = Duration::from_secs(120);

/// How a group of ranks is started: each rank's program runs on its own thread and gets its transport.
pub(crate) trait Group {
    /// Runs `program` on every rank with `deadline` per wait; returns what each returned, by rank.
    fn run<T: Send + 'static>(
        ranks: usize,
        deadline: Duration,
        program: impl Fn(&mut dyn Transport) -> T + Clone + Send + 'static,
    ) -> Vec<T>;
}

pub(crate) type Job<T> = Box<dyn FnOnce() -> T + Send>;

/// Runs one closure per rank on threads and collects the results; fails if they take longer than the watchdog allows.
pub(crate) fn on_threads<T: Send + 'static>(jobs: Vec<Job<T>>) -> Vec<T> {
    let (sender, receiver) = mpsc::channel();
    let count = jobs.len();
    for (rank, job) in jobs.into_iter().enumerate() {
        let sender = sender.clone();
        std::thread::spawn(move || {
            let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(job));
            let _ = sender.send((rank, result));
        });
    }
    let mut results: Vec<Option<T>> = (0..count).map(|_| None).collect();
    for _ in 0..count {
        let (rank, result) = receiver.recv_timeout(WATCHDOG).expect("the watchdog bit: ranks hang");
        match result {
            Ok(value) => results[rank] = Some(value),
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }
    results.into_iter().flatten().collect()
}

pub(crate) struct Threads;

impl Group for Threads {
    fn run<T: Send + 'static>(
        ranks: usize,
        deadline: Duration,
        program: impl Fn(&mut dyn Transport) -> T + Clone + Send + 'static,
    ) -> Vec<T> {
        let jobs = InProcessTransport::group(ranks).into_iter().map(|mut transport| {
            let program = program.clone();
            transport.set_deadline(deadline);
            Box::new(move || program(&mut transport)) as Job<T>
        });
        on_threads(jobs.collect())
    }
}

pub(crate) struct Emulated;

impl Group for Emulated {
    fn run<T: Send + 'static>(
        ranks: usize,
        deadline: Duration,
        program: impl Fn(&mut dyn Transport) -> T + Clone + Send + 'static,
    ) -> Vec<T> {
        let topology = Topology::default_for(ranks).expect("a tree");
        let plan = plan(ScheduleKind::Ring, &topology, MAX_LEN as f64 * 4.0).expect("a schedule");
        let no_halo = Traffic { published: vec![0.0; ranks], received: vec![vec![0.0; ranks]; ranks] };
        let links = RankLinks::of(&topology, &plan, MAX_LEN as f64 * 4.0, &no_halo);
        let jobs = InProcessTransport::group(ranks).into_iter().zip(links).map(|(mut transport, links)| {
            let program = program.clone();
            transport.set_deadline(deadline);
            Box::new(move || program(&mut EmulatedTransport::new(transport, links, deadline))) as Job<T>
        });
        on_threads(jobs.collect())
    }
}

pub(crate) struct Iceoryx;

impl Group for Iceoryx {
    fn run<T: Send + 'static>(
        ranks: usize,
        deadline: Duration,
        program: impl Fn(&mut dyn Transport) -> T + Clone + Send + 'static,
    ) -> Vec<T> {
        let (run, member) = RunName::create("conformance test").expect("a run");
        let jobs = (0..ranks).map(|rank| {
            let (program, run) = (program.clone(), run.clone());
            Box::new(move || {
                let mut transport = IceoryxTransport::connect(&run, options(rank, ranks, deadline)).expect("connect");
                program(&mut transport)
            }) as Job<T>
        });
        let results = on_threads(jobs.collect());
        drop(member);
        assert!(!run.root().exists() && run.shared_memory_files().is_empty(), "the run left something behind");
        results
    }
}

pub(crate) fn options(rank: usize, ranks: usize, deadline: Duration) -> IceoryxOptions {
    IceoryxOptions { rank, ranks, epoch: 0, max_len: MAX_LEN, deadline, on_wait: Box::new(|| false) }
}

/// Runs every named test over every group, in a module per group.
macro_rules! conformance {
    ($($test:ident),* $(,)?) => {
        mod in_process { $(#[test] fn $test() { super::$test::<$crate::groups::Threads>(); })* }
        mod emulated { $(#[test] fn $test() { super::$test::<$crate::groups::Emulated>(); })* }
        mod iceoryx { $(#[test] fn $test() { super::$test::<$crate::groups::Iceoryx>(); })* }
    };
}
pub(crate) use conformance;
