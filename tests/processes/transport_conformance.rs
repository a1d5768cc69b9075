//! One suite that every [`Transport`] must pass, run for threads of one process, for emulated links on top of them and for
//! iceoryx2 (each rank on its own
//! thread here; `transport_processes.rs` uses real processes).

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

use loomtree::interconnect::{RankLinks, ScheduleKind, Topology, Traffic, plan};
use loomtree::transport::{
    ALL_GATHER_MAX, EmulatedTransport, IceoryxCoordinator, IceoryxOptions, IceoryxTransport, IceoryxWorker,
    InProcessTransport, RunName, Transport, TransportError, required_shared_memory_bytes,
};

/// Most values of a message in these tests.
const MAX_LEN: usize = 5000;
/// Generous: it only turns a deadlock into a failure.
const WATCHDOG: Duration = Duration::from_secs(300);
/// Deadline of a wait that is expected to end well.
const PATIENT: Duration = Duration::from_secs(120);

/// How a group of ranks is started: each rank's program runs on its own thread and gets its transport.
trait Group {
    /// Runs `program` on every rank with `deadline` per wait; returns what each returned, by rank.
    fn run<T: Send + 'static>(
        ranks: usize,
        deadline: Duration,
        program: impl Fn(&mut dyn Transport) -> T + Clone + Send + 'static,
    ) -> Vec<T>;
}

type Job<T> = Box<dyn FnOnce() -> T + Send>;

/// Runs one closure per rank on threads and collects the results; fails if they take longer than the watchdog allows.
fn on_threads<T: Send + 'static>(jobs: Vec<Job<T>>) -> Vec<T> {
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

struct Threads;

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

struct Emulated;

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

struct Iceoryx;

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

fn options(rank: usize, ranks: usize, deadline: Duration) -> IceoryxOptions {
    IceoryxOptions { rank, ranks, epoch: 0, max_len: MAX_LEN, deadline, on_wait: Box::new(|| false) }
}

/// Message number `round` of `source`: uneven lengths, some empty.
fn message(source: usize, round: usize) -> Vec<f32> {
    let len = match (source + round) % 4 {
        0 => 0,
        1 => 1,
        2 => 17 + source * 31 + round % 7,
        _ => 1000 + (source * 7919 + round * 104_729) % 4000,
    };
    (0..len).map(|i| (source * 1_000_000 + round * 1000 + i) as f32).collect()
}

fn publish(transport: &mut dyn Transport, values: &[f32]) -> Result<(), TransportError> {
    transport.publish(values.len(), &mut |buffer| buffer.copy_from_slice(values))
}

fn receive(transport: &mut dyn Transport, source: usize) -> Result<Vec<f32>, TransportError> {
    let mut values = None;
    transport.receive(source, &mut |seen| values = Some(seen.to_vec()))?;
    Ok(values.expect("receive shows the message"))
}

/// The other ranks, in another order on every rank, like stages of a schedule.
fn others(transport: &dyn Transport) -> Vec<usize> {
    let (rank, ranks) = (transport.rank(), transport.ranks());
    (1..ranks).map(|step| (rank + step) % ranks).collect()
}

fn order_and_contents<G: Group>() {
    for ranks in 1..=4 {
        let rounds = 50;
        let bytes = G::run(ranks, PATIENT, move |transport| {
            assert_eq!(transport.ranks(), ranks);
            for round in 0..rounds {
                let own = message(transport.rank(), round);
                publish(transport, &own).unwrap();
                for source in others(transport) {
                    assert_eq!(receive(transport, source).unwrap(), message(source, round), "round {round}");
                }
            }
            (transport.bytes_published(), transport.bytes_received())
        });
        let published: u64 = bytes.iter().map(|b| b.0).sum();
        for (rank, (own, received)) in bytes.iter().enumerate() {
            let expected: usize = (0..rounds).map(|round| message(rank, round).len() * 4).sum();
            assert_eq!(*own, expected as u64);
            assert_eq!(*received, published - own);
        }
    }
}

fn skipping_reads<G: Group>() {
    // A rank that has no use for a message receives it without looking; what it gets afterwards is the next one.
    G::run(3, PATIENT, |transport| {
        for round in 0..40 {
            let own = message(transport.rank(), round);
            publish(transport, &own).unwrap();
            for source in others(transport) {
                if (round + source + transport.rank()) % 3 == 0 {
                    transport.receive(source, &mut |_| {}).unwrap();
                } else {
                    assert_eq!(receive(transport, source).unwrap(), message(source, round));
                }
            }
        }
    });
}

