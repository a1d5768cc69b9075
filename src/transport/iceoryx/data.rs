//! [`Transport`] between processes: one publisher per rank that all others read in place, and one blackboard per rank.
//!
//! **No deadlock.** Ranks run the same sequence of calls, and at any point of it at most [`DEPTH`] messages of a source
//! are published and not yet received (publish, let everybody receive, publish again needs one). Take the rank that is
//! least far in that sequence: what it waits for - a message, a contribution, room in a reader's buffer - is made by calls
//! that stand earlier in the sequence, and no other rank is waiting there. So it goes on.

use std::time::Duration;

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::cells::{OwnCells, before_waking};
use super::node::{DEPTH, Ipc, create_node, create_wake, service_name, text};
use super::ports::{Header, Peer, ValueSample, Values, create_values, open_peer, port_name, stopped_error};
use crate::transport::wait::{Patience, WaitHook};
use crate::transport::{ALL_GATHER_MAX, RANKS_MAX, RunName, Transport, TransportError, shared_memory};

/// What a rank needs to connect.
pub struct IceoryxOptions {
    /// Own rank.
    pub rank: usize,
    /// Number of ranks, at most [`RANKS_MAX`].
    pub ranks: usize,
    /// Number of this connection, the same on all ranks. A run that connects again must count up.
    pub epoch: u32,
    /// Most values of one message, the same on all ranks: memory is reserved for it at the start.
    pub max_len: usize,
    /// Longest wait of one call, also while connecting.
    pub deadline: Duration,
    /// Called at least every 50 ms while waiting; true = give up.
    pub on_wait: WaitHook,
}

/// One rank of a run whose ranks are processes (or threads) of this machine. Bound to the thread that made it.
pub struct IceoryxTransport {
    rank: usize,
    max_len: usize,
    patience: Patience,
    links: Links,
    published: u64,
    gathers: u64,
    bytes_published: u64,
    bytes_received: u64,
}

/// All ports; apart from the counters so that a wait can look at them while the hook runs.
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
    /// A rank did not show up before the deadline, the hook gave up, or the machine lacks a resource (shared memory is
    /// reserved here, so that running out of it cannot strike later).
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
        let (bytes_published, bytes_received) = (0, 0);
        let mut transport = IceoryxTransport {
            rank,
            max_len,
            patience,
            links,
            published: 0,
            gathers: 0,
            bytes_published,
            bytes_received,
        };
        // A port that is registered is not yet connected: first all subscribers must be there, then all senders connect,
        // then all subscribers do.
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

    /// Waits until `look` finds something; `source` is the rank that makes it.
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
            match self.patience.miss(&mut wait) {
                Ok(None) => {}
                // Announce first and look again, sleep at the next miss.
                Ok(Some(_)) if !announced => {
                    self.links.own.announce_sleep(1 << source);
                    announced = true;
                }
                Ok(Some(limit)) => match self.links.listener.timed_wait(|_| {}, limit) {
                    Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
                    Err(error) => break Err(self.fail(format!("waiting for rank {source} ({what}): {error:?}"))),
                },
                Err(stopped) => break Err(stopped_error(self.rank, source, what, stopped)),
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

    /// Waits until every reader has given back all but `DEPTH - 1` messages.
    fn wait_for_room(&mut self) -> Result<(), TransportError> {
        let published = self.published;
        for reader in 0..self.links.peers.len() {
            self.wait_for(reader, "room for the next message", |links| {
                let Some(peer) = &mut links.peers[reader] else { return Ok(Some(())) };
                if published - peer.consumed >= DEPTH as u64 {
                    peer.consumed = peer.cells.consumed();
                }
                Ok((published - peer.consumed < DEPTH as u64).then_some(()))
            })?;
        }
        Ok(())
    }

    fn next_sample(&mut self, source: usize) -> Result<ValueSample, TransportError> {
        let rank = self.rank;
        self.wait_for(source, "its next message", |links| {
            let Some(peer) = &mut links.peers[source] else { return Ok(None) };
            let received = peer.subscriber.receive();
            received.map_err(|error| TransportError::Mechanism { rank, message: format!("receive: {error:?}") })
        })
    }
}

