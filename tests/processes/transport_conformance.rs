//! One suite that every [`Transport`] must pass, run for threads of one process, for emulated links on top of them and
//! for iceoryx2. `transport_patterns.rs` is its part on who reads what.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

use loomtree::transport::{
    ALL_GATHER_MAX, Counts, IceoryxCoordinator, IceoryxOptions, IceoryxTransport, IceoryxWorker, Neighbor, Pattern,
    Rows, RunName, Transport, TransportError, required_shared_memory_bytes,
};

use crate::groups::{Group, Job, MAX_LEN, PATIENT, conformance, on_threads, options};

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

/// Starts an exchange in which everybody reads everything; `lens[r]`: values of rank r.
fn publish(transport: &mut dyn Transport, lens: &[usize], values: &[f32]) -> Result<(), TransportError> {
    let pattern = Pattern::whole(transport.rank(), lens);
    transport.start(&pattern, 1, &mut |buffer| buffer.copy_from_slice(values))
}

/// As [`publish`] with message number `round` of every rank.
fn publish_round(transport: &mut dyn Transport, round: usize) -> Result<(), TransportError> {
    let lens: Vec<usize> = (0..transport.ranks()).map(|rank| message(rank, round).len()).collect();
    let own = message(transport.rank(), round);
    publish(transport, &lens, &own)
}

fn receive(transport: &mut dyn Transport, source: usize) -> Result<Vec<f32>, TransportError> {
    let mut values = None;
    transport.finish(source, &mut |seen| values = Some(seen.values().to_vec()))?;
    Ok(values.expect("finish shows the message"))
}

/// Checks message number `round` of all others.
fn receive_round(transport: &mut dyn Transport, round: usize) {
    for source in others(transport) {
        let expected = message(source, round);
        if !expected.is_empty() {
            assert_eq!(receive(transport, source).unwrap(), expected, "round {round}");
        }
    }
}

/// One value from rank 0 to rank 1, which sends nothing.
fn one_way(rank: usize) -> Pattern {
    let to = |rank: usize| vec![Neighbor { rank, message_rows: 1, rows: Rows::All }];
    if rank == 0 { Pattern::new(1, to(1), Vec::new()) } else { Pattern::new(0, Vec::new(), to(0)) }
}

/// The other ranks, in another order on every rank, like stages of a schedule.
fn others(transport: &dyn Transport) -> Vec<usize> {
    let (rank, ranks) = (transport.rank(), transport.ranks());
    (1..ranks).map(|step| (rank + step) % ranks).collect()
}

pub(crate) fn order_and_contents<G: Group>() {
    for ranks in 1..=4 {
        let rounds = 50;
        let counts = G::run(ranks, PATIENT, move |transport| {
            assert_eq!(transport.ranks(), ranks);
            for round in 0..rounds {
                publish_round(transport, round).unwrap();
                receive_round(transport, round);
            }
            transport.counts()
        });
        let sent = |rank: usize| {
            let lens = (0..rounds).map(|round| message(rank, round).len()).filter(|&len| len > 0 && ranks > 1);
            lens.fold((0, 0), |(messages, bytes), len| (messages + 1, bytes + len as u64 * 4))
        };
        for (rank, own) in counts.iter().enumerate() {
            let (published, bytes_published) = sent(rank);
            let others = (0..ranks).filter(|&other| other != rank).map(sent);
            let (received, bytes_received) = others.fold((0, 0), |sum, of| (sum.0 + of.0, sum.1 + of.1));
            assert_eq!(*own, Counts { published, bytes_published, received, bytes_received });
        }
    }
}

