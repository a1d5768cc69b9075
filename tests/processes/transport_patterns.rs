//! The part of the conformance suite on who reads what: patterns without readers, with one, with all, one-sided ones,
//! ones that change from exchange to exchange; readers that are slow, rare or gone. Same groups as
//! `transport_conformance.rs`.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use loomtree::transport::{Counts, Neighbor, Pattern, Rows, Transport, TransportError};

use crate::groups::{Group, PATIENT, conformance};

/// Rows of every message here, as far as its owner has readers.
const ROWS: usize = 60;

/// A number that depends on all of `parts` and looks random.
fn mixed(parts: [usize; 3]) -> usize {
    let mix = |state: u64, part: usize| (state ^ part as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
    (parts.into_iter().fold(0x51_7cc1, mix) >> 7) as usize
}

/// The rows of `source` that `reader` reads in exchange `round`; empty: none.
fn rows_read(round: usize, source: usize, reader: usize, ranks: usize) -> Vec<u32> {
    let chosen = match round % 6 {
        0 => false,
        // One reader of one source.
        1 => source == round % ranks && reader == (source + 1 + round / 6 % (ranks - 1)) % ranks,
        2 => true,
        // One way around.
        3 => reader == (source + 1) % ranks,
        // Everybody reads of one rank, which reads of nobody.
        4 => source == round / 6 % ranks,
        _ => mixed([round, source, reader]).is_multiple_of(3),
    };
    if !chosen || source == reader {
        return Vec::new();
    }
    let (first, step) = (mixed([source, reader, round]) % 7, 1 + mixed([reader, round, source]) % 5);
    let rows = (first..ROWS).step_by(step).map(|row| row as u32);
    // Readers count rows in the order they like.
    if round.is_multiple_of(2) { rows.collect() } else { rows.rev().collect() }
}

fn pattern(round: usize, rank: usize, ranks: usize) -> Pattern {
    let neighbor = |other: usize, rows: Vec<u32>| Neighbor { rank: other, message_rows: ROWS, rows: Rows::At(rows) };
    let others = || (0..ranks).filter(|&other| other != rank);
    let readers = others().map(|reader| neighbor(reader, rows_read(round, rank, reader, ranks)));
    let sources = others().map(|source| neighbor(source, rows_read(round, source, rank, ranks)));
    Pattern::new(ROWS, readers.collect(), sources.collect())
}

/// Value `c` of row `row` of the message of `source` in exchange `round`.
fn value(round: usize, source: usize, row: usize, c: usize) -> f32 {
    (round * 10_000 + source * 1_000 + row * 10 + c) as f32
}

fn start(transport: &mut dyn Transport, round: usize, width: usize) -> Result<Pattern, TransportError> {
    let rank = transport.rank();
    let pattern = pattern(round, rank, transport.ranks());
    transport.start(&pattern, width, &mut |buffer| {
        assert_eq!(buffer.len(), ROWS * width);
        for (at, out) in buffer.iter_mut().enumerate() {
            *out = value(round, rank, at / width, at % width);
        }
    })?;
    Ok(pattern)
}

/// Receives and checks everything of exchange `round`, the last source first.
fn finish(transport: &mut dyn Transport, round: usize, width: usize, pattern: &Pattern) {
    for source in pattern.sources().iter().rev() {
        let rows = rows_read(round, source.rank, transport.rank(), transport.ranks());
        let seen = transport.finish(source.rank, &mut |message| {
            assert_eq!(message.rows(), rows.len());
            for (k, &row) in rows.iter().enumerate() {
                let expected: Vec<f32> = (0..width).map(|c| value(round, source.rank, row as usize, c)).collect();
                assert_eq!(message.row(k), expected, "row {row} of rank {} in exchange {round}", source.rank);
            }
        });
        seen.unwrap();
    }
}

pub(crate) fn patterns_change_from_exchange_to_exchange<G: Group>() {
    for ranks in 2..=5 {
        let rounds = 240;
        let counts = G::run(ranks, PATIENT, move |transport| {
            let rank = transport.rank();
            for round in (0..rounds).step_by(2) {
                // Some are late now and then.
                if mixed([round, rank, 5]).is_multiple_of(40) {
                    std::thread::sleep(Duration::from_millis(1));
                }
                let widths = [1 + round % 3, 6];
                if round.is_multiple_of(4) {
                    let both = [0, 1].map(|i| start(transport, round + i, widths[i]).unwrap());
                    both.iter().enumerate().for_each(|(i, pattern)| finish(transport, round + i, widths[i], pattern));
                } else {
                    for (i, width) in widths.into_iter().enumerate() {
                        let pattern = start(transport, round + i, width).unwrap();
                        finish(transport, round + i, width, &pattern);
                    }
                }
            }
            transport.counts()
        });
        for (rank, counts) in counts.into_iter().enumerate() {
            let mut expected = Counts::default();
            for round in 0..rounds {
                let (own, width) = (pattern(round, rank, ranks), if round % 2 == 0 { 1 + round % 3 } else { 6 });
                expected.published += u64::from(!own.readers().is_empty());
                expected.bytes_published += u64::from(!own.readers().is_empty()) * (ROWS * width * 4) as u64;
                expected.received += own.sources().len() as u64;
                expected.bytes_received +=
                    own.sources().iter().map(|s| (s.rows_read() * width * 4) as u64).sum::<u64>();
            }
            assert_eq!(counts, expected, "rank {rank} of {ranks}");
        }
    }
}

/// One row from the first to the second of each of `ways`.
fn one_way(rank: usize, ways: &[(usize, usize)]) -> Pattern {
    let neighbor = |other: usize| Neighbor { rank: other, message_rows: 1, rows: Rows::All };
    let readers: Vec<_> = ways.iter().filter(|way| way.0 == rank).map(|way| neighbor(way.1)).collect();
    let sources = ways.iter().filter(|way| way.1 == rank).map(|way| neighbor(way.0)).collect();
    Pattern::new(usize::from(!readers.is_empty()), readers, sources)
}

fn say(transport: &mut dyn Transport, ways: &[(usize, usize)], value: usize) -> Result<(), TransportError> {
    let pattern = one_way(transport.rank(), ways);
    transport.start(&pattern, 1, &mut |buffer| buffer.fill(value as f32))
}

fn hear(transport: &mut dyn Transport, source: usize, value: usize) {
    transport.finish(source, &mut |message| assert_eq!(message.values(), [value as f32])).unwrap();
}

fn who_reads_nothing_does_not_wait<G: Group>() {
    let done = Arc::new(AtomicBool::new(false));
    let published = G::run(3, PATIENT, move |transport| {
        let rank = transport.rank();
        // Rank 2 goes through all exchanges before the others begin with the first one; then it goes home.
        while rank != 2 && !done.load(Ordering::Acquire) {
            std::thread::sleep(Duration::from_millis(1));
        }
        for round in 0..500 {
            say(transport, &[(0, 1)], round).unwrap();
            if rank == 1 {
                hear(transport, 0, round);
            }
        }
        done.store(true, Ordering::Release);
        transport.barrier().unwrap();
        transport.counts()
    });
    assert_eq!(published.map_counts(), [(500, 0), (0, 500), (0, 0)]);
}

trait MapCounts {
    fn map_counts(&self) -> Vec<(u64, u64)>;
}

impl MapCounts for Vec<Counts> {
    fn map_counts(&self) -> Vec<(u64, u64)> {
        self.iter().map(|counts| (counts.published, counts.received)).collect()
    }
}

fn a_slow_reader_holds_up_its_sources_and_nobody_else<G: Group>() {
    let (others_are_through, has_begun) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
    G::run(4, PATIENT, move |transport| {
        let (rank, ways) = (transport.rank(), [(0, 1), (2, 3), (3, 2)]);
        for round in 0..60 {
            if rank == 1 && round == 0 {
                // Ranks 2 and 3 finish all of their exchanges before rank 1 begins.
                while others_are_through.load(Ordering::Acquire) < 2 {
                    std::thread::sleep(Duration::from_millis(1));
                }
                std::thread::sleep(Duration::from_millis(20));
            }
            say(transport, &ways, round).unwrap();
            match rank {
                0 => {
                    assert!(round < 2 || has_begun.load(Ordering::Acquire), "a third message before the first was read")
                }
                1 => {
                    has_begun.store(true, Ordering::Release);
                    hear(transport, 0, round);
                }
                _ => hear(transport, 5 - rank, round),
            }
        }
        if rank >= 2 {
            others_are_through.fetch_add(1, Ordering::AcqRel);
        }
        transport.barrier().unwrap();
    });
}

pub(crate) fn a_rare_reader_gets_the_right_message_out_of_many<G: Group>() {
    // Rank 0 sends to rank 1 in every exchange, to rank 2 in every 7th, to rank 3 in the last one only.
    let rounds = 700;
    let ways = move |round: usize| {
        let mut ways = vec![(0, 1)];
        ways.extend(Some((0, 2)).filter(|_| round % 7 == 3));
        ways.extend(Some((0, 3)).filter(|_| round + 1 == rounds));
        ways
    };
    let counts = G::run(4, PATIENT, move |transport| {
        let rank = transport.rank();
        for round in 0..rounds {
            say(transport, &ways(round), round).unwrap();
            if ways(round).contains(&(0, rank)) {
                if rank == 2 && round % 70 == 3 {
                    std::thread::sleep(Duration::from_millis(2));
                }
                hear(transport, 0, round);
            }
        }
        transport.barrier().unwrap();
        transport.counts()
    });
    assert_eq!(counts.map_counts(), [(700, 0), (0, 700), (0, 100), (0, 1)]);
}

pub(crate) fn two_halves_of_a_group_go_their_own_ways<G: Group>() {
    // Nothing joins ranks 0 and 1 to 2 and 3 but an all-gather at the end; one half may be far ahead of the other.
    G::run(4, PATIENT, |transport| {
        let rank = transport.rank();
        let other = rank ^ 1;
        for round in 0..300 {
            if rank < 2 && round % 100 == 0 {
                std::thread::sleep(Duration::from_millis(5));
            }
            say(transport, &[(0, 1), (1, 0), (2, 3), (3, 2)], round).unwrap();
            hear(transport, other, round);
        }
        let mut all = Vec::new();
        transport.all_gather(&[rank as f64], &mut all).unwrap();
        assert_eq!(all, [[0.0], [1.0], [2.0], [3.0]]);
    });
}

fn a_reader_that_is_gone_is_noticed<G: Group>() {
    let ends = G::run(3, Duration::from_millis(400), |transport| {
        let ways = [(0, 1), (0, 2), (2, 0)];
        for round in 0..50 {
            let rank = transport.rank();
            if rank == 1 && round == 5 {
                return None;
            }
            if let Err(error) = say(transport, &ways, round) {
                return Some(error);
            }
            for (source, _) in ways.into_iter().filter(|way| way.1 == rank) {
                if let Err(error) = transport.finish(source, &mut |_| {}) {
                    return Some(error);
                }
            }
        }
        panic!("rank {} did not notice", transport.rank())
    });
    assert_eq!(ends[1], None);
    for (rank, end) in ends.into_iter().enumerate().filter(|(rank, _)| *rank != 1) {
        match end.expect("an error") {
            // Whoever waits for the room that the reader does not make, or for one who does.
            TransportError::TimedOut { source_rank, waited_s, .. } => {
                assert!(source_rank == if rank == 0 { 1 } else { 0 } && waited_s >= 0.4);
            }
            TransportError::Mechanism { message, .. } => assert!(message.contains("one has left the run"), "{message}"),
            other => panic!("{other}"),
        }
    }
}

pub(crate) fn a_third_exchange_before_the_first_is_finished_is_refused<G: Group>() {
    G::run(2, PATIENT, |transport| {
        let (rank, ways) = (transport.rank(), [(0, 1), (1, 0)]);
        say(transport, &ways, 0).unwrap();
        say(transport, &ways, 1).unwrap();
        let error = say(transport, &ways, 2).unwrap_err().to_string();
        let expected = format!("exchange 2 must not begin before message 0 of rank {} is received", 1 - rank);
        assert!(error.contains(&expected), "{error}");
        for round in 0..2 {
            hear(transport, 1 - rank, round);
        }
        say(transport, &ways, 2).unwrap();
        hear(transport, 1 - rank, 2);
        transport.barrier().unwrap();
    });
}

conformance!(
    patterns_change_from_exchange_to_exchange,
    who_reads_nothing_does_not_wait,
    a_slow_reader_holds_up_its_sources_and_nobody_else,
    a_rare_reader_gets_the_right_message_out_of_many,
    two_halves_of_a_group_go_their_own_ways,
    a_reader_that_is_gone_is_noticed,
    a_third_exchange_before_the_first_is_finished_is_refused,
);