impl Transport for IceoryxTransport {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.links.peers.len()
    }

    fn publish(&mut self, len: usize, fill: &mut dyn FnMut(&mut [f32])) -> Result<(), TransportError> {
        if len > self.max_len {
            let max_len = self.max_len;
            return Err(self.fail(format!("a message of {len} values; memory was reserved for {max_len}")));
        }
        self.wait_for_room()?;
        let loaned = self.links.publisher.loan_slice_uninit(len);
        let mut sample = loaned.map_err(|error| self.fail(format!("buffer for a message: {error:?}")))?;
        sample.user_header_mut().sequence = self.published;
        let payload = sample.payload_mut();
        // SAFETY: same layout; the memory comes from the system zeroed (or holds an older message) and every bit pattern
        // is an f32, so what `fill` leaves unwritten holds unspecified values, not uninitialized ones.
        let payload = unsafe { &mut *(std::ptr::from_mut(payload) as *mut [f32]) };
        fill(payload);
        // SAFETY: initialized, see above.
        let sample = unsafe { sample.assume_init() };
        let sent = sample.send().map_err(|error| self.fail(format!("publish: {error:?}")))?;
        let readers = self.ranks() - 1;
        if sent != readers {
            return Err(self.fail(format!("a message reached {sent} of {readers} ranks: one has left the run")));
        }
        self.published += 1;
        self.bytes_published += (len * size_of::<f32>()) as u64;
        self.links.wake_sleepers();
        Ok(())
    }

    fn receive(&mut self, source: usize, read: &mut dyn FnMut(&[f32])) -> Result<(), TransportError> {
        if self.links.peers.get(source).is_none_or(Option::is_none) {
            return Err(self.fail(format!("cannot receive from rank {source} of {} ranks", self.ranks())));
        }
        let sample = self.next_sample(source)?;
        let expected = self.links.peers[source].as_ref().map_or(0, |peer| peer.received);
        let got = sample.user_header().sequence;
        if got != expected {
            return Err(TransportError::OutOfOrder { rank: self.rank, source_rank: source, expected, got });
        }
        read(sample.payload());
        self.bytes_received += std::mem::size_of_val(sample.payload()) as u64;
        // The buffer goes back before the counter says so.
        drop(sample);
        if let Some(peer) = &mut self.links.peers[source] {
            peer.received = expected + 1;
        }
        self.links.own.consumed[source].update_with_copy(expected + 1);
        self.links.wake_if_asleep(source);
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        match self.links.peers.get(source) {
            Some(Some(peer)) => peer.subscriber.has_samples().unwrap_or(false),
            _ => false,
        }
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        if self.links.peers.get(source).is_none_or(Option::is_none) {
            return Err(self.fail(format!("cannot wait for rank {source} of {} ranks", self.ranks())));
        }
        let rank = self.rank;
        self.wait_for(source, "its next message", |links| {
            let Some(peer) = &links.peers[source] else { return Ok(None) };
            let waiting = peer.subscriber.has_samples();
            let waiting =
                waiting.map_err(|error| TransportError::Mechanism { rank, message: format!("receive: {error:?}") })?;
            Ok(waiting.then_some(()))
        })
    }

    fn alive(&mut self) -> Result<(), TransportError> {
        let rank = self.rank;
        self.patience.breathe().map_err(|stopped| stopped_error(rank, rank, "its own work", stopped))
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

    fn bytes_published(&self) -> u64 {
        self.bytes_published
    }

    fn bytes_received(&self) -> u64 {
        self.bytes_received
    }
}

impl Links {
    /// Wakes every rank that sleeps for this one.
    fn wake_sleepers(&self) {
        before_waking();
        for peer in self.peers.iter().flatten() {
            self.notify(peer);
        }
    }

    fn wake_if_asleep(&self, rank: usize) {
        before_waking();
        if let Some(Some(peer)) = self.peers.get(rank) {
            self.notify(peer);
        }
    }

    fn notify(&self, peer: &Peer) {
        if peer.cells.sleeps_for(self.rank) {
            // A lost wake-up costs the sleeper the rest of its 20 ms; a peer that has left needs none.
            let _ = peer.notifier.notify();
        }
    }
}
