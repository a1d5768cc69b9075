//! A [`Transport`] that delays messages until they would have arrived over the links of a topology. It takes real time,
//! so that schedules, stragglers and timeouts can be tested on one machine.
//!
//! Every message carries the emulated time of its publication, on the monotonic clock that all processes of a machine
//! share. It becomes readable at its modeled arrival. The receipts of a rank follow one another as in the planned
//! exchange, with the contention that arises when all ranks publish at once. A rank that publishes late delays its own
//! message and the messages after it in the queues of its readers. Messages with selected rows ([`Rows::At`]: the halo)
//! use the plan of the halo, in proportion to the rows that are read. All other messages (whole sub-vectors, positions,
//! lists) use the plan of whole sub-vectors, in proportion to their length. Gathers of small values take the modeled
//! time of an all-reduce.
//!
//! Every rank keeps two clocks. Emulated time runs like real time, except that a wait ends when the message arrives by
//! the model, however late the scheduler wakes the rank or the neighbor publishes. The machine's delay (up to
//! [`BEHIND_MAX_S`]) is subtracted from the next waits, so that a run takes the modeled time and not one wake-up longer
//! per message. Messages carry emulated times. No message is readable before its arrival in real time.
//!
//! Not emulated: contention with messages of another exchange, a straggler among ranks that only forward and whose own
//! message comes later or is not read here, time that a rank spends on forwarding messages that it does not read, and
//! kernels, which take their time on this machine. Real transfers add to the time where they stay slower than the
//! model.

use std::collections::VecDeque;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use super::pattern::{Due, Pending};
use super::{Counts, Message, Pattern, Rows, Transport, TransportError};
use crate::interconnect::{RankLinks, Receipt};

/// Values that each message carries in addition to its own: the time of publication.
pub const STAMP_VALUES: usize = 2;

/// Number of exchanges that are stored; more than can be unfinished.
const REMEMBERED: usize = 8;
/// Longest sleep between two signs of life.
const SLEEP_MAX: Duration = Duration::from_millis(20);
/// A wait only yields for this long at its end, because a sleep may last this much longer than requested.
const AWAKE: Duration = Duration::from_micros(150);
/// A rank that is further behind its emulated time than this drops the excess.
const BEHIND_MAX_S: f64 = 0.25;

/// Passes all calls to `inner` with a delay.
pub struct EmulatedTransport<T> {
    inner: T,
    links: RankLinks,
    deadline: Duration,
    /// The latest exchanges; the first one has number `oldest`.
    exchanges: VecDeque<Exchange>,
    oldest: u64,
    /// Unfinished exchanges of the caller. `inner` may be ahead by the messages that are held.
    pending: Pending,
    /// By source: the message that waits for its arrival time.
    held: Vec<Option<Held>>,
    /// Lag of real time behind emulated time, seconds; never negative.
    behind_s: f64,
}

struct Exchange {
    /// By rank: time of publication, known for the own rank and for ranks whose messages have been received.
    published_s: Vec<Option<f64>>,
    /// By lane: delay of receipts against the plan.
    late_s: Vec<f64>,
}

struct Held {
    values: Vec<f32>,
    arrival_s: f64,
}

/// Properties of a message that determine its transfer time.
struct Travels {
    number: u64,
    /// Bytes of the rows that are read.
    bytes: f64,
    /// True if only some of its rows are read.
    halo: bool,
}

impl Travels {
    fn of(due: &Due) -> Travels {
        let halo = matches!(due.neighbor().rows, Rows::At(_));
        Travels { number: due.number, bytes: due.bytes() as f64, halo }
    }
}

/// The monotonic clock of the machine, seconds.
fn now_s() -> f64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

impl<T: Transport> EmulatedTransport<T> {
    /// Delays messages of `inner` by `links`. A wait of more than `deadline` times out.
    pub fn new(inner: T, links: RankLinks, deadline: Duration) -> EmulatedTransport<T> {
        let ranks = inner.ranks();
        EmulatedTransport {
            links,
            deadline,
            exchanges: VecDeque::new(),
            oldest: 0,
            pending: Pending::new(inner.rank(), ranks),
            held: (0..ranks).map(|_| None).collect(),
            behind_s: 0.0,
            inner,
        }
    }

