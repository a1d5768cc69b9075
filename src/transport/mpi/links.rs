//! Measures the links of a world: latency and bandwidth inside a host and between hosts, by messages that go to and
//! fro while all other processes are quiet.

use std::time::{Duration, Instant};

use super::Membership;
use crate::transport::{Connection, MeasuredLink, MeasuredWorld, Neighbor, Pattern, Rows, Transport, TransportError};

/// Values of the messages that measure latency and bandwidth.
const SHORT: usize = 1;
const LONG: usize = 1 << 20;
/// Ways to and fro of each, of which the median counts.
const ROUNDS: [usize; 2] = [201, 15];
/// Longest wait of a message.
const DEADLINE: Duration = Duration::from_secs(60);
/// Number of the group that measures; no crew of a run has it before thousands of others.
const CREW: u32 = 509;

impl Membership {
    /// Measures the links. Every process of the world calls it, and gets the same answer.
    ///
    /// # Errors
    /// A process did not answer.
    pub fn measure(&self) -> Result<MeasuredWorld, TransportError> {
        let (rank, ranks) = self.rank();
        let lowest = &self.world.hosts.hosts;
        let firsts: Vec<usize> = (0..ranks).filter(|&process| lowest[process] == process).collect();
        let host_of = |process: usize| firsts.iter().position(|&first| first == lowest[process]).unwrap_or_default();
        let hosts: Vec<usize> = (0..ranks).map(host_of).collect();
        let names = firsts.iter().map(|&first| self.world.hosts.host_names[first].clone()).collect();
        if ranks == 1 {
            return Ok(MeasuredWorld { hosts, names, inside: None, between: vec![None] });
        }
        let on_wait = Box::new(|| false);
        let connection = Connection { rank, ranks, epoch: 0, max_len: LONG, deadline: DEADLINE, on_wait, links: None };
        let mut transport = self.group(CREW, lowest).connect(connection)?;
        let second = |host: usize| (firsts[host] + 1..ranks).find(|&process| hosts[process] == host);
        let pair = (0..firsts.len()).find_map(|host| Some((firsts[host], second(host)?)));
        let inside = pair.map(|pair| measure_pair(transport.as_mut(), pair)).transpose()?;
        let mut between = vec![None];
        for &first in &firsts[1..] {
            between.push(Some(measure_pair(transport.as_mut(), (firsts[0], first))?));
        }
        Ok(MeasuredWorld { hosts, names, inside, between })
    }
}

/// Measures between two ranks; all ranks call it.
fn measure_pair(transport: &mut dyn Transport, pair: (usize, usize)) -> Result<MeasuredLink, TransportError> {
    let short_s = one_way_s(transport, pair, SHORT, ROUNDS[0])?;
    let long_s = one_way_s(transport, pair, LONG, ROUNDS[1])?;
    let bytes = ((LONG - SHORT) * size_of::<f32>()) as f64;
    Ok(MeasuredLink { latency_us: short_s * 1e6, bandwidth_gb_s: bytes / (long_s - short_s).max(1e-9) * 1e-9 })
}

/// Median time of a message of `values` values from one rank of a pair to the other one, half of its way to and fro.
/// All ranks get that of the first rank of the pair.
fn one_way_s(
    transport: &mut dyn Transport,
    (first, second): (usize, usize),
    values: usize,
    rounds: usize,
) -> Result<f64, TransportError> {
    let rank = transport.rank();
    let end = |rank: usize| vec![Neighbor { rank, message_rows: values, rows: Rows::All }];
    let nobody = || Pattern::new(0, Vec::new(), Vec::new());
    let way = |from: usize, to: usize| match rank {
        _ if rank == from => Pattern::new(values, end(to), Vec::new()),
        _ if rank == to => Pattern::new(0, Vec::new(), end(from)),
        _ => nobody(),
    };
    let ways = [way(first, second), way(second, first)];
    transport.barrier()?;
    let mut times = Vec::with_capacity(rounds);
    for _ in 0..rounds {
        let start = Instant::now();
        for (way, source) in ways.iter().zip([first, second]) {
            transport.start(way, 1, &mut |out| out.fill(1.0))?;
            if way.source(source).is_some() {
                transport.finish(source, &mut |_| {})?;
            }
        }
        times.push(start.elapsed().as_secs_f64() / 2.0);
    }
    times.sort_by(f64::total_cmp);
    let mut all = Vec::new();
    transport.all_gather(&[times[rounds / 2]], &mut all)?;
    Ok(all[first][0])
}