fn publishing_ahead<G: Group>() {
    // Two messages may be on their way before anybody reads.
    G::run(3, PATIENT, |transport| {
        for pair in 0..30 {
            let rank = transport.rank();
            publish(transport, &message(rank, 2 * pair)).unwrap();
            publish(transport, &message(rank, 2 * pair + 1)).unwrap();
            for source in others(transport) {
                assert_eq!(receive(transport, source).unwrap(), message(source, 2 * pair));
                assert_eq!(receive(transport, source).unwrap(), message(source, 2 * pair + 1));
            }
        }
    });
    // While a slow reader still holds message k, message k + 1 is published.
    let (second_is_out, wait_for_second) = mpsc::channel();
    let channel = Arc::new(Mutex::new((second_is_out, wait_for_second)));
    G::run(2, PATIENT, move |transport| {
        if transport.rank() == 0 {
            publish(transport, &[1.0]).unwrap();
            transport.barrier().unwrap();
            publish(transport, &[2.0]).unwrap();
            let sender = channel.lock().unwrap().0.clone();
            sender.send(()).unwrap();
        } else {
            let mut held = false;
            transport.barrier().unwrap();
            transport
                .receive(0, &mut |values| {
                    while channel.lock().unwrap().1.try_recv().is_err() {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    assert_eq!(values, [1.0]);
                    held = true;
                })
                .unwrap();
            assert!(held);
            assert_eq!(receive(transport, 0).unwrap(), [2.0]);
        }
        transport.barrier().unwrap();
    });
}

fn ready_tells<G: Group>() {
    G::run(2, PATIENT, |transport| {
        let other = 1 - transport.rank();
        assert!(!transport.ready(other));
        assert!(!transport.ready(transport.rank()));
        assert!(!transport.ready(99));
        transport.barrier().unwrap();
        if transport.rank() == 0 {
            publish(transport, &[3.0, 4.0]).unwrap();
        }
        transport.barrier().unwrap();
        if transport.rank() == 1 {
            assert!(transport.ready(other));
            assert_eq!(receive(transport, other).unwrap(), [3.0, 4.0]);
        }
        assert!(!transport.ready(other));
        transport.barrier().unwrap();
    });
}

fn gathering<G: Group>() {
    for ranks in 1..=4 {
        G::run(ranks, PATIENT, move |transport| {
            let contribution = |rank: usize, round: usize| -> Vec<f64> {
                let len = [0, 1, 6, 7, ALL_GATHER_MAX][(rank + round) % 5];
                (0..len).map(|i| rank as f64 + 1e-3 * round as f64 + 1e3 * i as f64).collect()
            };
            let mut out = Vec::new();
            for round in 0..1000 {
                transport.all_gather(&contribution(transport.rank(), round), &mut out).unwrap();
                assert_eq!(out.len(), ranks);
                for (rank, values) in out.iter().enumerate() {
                    assert_eq!(*values, contribution(rank, round), "round {round}, rank {rank}");
                }
            }
            let error = transport.all_gather(&[0.0; ALL_GATHER_MAX + 1], &mut out).unwrap_err();
            assert!(error.to_string().contains(&format!("at most {ALL_GATHER_MAX}")), "{error}");
        });
    }
}

fn mixed_rounds<G: Group>() {
    // What a solver iteration does, a thousand times.
    let sums = G::run(4, PATIENT, |transport| {
        let (mut out, mut sum) = (Vec::new(), 0.0);
        for round in 0..1000 {
            let rank = transport.rank();
            publish(transport, &[rank as f32, round as f32]).unwrap();
            for source in others(transport) {
                let values = receive(transport, source).unwrap();
                assert_eq!(values, [source as f32, round as f32]);
            }
            transport.all_gather(&[sum, rank as f64], &mut out).unwrap();
            sum += out.iter().map(|values| values[1]).sum::<f64>();
        }
        sum
    });
    assert_eq!(sums, [6000.0; 4]);
}

fn silent_peer<G: Group>() {
    let given_up = Arc::new(AtomicBool::new(false));
    let errors = G::run(2, Duration::from_millis(300), move |transport| {
        // Rank 1 keeps its transport until rank 0 has given up, and says nothing.
        if transport.rank() == 1 {
            while !given_up.load(Ordering::Acquire) {
                std::thread::sleep(Duration::from_millis(5));
            }
            return Vec::new();
        }
        let receive_error = receive(transport, 1).unwrap_err();
        publish(transport, &[1.0]).unwrap();
        publish(transport, &[2.0]).unwrap();
        let publish_error = publish(transport, &[3.0]).unwrap_err();
        let gather_error = transport.barrier().unwrap_err();
        given_up.store(true, Ordering::Release);
        vec![receive_error, publish_error, gather_error]
    });
    assert_eq!(errors[0].len(), 3);
    for error in &errors[0] {
        match error {
            TransportError::TimedOut { rank: 0, source_rank: 1, waited_s, .. } => assert!(*waited_s >= 0.3),
            other => panic!("{other}"),
        }
    }
}

fn wrong_calls<G: Group>() {
    G::run(2, PATIENT, |transport| {
        let rank = transport.rank();
        assert!(receive(transport, rank).is_err());
        assert!(receive(transport, 2).is_err());
        transport.barrier().unwrap();
    });
}

macro_rules! conformance {
    ($($test:ident),* $(,)?) => {
        mod in_process { $(#[test] fn $test() { super::$test::<super::Threads>(); })* }
        mod emulated { $(#[test] fn $test() { super::$test::<super::Emulated>(); })* }
        mod iceoryx { $(#[test] fn $test() { super::$test::<super::Iceoryx>(); })* }
    };
}
conformance!(
    order_and_contents,
    skipping_reads,
    publishing_ahead,
    ready_tells,
    gathering,
    mixed_rounds,
    silent_peer,
    wrong_calls,
);

/// What a run takes of the shared memory is what was said before the start.
#[test]
fn iceoryx_needs_the_shared_memory_that_was_announced() {
    use std::os::unix::fs::MetadataExt;
    for (ranks, max_len) in [(1, 1), (3, 1), (2, 200_000), (8, 50)] {
        let (run, _member) = RunName::create("memory test").unwrap();
        let _coordinator = IceoryxCoordinator::create(&run, ranks).unwrap();
        let job = |rank: usize| {
            let run = run.clone();
            Box::new(move || {
                let _control = IceoryxWorker::connect(&run, rank, PATIENT).unwrap();
                let options = IceoryxOptions { max_len, ..options(rank, ranks, PATIENT) };
                let mut transport = IceoryxTransport::connect(&run, options).unwrap();
                let files = run.shared_memory_files().into_iter();
                let taken = files.filter_map(|(path, _)| Some(path.metadata().ok()?.blocks() * 512)).sum::<u64>();
                transport.barrier().unwrap();
                taken
            }) as Job<u64>
        };
        let taken = on_threads((0..ranks).map(job).collect()).into_iter().max().unwrap();
        let announced = required_shared_memory_bytes(ranks, max_len);
        assert!(taken <= announced, "{ranks} ranks took {taken} bytes, {announced} were announced");
        assert!(announced <= taken * 3 / 2, "{ranks} ranks took only {taken} bytes, {announced} were announced");
        assert!(taken >= (ranks * 3 * max_len * 4) as u64);
    }
}

/// The hook of a waiting rank is called all the while and can end the wait.
#[test]
fn iceoryx_hook_aborts() {
    let (run, _member) = RunName::create("hook test").unwrap();
    let calls = std::rc::Rc::new(std::cell::Cell::new(0));
    let counted = calls.clone();
    let on_wait = Box::new(move || {
        counted.set(counted.get() + 1);
        counted.get() == 5
    });
    match IceoryxTransport::connect(&run, IceoryxOptions { on_wait, ..options(0, 2, PATIENT) }) {
        Err(TransportError::Aborted { rank: 0, source_rank: 1, .. }) => assert_eq!(calls.get(), 5),
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("connected to nobody"),
    }
}

/// A message longer than what memory was reserved for is refused in words.
#[test]
fn iceoryx_refuses_long_messages() {
    let (run, _member) = RunName::create("length test").unwrap();
    let mut transport = IceoryxTransport::connect(&run, options(0, 1, PATIENT)).unwrap();
    publish(&mut transport, &[0.5; MAX_LEN]).unwrap();
    let error = publish(&mut transport, &[0.5; MAX_LEN + 1]).unwrap_err().to_string();
    assert!(error.contains("5001 values") && error.contains("reserved for 5000"), "{error}");
}