    /// The stored exchange `number`; none if it is too old.
    fn exchange(&mut self, number: u64) -> Option<&mut Exchange> {
        let ranks = self.held.len();
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

    /// Receives the next message of `source` from `inner`, which waits for it.
    fn take(&mut self, source: usize) -> Result<(), TransportError> {
        let mut held = None;
        self.inner.finish(source, &mut |message| {
            let bits = message.tail().iter().rev().fold(0, |bits, half| bits << 32 | u64::from(half.to_bits()));
            held = Some((message.values().to_vec(), f64::from_bits(bits)));
        })?;
        let travels = self.pending.expect(source).map(Travels::of)?;
        if let Some((values, sent_s)) = held {
            let arrival_s = self.arrival_s(source, travels, sent_s);
            self.held[source] = Some(Held { values, arrival_s });
        }
        Ok(())
    }

    fn arrival_s(&mut self, source: usize, travels: Travels, sent_s: f64) -> f64 {
        let rank = self.inner.rank();
        let Travels { number, bytes, halo } = travels;
        let of_source = |receipts: &[Receipt]| -> Vec<Receipt> {
            receipts.iter().filter(|receipt| receipt.owner == source).copied().collect()
        };
        let planned = self.links.halo_bytes.get(source).copied().unwrap_or(0.0);
        let halo = if halo { of_source(&self.links.halo) } else { Vec::new() };
        let (receipts, share) = match halo.is_empty() {
            // The plan has no receipt if this rank only forwards rows that others read.
            false => (halo, if planned > 0.0 { bytes / planned } else { 1.0 }),
            true => (of_source(&self.links.whole), bytes / self.links.whole_bytes.max(1.0)),
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

    fn emulated_s(&self) -> f64 {
        now_s() - self.behind_s
    }

    /// Sets the emulated time of this rank to `emulated_s`.
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
            let left = Duration::try_from_secs_f64(until_s - now_s).unwrap_or(SLEEP_MAX).min(self.deadline);
            match left.checked_sub(AWAKE) {
                Some(sleep) if !sleep.is_zero() => std::thread::sleep(sleep.min(SLEEP_MAX)),
                _ => std::thread::yield_now(),
            }
        }
    }
}

impl<T: Transport> Transport for EmulatedTransport<T> {
    fn rank(&self) -> usize {
        self.inner.rank()
    }

    fn ranks(&self) -> usize {
        self.inner.ranks()
    }

    fn start(
        &mut self,
        pattern: &Pattern,
        width: usize,
        fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError> {
        let number = self.pending.start(pattern, width)?;
        // The real transport provides the buffer; filling it counts as work.
        let begun_s = self.emulated_s();
        let mut sent_s = begun_s;
        self.inner.start(&pattern.with_tail(STAMP_VALUES), width, &mut |buffer| {
            let (own, stamp) = buffer.split_at_mut(buffer.len() - STAMP_VALUES);
            let start_s = now_s();
            fill(own);
            sent_s = begun_s + now_s() - start_s;
            let bits = sent_s.to_bits();
            stamp.copy_from_slice(&[f32::from_bits(bits as u32), f32::from_bits((bits >> 32) as u32)]);
        })?;
        self.set_emulated(sent_s);
        let rank = self.inner.rank();
        if let Some(exchange) = self.exchange(number) {
            exchange.published_s[rank] = Some(sent_s);
        }
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        if self.pending.next(source).is_none() {
            return false;
        }
        if self.held[source].is_none() && self.inner.ready(source) && self.take(source).is_err() {
            return false;
        }
        self.held[source].as_ref().is_some_and(|held| now_s() >= held.arrival_s)
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        self.pending.expect(source)?;
        let (start_s, begun_s) = (now_s(), self.emulated_s());
        if self.held[source].is_none() {
            self.take(source)?;
        }
        let arrival_s = self.held[source].as_ref().map_or(begun_s, |held| held.arrival_s);
        self.hold(source, arrival_s, start_s)?;
        self.set_emulated(begun_s.max(arrival_s));
        Ok(())
    }

    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        self.wait(source)?;
        let Some(held) = self.held[source].take() else { return Ok(()) };
        let due = self.pending.take(source)?;
        read(&due.message(self.inner.rank(), &held.values)?);
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

    fn alive(&mut self) -> Result<(), TransportError> {
        self.inner.alive()
    }

    fn max_message_values(&self) -> usize {
        self.inner.max_message_values().saturating_sub(STAMP_VALUES)
    }

    fn counts(&self) -> Counts {
        self.inner.counts()
    }
}
