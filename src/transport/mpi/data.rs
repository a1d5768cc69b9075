//! [`Transport`] between processes of a world. Every reader of a message gets the rows that its pattern names and no
//! others, packed by the sender. A message that more than one rank reads whole is sent from one buffer.
//!
//! MPI delivers the messages of one sender and one tag in order, so an exchange needs no number. Exchanges and
//! all-gathers have tags of their own, which differ from one connection to the next. Every wait polls, so that the
//! run's hook and the deadline work as they do everywhere.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use super::library::{Library, Receiving, Sending};
use crate::transport::pattern::{DEPTH, Pending};
use crate::transport::wait::Patience;
use crate::transport::{ALL_GATHER_MAX, Counts, Message, Neighbor, Pattern, Rows, Transport, TransportError, WaitHook};

/// The first sleep of a wait and the longest one, after spinning and yielding. MPI wakes nobody.
const SLEEPS: [Duration; 2] = [Duration::from_micros(10), Duration::from_micros(500)];

/// Parameters of a connection.
pub(super) struct MpiOptions {
    /// Own rank among `processes`.
    pub rank: usize,
    /// By rank: its process in the world.
    pub processes: Vec<usize>,
    /// Tags of exchanges and of all-gathers, which no other connection of these processes has.
    pub tags: [i32; 2],
    /// Maximum number of values of a message.
    pub max_len: usize,
    /// Longest wait of a call.
    pub deadline: Duration,
    /// Ranks that share the cores of this machine.
    pub sharing: usize,
    pub on_wait: WaitHook,
}

/// One rank of a group of processes.
pub(super) struct MpiTransport {
    library: Library,
    rank: usize,
    processes: Vec<usize>,
    /// Tags of exchanges and of all-gathers.
    tags: [i32; 2],
    max_len: usize,
    patience: Patience,
    pending: Pending,
    /// Messages that MPI may still read, by exchange, oldest first.
    unsent: VecDeque<(u64, Vec<Sending<f32>>)>,
    /// Contributions to all-gathers that MPI may still read.
    ungathered: Vec<Sending<f64>>,
    /// By source: the messages to receive, oldest first.
    arriving: Vec<VecDeque<Receiving<f32>>>,
    /// Buffers that nobody uses.
    spare: Vec<Arc<Vec<f32>>>,
    gathered: Vec<Vec<f64>>,
    counts: Counts,
}

/// An all-gather under way.
pub(super) struct Gather {
    /// With their sources.
    arriving: Vec<(usize, Receiving<f64>)>,
}

impl MpiTransport {
    /// Connects; returns after every rank has.
    ///
    /// # Errors
    /// A rank did not connect before the deadline, or the hook gave up.
    pub(super) fn connect(library: &Library, options: MpiOptions) -> Result<MpiTransport, TransportError> {
        let MpiOptions { rank, processes, tags, max_len, deadline, sharing, on_wait } = options;
        let ranks = processes.len();
        let mut transport = MpiTransport {
            library: library.clone(),
            rank,
            processes,
            tags,
            max_len,
            patience: Patience::new(deadline, sharing, on_wait),
            pending: Pending::new(rank, ranks),
            unsent: VecDeque::new(),
            ungathered: Vec::new(),
            arriving: (0..ranks).map(|_| VecDeque::new()).collect(),
            spare: Vec::new(),
            gathered: vec![Vec::new(); ranks],
            counts: Counts::default(),
        };
        transport.barrier()?;
        Ok(transport)
    }

    fn fail(&self, message: String) -> TransportError {
        TransportError::Mechanism { rank: self.rank, message }
    }

    /// Waits until `look` finds a value.
    fn wait_for<T>(
        &mut self,
        source_rank: usize,
        what: &'static str,
        mut look: impl FnMut(&mut MpiTransport) -> Result<Option<T>, String>,
    ) -> Result<T, TransportError> {
        let rank = self.rank;
        let mut wait = self.patience.begin();
        let mut sleeps = 0;
        loop {
            match look(self) {
                Ok(Some(found)) => return Ok(found),
                Ok(None) => {}
                Err(message) => return Err(self.fail(message)),
            }
            match self.patience.back_off(&mut wait) {
                Ok(None) => {}
                Ok(Some(limit)) => {
                    sleeps += 1;
                    std::thread::sleep((SLEEPS[0] * sleeps).min(SLEEPS[1]).min(limit));
                }
                Err(stopped) => return Err(stopped.error(rank, source_rank, what)),
            }
        }
    }

    /// Forgets the messages that MPI has sent.
    fn reap(&mut self) -> Result<(), String> {
        for (_, sending) in &mut self.unsent {
            let mut kept = Vec::with_capacity(sending.len());
            for mut request in sending.drain(..) {
                if !request.is_done()? {
                    kept.push(request);
                } else {
                    let (buffer, _) = request.into_buffer();
                    if Arc::strong_count(&buffer) == 1 && self.spare.len() < self.processes.len() * (DEPTH + 1) {
                        self.spare.push(buffer);
                    }
                }
            }
            *sending = kept;
        }
        self.unsent.retain(|(_, sending)| !sending.is_empty());
        Ok(())
    }

    fn buffer(&mut self, values: usize) -> Arc<Vec<f32>> {
        let mut buffer = self.spare.pop().unwrap_or_default();
        // Nobody else holds it, so this never copies.
        Arc::make_mut(&mut buffer).resize(values, 0.0);
        buffer
    }