fn publishing_ahead<G: Group>() {
    // Two messages may be on their way before anybody reads.
    G::run(3, PATIENT, |transport| {
        for pair in 0..30 {
            publish_round(transport, 2 * pair).unwrap();
            publish_round(transport, 2 * pair + 1).unwrap();
            receive_round(transport, 2 * pair);
            receive_round(transport, 2 * pair + 1);
        }
    });
    // While a slow reader still holds message k, message k + 1 is published.
    let (second_is_out, wait_for_second) = mpsc::channel();
    let channel = Arc::new(Mutex::new((second_is_out, wait_for_second)));
    G::run(2, PATIENT, move |transport| {
        let pattern = one_way(transport.rank());
        transport.start(&pattern, 1, &mut |buffer| buffer.fill(1.0)).unwrap();
        transport.barrier().unwrap();
        if transport.rank() == 0 {
            transport.start(&pattern, 1, &mut |buffer| buffer.fill(2.0)).unwrap();
            let sender = channel.lock().unwrap().0.clone();
            sender.send(()).unwrap();
        } else {
            let mut held = false;
            transport
                .finish(0, &mut |message| {
                    while channel.lock().unwrap().1.try_recv().is_err() {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    assert_eq!(message.values(), [1.0]);
                    held = true;
                })
                .unwrap();
            assert!(held);
            transport.start(&pattern, 1, &mut |_| panic!("nobody reads it")).unwrap();
            assert_eq!(receive(transport, 0).unwrap(), [2.0]);
        }
        transport.barrier().unwrap();
    });
}

pub(crate) fn ready_tells<G: Group>() {
    G::run(2, PATIENT, |transport| {
        let other = 1 - transport.rank();
        assert!(!transport.ready(other));
        assert!(!transport.ready(transport.rank()));
        assert!(!transport.ready(99));
        transport.barrier().unwrap();
        if transport.rank() == 1 {
            transport.start(&one_way(1), 1, &mut |_| panic!("nobody reads it")).unwrap();
            assert!(!transport.ready(other), "rank 0 has not begun");
        }
        transport.barrier().unwrap();
        if transport.rank() == 0 {
            transport.start(&one_way(0), 1, &mut |buffer| buffer.fill(3.0)).unwrap();
        }
        transport.barrier().unwrap();
        if transport.rank() == 1 {
            // Emulated links may take a moment longer than the barrier.
            transport.wait(other).unwrap();
            assert!(transport.ready(other));
            assert_eq!(receive(transport, other).unwrap(), [3.0]);
        }
        assert!(!transport.ready(other));
        transport.barrier().unwrap();
    });
}

pub(crate) fn gathering<G: Group>() {
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

pub(crate) fn mixed_rounds<G: Group>() {
    // What a solver iteration does, a thousand times.
    let sums = G::run(4, PATIENT, |transport| {
        let (mut out, mut sum) = (Vec::new(), 0.0);
        for round in 0..1000 {
            let rank = transport.rank();
            publish(transport, &[2; 4], &[rank as f32, round as f32]).unwrap();
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
        let mut say = |value: f32| transport.start(&one_way(0), 1, &mut |buffer| buffer.fill(value));
        say(1.0).unwrap();
        say(2.0).unwrap();
        let publish_error = say(3.0).unwrap_err();
        publish(transport, &[0, 1], &[]).unwrap();
        let receive_error = receive(transport, 1).unwrap_err();
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

pub(crate) fn wrong_calls<G: Group>() {
    G::run(2, PATIENT, |transport| {
        let (rank, other) = (transport.rank(), 1 - transport.rank());
        for source in [rank, other, 2] {
            let error = receive(transport, source).unwrap_err().to_string();
            assert!(error.contains(&format!("nothing to receive of rank {source}")), "{error}");
            assert!(transport.wait(source).is_err());
        }
        let stranger = vec![Neighbor { rank: 2, message_rows: 1, rows: Rows::All }];
        let error = transport.start(&Pattern::new(1, stranger, Vec::new()), 1, &mut |_| {}).unwrap_err();
        assert!(error.to_string().contains("names rank 2 of 2 ranks"), "{error}");
        transport.barrier().unwrap();
    });
}

/// Lists of uneven lengths, some empty, reach every rank whole and once, between exchanges of other kinds.
pub(crate) fn whole_lists<G: Group>() {
    for ranks in [1, 2, 3, 5, 8] {
        G::run(ranks, PATIENT, move |transport| {
            let rank = transport.rank();
            for round in 0..40 {
                let lists: Vec<Vec<f32>> = (0..ranks).map(|source| message(source, round)).collect();
                let lengths: Vec<usize> = lists.iter().map(Vec::len).collect();
                let (mut seen, mut expected) = (vec![Vec::new(); ranks], transport.counts());
                let read = &mut |source: usize, values: &[f32]| seen[source].push(values.to_vec());
                transport.share(&lengths, &lists[rank], read).unwrap();
                for (source, list) in lists.iter().enumerate() {
                    // An empty list of another rank need not be shown.
                    let whole: &[Vec<f32>] = if source == rank || !list.is_empty() { &[list.clone()] } else { &[] };
                    assert_eq!(seen[source], whole, "round {round}, list of rank {source}");
                    let (messages, bytes) = (u64::from(!list.is_empty() && ranks > 1), (list.len() * 4) as u64);
                    if source == rank {
                        expected.published += messages;
                        expected.bytes_published += messages * bytes;
                    } else {
                        expected.received += messages;
                        expected.bytes_received += messages * bytes;
                    }
                }
                assert_eq!(transport.counts(), expected, "round {round}");
                publish_round(transport, round + 1).unwrap();
                receive_round(transport, round + 1);
            }
            transport.barrier().unwrap();
        });
    }
}

conformance!(
    order_and_contents,
    whole_lists,
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
    publish(&mut transport, &[MAX_LEN], &[0.5; MAX_LEN]).unwrap();
    let error = publish(&mut transport, &[MAX_LEN + 1], &[0.5; MAX_LEN + 1]).unwrap_err().to_string();
    assert!(error.contains("5001 values") && error.contains("reserved for 5000"), "{error}");
}
