//! [`Transport`] between processes: one publisher per rank whose messages all others can read in place, and one
//! blackboard per rank.
//!
//! A message lies once in the publisher's memory. Every other rank has it in its list, but only the readers that its
//! pattern names receive it. Messages carry the number of their exchange. A reader discards older ones, and newer
//! messages displace those that a rank leaves in its list. Readers write the last exchange of which they have read a
//! source on their blackboard. With these credits a publisher never displaces a message that is still to be read.
//!
//! **Three buffers per rank suffice** ([`DEPTH`] + 1, for any number of ranks). When a rank begins to write a message,
//! all readers of the message before the last have released it ([`IceoryxTransport::wait_for_room`]). So
//! - only the last message may have readers that still read it or hold it;
//! - lists of ranks that do not read hold at most the last [`DEPTH`] messages, because this is their capacity;
//! - in addition, a rank that looks for its message holds an older one for the moment in which it recognizes it as
//!   older.
//!
//! The first two kinds take two buffers, and the third buffer is for writing. A buffer of the last kind is released
//! without waiting, so a writer that does not find a buffer tries again. A message that is still to be read is never
//! displaced: this would take [`DEPTH`] newer messages, and the second of them is not written before it is read.
//! `transport/data.rs` shows that ranks never wait for each other in a circle.

use std::collections::VecDeque;
use std::time::Duration;

use iceoryx2::port::LoanError;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::cells::{OwnCells, before_waking};
use super::node::{Ipc, create_node, create_wake, service_name, text};
use super::ports::{Header, Peer, Values, create_values, open_peer, port_name};
use crate::transport::pattern::{DEPTH, Pending};
use crate::transport::wait::{Patience, WaitHook};
use crate::transport::{
    ALL_GATHER_MAX, Counts, Message, Pattern, RANKS_MAX, RunName, Transport, TransportError, shared_memory,
};

/// Parameters of a connection of a rank.
pub struct IceoryxOptions {
    /// Own rank.
    pub rank: usize,
    /// Number of ranks, at most [`RANKS_MAX`].
    pub ranks: usize,
    /// Number of this connection, the same on all ranks. It must increase with every connection of a run.
    pub epoch: u32,
    /// Maximum number of values of a message, the same on all ranks. Memory is reserved for it at the start.
    pub max_len: usize,
    /// Longest wait of a call and of connecting.
    pub deadline: Duration,
    /// Called at least every 50 ms during a wait; returns true to give up.
    pub on_wait: WaitHook,
}

/// One rank of a run whose ranks are processes (or threads) of this machine. Bound to the thread that created it.
pub struct IceoryxTransport {
    rank: usize,
    max_len: usize,
    patience: Patience,
    links: Links,
    pending: Pending,
    /// Own messages that may have readers, oldest first.
    unread: VecDeque<Unread>,
    gathers: u64,
    counts: Counts,
}

struct Unread {
    number: u64,
    /// Names its readers.
    pattern: Pattern,
}

/// All ports. They are separate from the counters, so that a wait can access them while the hook runs.
struct Links {
    rank: usize,
    own: OwnCells,
    publisher: Publisher<Ipc, Values, Header>,
    listener: Listener<Ipc>,
    /// By rank; none for the own one.
    peers: Vec<Option<Peer>>,
    _values: publish_subscribe::PortFactory<Ipc, Values, Header>,
    _wake: event::PortFactory<Ipc>,
    _node: Node<Ipc>,
}

