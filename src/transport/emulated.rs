//! A [`Transport`] that holds messages back until they would have arrived over the links of a topology, by the clock of the
//! laboratory, so that schedules, stragglers and time-outs can be felt on one machine.
//!
//! Every message carries the emulated time at which it was published, on the one monotonic clock that all processes of a
//! machine share. It becomes readable at its modelled arrival: receipts of a rank follow one another as in the planned exchange,
//! with the contention that it has when all ranks publish at once; whoever publishes late delays its own message and what
//! is behind it in the queues of its readers. Halo rows ([`Transport::expect_halo`]) travel by the plan of the halo, in
//! proportion to the rows that are read; all other messages (whole sub-vectors, positions, lists) by the plan of whole
//! sub-vectors, in proportion to their length; gathers of small values take the modelled time of an all-reduce.
//!
//! Every rank keeps two clocks. Emulated time runs like real time, except that a wait ends when the message arrives by the
//! model, however late the scheduler wakes the rank or the neighbour hands over: what the machine loses there (up to
//! [`BEHIND_MAX_S`]) is made up for in the next waits, so that a run takes as long as the model says and not a wake-up longer
//! per message. Messages carry emulated times, and nothing is readable before its arrival in real time.
//!
//! Not emulated: contention with messages of another exchange, a straggler among ranks that only hand on and whose own
//! message comes later, and kernels, which take what they take here. Real hand-over comes on top where it is slower for long.

use std::collections::VecDeque;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use super::{Transport, TransportError};
use crate::interconnect::{RankLinks, Receipt};

/// Values that each message carries beside its own: the time of publishing.
pub const STAMP_VALUES: usize = 2;

/// Exchanges that are remembered: a rank is never further apart from another one than two messages each way.
const REMEMBERED: usize = 8;
/// Longest sleep between two signs of life.
const BREATH: Duration = Duration::from_millis(20);
/// The end of a wait is awake: a sleep may last this much longer than asked for.
const AWAKE: Duration = Duration::from_micros(150);
/// A rank that is further behind its emulated time than this gives the rest up.
const BEHIND_MAX_S: f64 = 0.25;

/// Passes everything on to `inner`, later.
pub struct EmulatedTransport<T> {
    inner: T,
    links: RankLinks,
    deadline: Duration,
    /// The newest exchanges; the first one has number `oldest`.
    exchanges: VecDeque<Exchange>,
    oldest: u64,
    /// By source: messages taken from `inner`, and the one that waits for its time.
    taken: Vec<u64>,
    held: Vec<Option<Held>>,
    /// By source: bytes of halo rows that will be read of the next message.
    expected: Vec<Option<u64>>,
    published: u64,
    bytes_received: u64,
    /// How far real time is behind emulated time, seconds; never negative.
    behind_s: f64,
}

/// What is known of one exchange: the k-th message of every rank.
struct Exchange {
    /// By rank: time of publishing.
    published_s: Vec<Option<f64>>,
    /// By lane: how far receipts are behind the plan.
    late_s: Vec<f64>,
}

struct Held {
    values: Vec<f32>,
    arrival_s: f64,
}

/// The monotonic clock of the machine, seconds.
fn now_s() -> f64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

impl<T: Transport> EmulatedTransport<T> {
    /// Holds messages of `inner` back as `links` say; a wait of more than `deadline` times out.
    pub fn new(inner: T, links: RankLinks, deadline: Duration) -> EmulatedTransport<T> {
        let ranks = inner.ranks();
        EmulatedTransport {
            inner,
            links,
            deadline,
            exchanges: VecDeque::new(),
            oldest: 0,
            taken: vec![0; ranks],
            held: (0..ranks).map(|_| None).collect(),
            expected: vec![None; ranks],
            published: 0,
            bytes_received: 0,
            behind_s: 0.0,
        }
    }

