//! [`Transport`] between processes: one publisher per rank that all others read in place, and one blackboard per rank.
//!
//! **No deadlock.** Ranks run the same sequence of calls, and at any point of it at most [`DEPTH`] messages of a source
//! are published and not yet received (publish, let everybody receive, publish again needs one). Take the rank that is
//! least far in that sequence: what it waits for - a message, a contribution, room in a reader's buffer - is made by calls
//! that stand earlier in the sequence, and no other rank is waiting there. So it goes on.

use std::time::Duration;

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::cells::{HEAD_VALUES, Head, OwnCells, PeerCells, Tail, before_waking};
use super::node::{BUFFERS, DEPTH, Ipc, OpenError, create_node, open_when_created, service_name, text};
use crate::transport::wait::{Patience, Stopped, WaitHook};
use crate::transport::{ALL_GATHER_MAX, RANKS_MAX, RunName, Transport, TransportError, shared_memory};

/// In front of every message.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[repr(C)]
struct Header {
    /// Messages of this source, counting from 0.
    sequence: u64,
}

type Values = [f32];
type ValueSample = iceoryx2::sample::Sample<Ipc, Values, Header>;

/// What a rank needs to connect.
pub struct IceoryxOptions {
    /// Own rank.
    pub rank: usize,
    /// Number of ranks, at most [`RANKS_MAX`].
    pub ranks: usize,
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

struct Peer {
    cells: PeerCells,
    subscriber: Subscriber<Ipc, Values, Header>,
    notifier: Notifier<Ipc>,
    /// Messages of this peer received so far.
    received: u64,
    /// Own messages that this peer had given back when last looked at.
    consumed: u64,
    _values: publish_subscribe::PortFactory<Ipc, Values, Header>,
    _wake: event::PortFactory<Ipc>,
}

impl IceoryxTransport {
    /// Connects this rank with all others; returns after every rank has connected with every other one.
    ///
    /// # Errors
    /// A rank did not show up before the deadline, the hook gave up, or the machine lacks a resource (shared memory is
    /// reserved here, so that running out of it cannot strike later).
    pub fn connect(run: &RunName, options: IceoryxOptions) -> Result<IceoryxTransport, TransportError> {
        let IceoryxOptions { rank, ranks, max_len, deadline, on_wait } = options;
        let fail = |message: String| TransportError::Mechanism { rank, message };
        if rank >= ranks || ranks > RANKS_MAX {
            return Err(fail(format!("rank {rank} of {ranks} ranks: expected rank < ranks <= {RANKS_MAX}")));
        }
        let mut patience = Patience::new(deadline, ranks, on_wait);
        let node = create_node(run, &format!("rank {rank}")).map_err(fail)?;
        let own = OwnCells::create(&node, &format!("rank/{rank}/cells"), ranks).map_err(fail)?;
        let (values, publisher) = create_values(&node, rank, ranks, max_len).map_err(fail)?;
        let (wake, listener) = create_wake(&node, rank, ranks).map_err(fail)?;
        shared_memory::reserve(run).map_err(|error| fail(error.to_string()))?;
        let mut peers = Vec::with_capacity(ranks);
        for source in 0..ranks {
            let opened = (source != rank).then(|| open_peer(&node, rank, source, &mut patience));
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
            let waiting = waiting.map_err(|error| TransportError::Mechanism { rank, message: format!("receive: {error:?}") })?;
            Ok(waiting.then_some(()))
        })
    }

    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        if own.len() > ALL_GATHER_MAX {
            return Err(self.fail(format!("all-gather of {} values, at most {ALL_GATHER_MAX}", own.len())));
        }
        let sequence = self.gathers + 1;
        let slot = (self.gathers & 1) as usize;
        let mut head = Head { sequence, len: own.len() as u64, values: [0.0; HEAD_VALUES] };
        if own.len() <= HEAD_VALUES {
            head.values[..own.len()].copy_from_slice(own);
        } else {
            let mut tail = Tail { values: [0.0; ALL_GATHER_MAX] };
            tail.values[..own.len()].copy_from_slice(own);
            self.links.own.tails[slot].update_with_copy(tail);
        }
        self.links.own.heads[slot].update_with_copy(head);
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

fn stopped_error(rank: usize, source_rank: usize, what: &'static str, stopped: Stopped) -> TransportError {
    match stopped {
        Stopped::TimedOut { waited_s } => TransportError::TimedOut { rank, source_rank, what, waited_s },
        Stopped::Aborted => TransportError::Aborted { rank, source_rank, what },
    }
}

type ValuesBuilder = iceoryx2::service::builder::publish_subscribe::Builder<Values, Header, Ipc>;

fn values_builder(node: &Node<Ipc>, source: usize, ranks: usize) -> Result<ValuesBuilder, String> {
    Ok(node
        .service_builder(&service_name(&format!("rank/{source}/values"))?)
        .publish_subscribe::<Values>()
        .user_header::<Header>()
        .max_publishers(1)
        .max_subscribers((ranks - 1).max(1))
        .max_nodes(ranks)
        .subscriber_max_buffer_size(DEPTH)
        .subscriber_max_borrowed_samples(1)
        .history_size(0)
        .enable_safe_overflow(false))
}

type OwnValues = (publish_subscribe::PortFactory<Ipc, Values, Header>, Publisher<Ipc, Values, Header>);

fn create_values(node: &Node<Ipc>, rank: usize, ranks: usize, max_len: usize) -> Result<OwnValues, String> {
    let alignment = Alignment::new(shared_memory::MESSAGE_ALIGNMENT).ok_or("alignment")?;
    let service = values_builder(node, rank, ranks)?.payload_alignment(alignment).create().map_err(text("messages"))?;
    let publisher = service
        .publisher_builder()
        .initial_max_slice_len(max_len.max(1))
        .max_loaned_samples(1)
        .allocation_strategy(AllocationStrategy::Static)
        // With credits no reader's buffer is ever full: a full one is an error, not something to wait for in here.
        .backpressure_strategy(BackpressureStrategy::DiscardData)
        .override_sample_preallocation(|_| BUFFERS)
        .create()
        .map_err(text("publisher"))?;
    Ok((service, publisher))
}

fn create_wake(
    node: &Node<Ipc>,
    rank: usize,
    ranks: usize,
) -> Result<(event::PortFactory<Ipc>, Listener<Ipc>), String> {
    let service = node
        .service_builder(&service_name(&format!("rank/{rank}/wake"))?)
        .event()
        .max_listeners(1)
        .max_notifiers((ranks - 1).max(1))
        .max_nodes(ranks)
        .event_id_max_value(0)
        .create()
        .map_err(text("wake-up service"))?;
    let listener = service.listener_builder().create().map_err(text("listener"))?;
    Ok((service, listener))
}

fn open_peer(node: &Node<Ipc>, rank: usize, source: usize, patience: &mut Patience) -> Result<Peer, TransportError> {
    let fail = |message: String| TransportError::Mechanism { rank, message };
    let not_opened = |error: OpenError| match error {
        OpenError::Stopped(stopped) => stopped_error(rank, source, "its start", stopped),
        OpenError::Failed(message) => fail(format!("rank {source}: {message}")),
    };
    let name = |kind: &str| service_name(&format!("rank/{source}/{kind}")).map_err(fail);
    let cells_name = name("cells")?;
    let cells = open_when_created(patience, "blackboard", || {
        node.service_builder(&cells_name).blackboard_opener::<u64>().open()
    });
    let cells = PeerCells::new(cells.map_err(not_opened)?, rank).map_err(fail)?;
    let values_name = name("values")?;
    let values = open_when_created(patience, "messages", || {
        node.service_builder(&values_name).publish_subscribe::<Values>().user_header::<Header>().open()
    })
    .map_err(not_opened)?;
    let subscriber = values.subscriber_builder().buffer_size(DEPTH).create();
    let subscriber = subscriber.map_err(|error| fail(format!("subscriber: {error:?}")))?;
    let wake_name = name("wake")?;
    let wake = open_when_created(patience, "wake-up service", || node.service_builder(&wake_name).event().open())
        .map_err(not_opened)?;
    let notifier = wake.notifier_builder().create().map_err(|error| fail(format!("notifier: {error:?}")))?;
    Ok(Peer { cells, subscriber, notifier, received: 0, consumed: 0, _values: values, _wake: wake })
}