impl IceoryxTransport {
    /// Connects this rank with all others; returns after every rank has connected with every other one.
    ///
    /// # Errors
    /// A rank did not connect before the deadline, the hook gave up, or the machine lacks a resource. Shared memory is
    /// reserved here, so that it cannot run out later.
    pub fn connect(run: &RunName, options: IceoryxOptions) -> Result<IceoryxTransport, TransportError> {
        let IceoryxOptions { rank, ranks, epoch, max_len, deadline, on_wait } = options;
        let fail = |message: String| TransportError::Mechanism { rank, message };
        if rank >= ranks || ranks > RANKS_MAX {
            return Err(fail(format!("rank {rank} of {ranks} ranks: expected rank < ranks <= {RANKS_MAX}")));
        }
        shared_memory::check_free_for_rank(ranks, max_len).map_err(|error| fail(error.to_string()))?;
        let mut patience = Patience::new(deadline, ranks, on_wait);
        let node = create_node(run, &format!("rank {rank} epoch {epoch}")).map_err(fail)?;
        let name = |kind: &str| port_name(epoch, rank, kind);
        let own = OwnCells::create(&node, &name("cells"), ranks).map_err(fail)?;
        let (values, publisher) = create_values(&node, &name("values"), ranks, max_len).map_err(fail)?;
        let wake_name = service_name(&name("wake")).map_err(fail)?;
        let wake = create_wake(&node, &wake_name, ranks - 1).map_err(fail)?;
        let listener = wake.listener_builder().create().map_err(text("listener")).map_err(fail)?;
        shared_memory::reserve(run).map_err(|error| fail(error.to_string()))?;
        let mut peers = Vec::with_capacity(ranks);
        for source in 0..ranks {
            let opened = (source != rank).then(|| open_peer(&node, rank, epoch, source, &mut patience));
            peers.push(opened.transpose()?);
        }
        let links = Links { rank, own, publisher, listener, peers, _values: values, _wake: wake, _node: node };
        let mut transport = IceoryxTransport {
            rank,
            max_len,
            patience,
            links,
            pending: Pending::new(rank, ranks),
            unread: VecDeque::new(),
            gathers: 0,
            counts: Counts::default(),
        };
        // A registered port is not yet connected. First all subscribers must exist, then all senders connect, then all
        // subscribers do.
        transport.barrier()?;
        transport.links.publisher.update_connections().map_err(|error| fail(format!("publisher: {error:?}")))?;
        transport.barrier()?;
        for peer in transport.links.peers.iter().flatten() {
            peer.subscriber.update_connections().map_err(|error| fail(format!("subscriber: {error:?}")))?;
        }
        transport.barrier()?;
        Ok(transport)
    }

    fn fail(&self, message: String) -> TransportError {
        TransportError::Mechanism { rank: self.rank, message }
    }

    /// Waits until `look` returns a value; `source` is the rank that provides it.
    fn wait_for<T>(
        &mut self,
        source: usize,
        what: &'static str,
        mut look: impl FnMut(&mut Links) -> Result<Option<T>, TransportError>,
    ) -> Result<T, TransportError> {
        if let Some(found) = look(&mut self.links)? {
            return Ok(found);
        }
        let mut wait = self.patience.begin();
        let mut announced = false;
        let result = loop {
            match self.patience.back_off(&mut wait) {
                Ok(None) => {}
                // Announce the sleep first and look again; sleep after the next failed look.
                Ok(Some(_)) if !announced => {
                    self.links.own.announce_sleep(source);
                    announced = true;
                }
                Ok(Some(limit)) => match self.links.listener.timed_wait(|_| {}, limit) {
                    Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
                    Err(error) => break Err(self.fail(format!("waiting for rank {source} ({what}): {error:?}"))),
                },
                Err(stopped) => break Err(stopped.error(self.rank, source, what)),
            }
            match look(&mut self.links) {
                Ok(None) => {}
                Ok(Some(found)) => break Ok(found),
                Err(error) => break Err(error),
            }
        };
        if announced {
            self.links.own.asleep.update_with_copy(0);
        }
        result
    }

    /// Waits until all readers of the own message before the last have released it.
    fn wait_for_room(&mut self) -> Result<(), TransportError> {
        while self.unread.len() >= DEPTH {
            let Some(Unread { number, pattern }) = self.unread.pop_front() else { break };
            for reader in pattern.readers().iter().map(|reader| reader.rank) {
                self.wait_for(reader, "room for the next message", |links| {
                    let Some(peer) = &mut links.peers[reader] else { return Ok(Some(())) };
                    if peer.consumed <= number {
                        peer.consumed = peer.cells.consumed();
                    }
                    Ok((peer.consumed > number).then_some(()))
                })?;
            }
        }
        Ok(())
    }
}