    /// The notes on exchange `number`; none if it is too long ago.
    fn exchange(&mut self, number: u64) -> Option<&mut Exchange> {
        let ranks = self.taken.len();
        let lanes = self.links.whole.iter().chain(&self.links.halo).map(|receipt| receipt.lane + 1).max().unwrap_or(1);
        while number >= self.oldest + self.exchanges.len() as u64 {
            self.exchanges.push_back(Exchange { published_s: vec![None; ranks], late_s: vec![0.0; lanes] });
            if self.exchanges.len() > REMEMBERED {
                self.exchanges.pop_front();
                self.oldest += 1;
            }
        }
        let index = number.checked_sub(self.oldest)?;
        self.exchanges.get_mut(index as usize)
    }

    /// Takes the next message of `source` out of `inner`, which waits for it.
    fn take(&mut self, source: usize) -> Result<(), TransportError> {
        let mut values = Vec::new();
        self.inner.receive(source, &mut |message| values = message.to_vec())?;
        let Some(len) = values.len().checked_sub(STAMP_VALUES) else {
            let message = format!("a message of rank {source} without the time of publishing");
            return Err(TransportError::Mechanism { rank: self.inner.rank(), message });
        };
        let sent_s = f64::from_bits(u64::from(values[len].to_bits()) | u64::from(values[len + 1].to_bits()) << 32);
        values.truncate(len);
        let number = self.taken[source];
        self.taken[source] += 1;
        let arrival_s = self.arrival_s(source, number, sent_s, len * size_of::<f32>());
        self.held[source] = Some(Held { values, arrival_s });
        Ok(())
    }

    /// When message `number` of `source` arrives.
    fn arrival_s(&mut self, source: usize, number: u64, sent_s: f64, message_bytes: usize) -> f64 {
        let rank = self.inner.rank();
        let expected = self.expected[source];
        let bytes = expected.map_or(message_bytes as f64, |bytes| bytes as f64);
        let of_source = |receipts: &[Receipt]| -> Vec<Receipt> {
            receipts.iter().filter(|receipt| receipt.owner == source).copied().collect()
        };
        let planned = self.links.halo_bytes.get(source).copied().unwrap_or(0.0);
        let halo = if expected.is_some() { of_source(&self.links.halo) } else { Vec::new() };
        let (receipts, share) = match (halo.is_empty(), bytes > 0.0) {
            // Rows that this rank only hands on are as many as planned.
            (false, _) => (halo, if bytes > 0.0 && planned > 0.0 { bytes / planned } else { 1.0 }),
            (true, true) => (of_source(&self.links.whole), bytes / self.links.whole_bytes.max(1.0)),
            (true, false) => (Vec::new(), 0.0),
        };
        let Some(exchange) = self.exchange(number) else { return sent_s };
        exchange.published_s[source] = Some(sent_s);
        let begin_s = exchange.published_s[rank].unwrap_or(sent_s);
        let mut arrival_s = sent_s;
        for receipt in receipts {
            let planned_s = begin_s + receipt.start.at(share);
            let holder_s = exchange.published_s[receipt.source].map_or(sent_s, |published_s| published_s.max(sent_s));
            let late_s = &mut exchange.late_s[receipt.lane];
            *late_s = late_s.max(holder_s + receipt.held.at(share) - planned_s);
            arrival_s = f64::max(arrival_s, planned_s + *late_s + receipt.done.at(share) - receipt.start.at(share));
        }
        arrival_s
    }

    /// The emulated time of this rank.
    fn emulated_s(&self) -> f64 {
        now_s() - self.behind_s
    }

    /// It is `emulated_s` now in emulated time.
    fn set_emulated(&mut self, emulated_s: f64) {
        self.behind_s = (now_s() - emulated_s).clamp(0.0, BEHIND_MAX_S);
    }

    /// Waits until `until_s`; the wait began at `start_s`.
    fn hold(&mut self, source: usize, until_s: f64, start_s: f64) -> Result<(), TransportError> {
        loop {
            let now_s = now_s();
            if now_s >= until_s {
                return Ok(());
            }
            let waited_s = now_s - start_s;
            if waited_s >= self.deadline.as_secs_f64() {
                let (rank, what) = (self.inner.rank(), "its next message, on emulated links");
                return Err(TransportError::TimedOut { rank, source_rank: source, what, waited_s });
            }
            self.inner.alive()?;
            let left = Duration::try_from_secs_f64(until_s - now_s).unwrap_or(BREATH).min(self.deadline);
            match left.checked_sub(AWAKE) {
                Some(sleep) if !sleep.is_zero() => std::thread::sleep(sleep.min(BREATH)),
                _ => std::thread::yield_now(),
            }
        }
    }