    /// The values that `reader` reads of a message, after them the tail.
    fn pack(&mut self, message: &[f32], reader: &Neighbor, width: usize) -> Option<Arc<Vec<f32>>> {
        let Rows::At(positions) = &reader.rows else { return None };
        let tail = &message[reader.message_rows * width..];
        let mut packed = self.buffer(positions.len() * width + tail.len());
        let values = Arc::make_mut(&mut packed);
        for (row, &at) in values.chunks_exact_mut(width.max(1)).zip(positions) {
            row.copy_from_slice(&message[at as usize * width..(at as usize + 1) * width]);
        }
        values[positions.len() * width..].copy_from_slice(tail);
        Some(packed)
    }

    /// Begins an all-gather: sends `own` to the ranks `to`, and receives from the ranks `from`.
    pub(super) fn begin_gather(&mut self, own: &[f64], to: &[usize], from: &[usize]) -> Result<Gather, TransportError> {
        if own.len() > ALL_GATHER_MAX {
            return Err(self.fail(format!("all-gather of {} values, at most {ALL_GATHER_MAX}", own.len())));
        }
        let contribution = Arc::new(own.to_vec());
        let mut arriving = Vec::with_capacity(from.len());
        for &other in from {
            let mut buffer = std::mem::take(&mut self.gathered[other]);
            buffer.resize(ALL_GATHER_MAX, 0.0);
            let receiving = self.library.receive(self.processes[other], self.tags[1], buffer);
            arriving.push((other, receiving.map_err(|message| self.fail(message))?));
        }
        for &other in to {
            let sent = self.library.send(self.processes[other], self.tags[1], &contribution);
            self.ungathered.push(sent.map_err(|message| self.fail(message))?);
        }
        Ok(Gather { arriving })
    }

    /// Waits for the values of an all-gather.
    pub(super) fn end_gather(&mut self, begun: Gather, out: &mut [Vec<f64>]) -> Result<(), TransportError> {
        for (source, mut receiving) in begun.arriving {
            let what = "its part of an all-gather";
            self.wait_for(source, what, |_| Ok(receiving.is_done()?.then_some(())))?;
            let (values, bytes) = receiving.into_buffer();
            out[source].clear();
            out[source].extend_from_slice(&values[..bytes / size_of::<f64>()]);
            self.gathered[source] = values;
        }
        let mut left = Vec::new();
        for mut request in std::mem::take(&mut self.ungathered) {
            if !request.is_done().map_err(|message| self.fail(message))? {
                left.push(request);
            }
        }
        self.ungathered = left;
        Ok(())
    }

    /// Whether the next message of `source` is here.
    fn has_arrived(&mut self, source: usize) -> Result<bool, String> {
        self.arriving[source].front_mut().map_or(Ok(false), Receiving::is_done)
    }
}

impl Transport for MpiTransport {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.processes.len()
    }

    fn start(
        &mut self,
        pattern: &Pattern,
        width: usize,
        fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError> {
        let (values, reserved) = (pattern.message_values(width), self.max_len);
        if values > reserved {
            return Err(self.fail(format!("a message of {values} values where {reserved} are reserved")));
        }
        let number = self.pending.start(pattern, width)?;
        for source in pattern.sources() {
            // One value more, so that a message that is too long is found by its length.
            let buffer = vec![0.0; self.pending.newest(source.rank).map_or(0, |due| due.packed_values()) + 1];
            let (from, tag) = (self.processes[source.rank], self.tags[0]);
            let receiving = self.library.receive(from, tag, buffer).map_err(|message| self.fail(message))?;
            self.arriving[source.rank].push_back(receiving);
        }
        if pattern.readers().is_empty() {
            return Ok(());
        }
        let reader = pattern.readers()[0].rank;
        self.wait_for(reader, "room for the next message", |transport| {
            transport.reap()?;
            Ok(transport.unsent.iter().all(|(sent, _)| sent + DEPTH as u64 > number).then_some(()))
        })?;
        let mut whole = self.buffer(values);
        fill(&mut Arc::make_mut(&mut whole)[..]);
        let mut sending = Vec::with_capacity(pattern.readers().len());
        for reader in pattern.readers() {
            let message = self.pack(&whole, reader, width).unwrap_or_else(|| whole.clone());
            let sent = self.library.send(self.processes[reader.rank], self.tags[0], &message);
            sending.push(sent.map_err(|message| self.fail(message))?);
        }
        self.unsent.push_back((number, sending));
        if Arc::strong_count(&whole) == 1 {
            self.spare.push(whole);
        }
        self.counts.publish(pattern, width);
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        // An error is that of the call that takes the message.
        source < self.processes.len() && self.has_arrived(source).unwrap_or(true)
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        self.pending.expect(source)?;
        self.wait_for(source, "its next message", |transport| Ok(transport.has_arrived(source)?.then_some(())))
    }

    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        self.wait(source)?;
        let due = self.pending.take(source)?;
        let Some(arrived) = self.arriving[source].pop_front() else {
            return Err(self.fail(format!("there is nothing to receive of rank {source}")));
        };
        let (values, bytes) = arrived.into_buffer();
        let message = due.packed_message(self.rank, &values[..bytes / size_of::<f32>()])?;
        read(&message);
        self.counts.receive(&message);
        Ok(())
    }

    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        let (rank, ranks) = (self.rank, self.processes.len());
        out.resize_with(ranks, Vec::new);
        out[rank].clear();
        out[rank].extend_from_slice(own);
        // Each rank has another order, so that not all send to the same one at once.
        let others: Vec<usize> = (1..ranks).map(|step| (rank + step) % ranks).collect();
        let begun = self.begin_gather(own, &others, &others)?;
        self.end_gather(begun, out)
    }

    fn alive(&mut self) -> Result<(), TransportError> {
        let rank = self.rank;
        self.patience.call_hook_if_due().map_err(|stopped| stopped.error(rank, rank, "its own work"))
    }

    fn max_message_values(&self) -> usize {
        self.max_len
    }

    fn counts(&self) -> Counts {
        self.counts
    }
}