impl Transport for IceoryxTransport {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.links.peers.len()
    }

    fn start(
        &mut self,
        pattern: &Pattern,
        width: usize,
        fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError> {
        let len = pattern.message_values(width);
        if len > self.max_len {
            let max_len = self.max_len;
            return Err(self.fail(format!("a message of {len} values; memory was reserved for {max_len}")));
        }
        let number = self.pending.start(pattern, width)?;
        let Some(first) = pattern.readers().first() else { return Ok(()) };
        self.wait_for_room()?;
        let rank = self.rank;
        let mut sample =
            self.wait_for(first.rank, "a free buffer", |links| match links.publisher.loan_slice_uninit(len) {
                Ok(sample) => Ok(Some(sample)),
                // A reader holds an old message for the moment in which it recognizes it as old.
                Err(LoanError::OutOfMemory) => Ok(None),
                Err(error) => {
                    Err(TransportError::Mechanism { rank, message: format!("buffer for a message: {error:?}") })
                }
            })?;
        sample.user_header_mut().sequence = number;
        let payload = sample.payload_mut();
        // SAFETY: same layout; the memory comes from the system zeroed (or holds an older message) and every bit pattern
        // is an f32, so values that `fill` does not write are unspecified, but initialized.
        let payload = unsafe { &mut *(std::ptr::from_mut(payload) as *mut [f32]) };
        fill(payload);
        // SAFETY: initialized, see above.
        let sample = unsafe { sample.assume_init() };
        let sent = sample.send().map_err(|error| self.fail(format!("publish: {error:?}")))?;
        // A rank that reads no further message may have ended already.
        let readers = pattern.readers().len();
        if sent < readers {
            return Err(self.fail(format!("a message for {readers} ranks reached {sent}: one has left the run")));
        }
        self.links.wake_if_asleep(pattern.readers().iter().map(|reader| reader.rank));
        self.unread.push_back(Unread { number, pattern: pattern.clone() });
        self.counts.publish(pattern, width);
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        let Some(number) = self.pending.next(source).map(|due| due.number) else { return false };
        let peer = self.links.peers[source].as_mut();
        // `wait` and `finish` report errors of a message.
        peer.is_some_and(|peer| !matches!(peer.find(self.rank, source, number), Ok(false)))
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        let (rank, number) = (self.rank, self.pending.expect(source)?.number);
        self.wait_for(source, "its next message", |links| {
            let Some(peer) = &mut links.peers[source] else { return Ok(None) };
            Ok(peer.find(rank, source, number)?.then_some(()))
        })
    }

    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        self.wait(source)?;
        let due = self.pending.take(source)?;
        let found = self.links.peers[source].as_mut().and_then(|peer| peer.found.take());
        let Some(sample) = found else { return Err(self.fail(format!("lost a message of rank {source}"))) };
        let message = due.message(self.rank, sample.payload())?;
        read(&message);
        self.counts.receive(&message);
        // The buffer is released before the counter is written.
        drop(sample);
        self.links.own.consumed[source].update_with_copy(due.number + 1);
        self.links.wake_if_asleep([source]);
        Ok(())
    }

    fn alive(&mut self) -> Result<(), TransportError> {
        let rank = self.rank;
        self.patience.call_hook_if_due().map_err(|stopped| stopped.error(rank, rank, "its own work"))
    }

    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        if own.len() > ALL_GATHER_MAX {
            return Err(self.fail(format!("all-gather of {} values, at most {ALL_GATHER_MAX}", own.len())));
        }
        let sequence = self.gathers + 1;
        let slot = (self.gathers & 1) as usize;
        self.links.own.contribute(slot, sequence, own);
        self.links.wake_sleepers();
        out.resize_with(self.ranks(), Vec::new);
        for (source, values) in out.iter_mut().enumerate() {
            if source == self.rank {
                values.clear();
                values.extend_from_slice(own);
                continue;
            }
            let rank = self.rank;
            self.wait_for(source, "its part of an all-gather", |links| {
                let Some(peer) = &links.peers[source] else { return Ok(None) };
                let head = peer.cells.head(slot);
                if head.sequence > sequence {
                    let (expected, got) = (sequence, head.sequence);
                    return Err(TransportError::OutOfOrder { rank, source_rank: source, expected, got });
                }
                let there = head.sequence == sequence;
                Ok(there.then(|| peer.cells.copy_values(slot, &head, values)))
            })?;
        }
        self.gathers = sequence;
        Ok(())
    }

    fn max_message_values(&self) -> usize {
        self.max_len
    }

    fn counts(&self) -> Counts {
        self.counts
    }
}

impl Links {
    /// Wakes all ranks that sleep for this one.
    fn wake_sleepers(&self) {
        before_waking();
        for peer in self.peers.iter().flatten() {
            self.notify(peer);
        }
    }

    /// Wakes those of `ranks` that sleep for this one.
    fn wake_if_asleep(&self, ranks: impl IntoIterator<Item = usize>) {
        before_waking();
        for peer in ranks.into_iter().filter_map(|rank| self.peers[rank].as_ref()) {
            self.notify(peer);
        }
    }

    fn notify(&self, peer: &Peer) {
        if peer.cells.sleeps_for(self.rank) {
            // A lost wake-up costs the sleeper the rest of its 20 ms; a peer that has left does not need it.
            let _ = peer.notifier.notify();
        }
    }
}