    fn is_other(&self, source: usize) -> bool {
        source < self.held.len() && source != self.inner.rank()
    }
}

impl<T: Transport> Transport for EmulatedTransport<T> {
    fn rank(&self) -> usize {
        self.inner.rank()
    }

    fn ranks(&self) -> usize {
        self.inner.ranks()
    }

    fn publish(&mut self, len: usize, fill: &mut dyn FnMut(&mut [f32])) -> Result<(), TransportError> {
        // Room for the message is a matter of the real transport; filling it is work.
        let begun_s = self.emulated_s();
        let mut sent_s = begun_s;
        self.inner.publish(len + STAMP_VALUES, &mut |buffer| {
            let (own, stamp) = buffer.split_at_mut(len);
            let start_s = now_s();
            fill(own);
            sent_s = begun_s + now_s() - start_s;
            let bits = sent_s.to_bits();
            stamp.copy_from_slice(&[f32::from_bits(bits as u32), f32::from_bits((bits >> 32) as u32)]);
        })?;
        self.set_emulated(sent_s);
        let (rank, number) = (self.inner.rank(), self.published);
        self.published += 1;
        if let Some(exchange) = self.exchange(number) {
            exchange.published_s[rank] = Some(sent_s);
        }
        Ok(())
    }

    fn receive(&mut self, source: usize, read: &mut dyn FnMut(&[f32])) -> Result<(), TransportError> {
        if !self.is_other(source) {
            return self.inner.receive(source, read);
        }
        self.wait(source)?;
        let Some(held) = self.held[source].take() else { return Ok(()) };
        self.expected[source] = None;
        read(&held.values);
        self.bytes_received += std::mem::size_of_val(held.values.as_slice()) as u64;
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        if !self.is_other(source) {
            return false;
        }
        if self.held[source].is_none() && self.inner.ready(source) && self.take(source).is_err() {
            return false;
        }
        self.held[source].as_ref().is_some_and(|held| now_s() >= held.arrival_s)
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        if !self.is_other(source) {
            return self.inner.wait(source);
        }
        let (start_s, begun_s) = (now_s(), self.emulated_s());
        if self.held[source].is_none() {
            self.take(source)?;
        }
        let arrival_s = self.held[source].as_ref().map_or(begun_s, |held| held.arrival_s);
        self.hold(source, arrival_s, start_s)?;
        self.set_emulated(begun_s.max(arrival_s));
        Ok(())
    }

    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        let (start_s, begun_s) = (now_s(), self.emulated_s());
        self.inner.all_gather(own, out)?;
        let mut reached_s = Vec::new();
        self.inner.all_gather(&[begun_s], &mut reached_s)?;
        let last_s = reached_s.iter().flatten().copied().fold(begun_s, f64::max);
        let (rank, until_s) = (self.inner.rank(), last_s + self.links.gather_s);
        self.hold(rank, until_s, start_s)?;
        self.set_emulated(until_s);
        Ok(())
    }

    fn expect_halo(&mut self, source: usize, bytes: u64) {
        if let Some(expected) = self.expected.get_mut(source) {
            *expected = Some(bytes);
        }
    }

    fn alive(&mut self) -> Result<(), TransportError> {
        self.inner.alive()
    }

    fn max_message_values(&self) -> usize {
        self.inner.max_message_values().saturating_sub(STAMP_VALUES)
    }

    fn bytes_published(&self) -> u64 {
        self.inner.bytes_published() - self.published * (STAMP_VALUES * size_of::<f32>()) as u64
    }

    fn bytes_received(&self) -> u64 {
        self.bytes_received
    }
}
