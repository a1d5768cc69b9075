//! Control channel between the coordinator and its workers: messages of any length both ways, heartbeats, and notice of
//! each other's death. The coordinator never blocks on a worker; it says nothing about what the messages mean.
//!
//! Every message is cut into frames (see `frames`), one stream each way and rank. A reader counts on its blackboard what
//! it has taken, so that a sender only ever sends what fits; who sends or takes wakes the other end.

use std::time::{Duration, Instant};

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::reader::{EntryHandle, Reader};
use iceoryx2::port::writer::{EntryHandleMut, Writer};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{blackboard, event};
use thiserror::Error;

use super::frame_ports::{FrameReceiver, FrameSender, FrameService, create_stream};
use super::node::{Ipc, create_node, service_name, text};
use crate::transport::process::ProcessWatch;
use crate::transport::{RANKS_MAX, RunName, shared_memory};

pub(super) const KEY_CONSUMED: u64 = 0;
pub(super) const KEY_HEARTBEAT: u64 = 1;
/// On the coordinator's blackboard, after the counters of frames taken from each rank.
pub(super) const KEY_PID: u64 = RANKS_MAX as u64;

/// Why a control call failed.
#[derive(Debug, Error)]
pub enum ControlError {
    /// The other end did not answer in time.
    #[error("waited {waited_s:.1} s for {what}")]
    TimedOut { what: &'static str, waited_s: f64 },
    /// The coordinator has ended; the worker should too.
    #[error("the coordinator (process {pid}) has ended")]
    CoordinatorGone { pid: u32 },
    /// No such rank.
    #[error("rank {rank} of {ranks} ranks does not exist")]
    NoSuchRank { rank: usize, ranks: usize },
    /// The mechanism below failed.
    #[error("control channel: {message}")]
    Mechanism { message: String },
}

impl From<String> for ControlError {
    fn from(message: String) -> ControlError {
        ControlError::Mechanism { message }
    }
}

/// A worker's sign of life.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
pub struct Heartbeat {
    /// Grows with every sign of life; 0 = none yet.
    pub counter: u64,
    /// Process of the worker; 0 = none yet.
    pub pid: u64,
    /// Step that the worker is in.
    pub step: u64,
    /// Where in the step it is; a number that coordinator and worker agree on.
    pub phase: u64,
}

/// Names of a run's control services.
pub(super) struct Names {
    pub down: ServiceName,
    pub up: ServiceName,
    pub worker: ServiceName,
    pub wake: ServiceName,
}

impl Names {
    pub(super) fn of_rank(rank: usize) -> Result<Names, String> {
        let name = |kind: &str| service_name(&format!("control/{rank}/{kind}"));
        Ok(Names { down: name("down")?, up: name("up")?, worker: name("worker")?, wake: name("wake")? })
    }

    pub(super) fn of_coordinator() -> Result<(ServiceName, ServiceName), String> {
        Ok((service_name("control/coordinator")?, service_name("control/wake")?))
    }
}

/// The coordinator's end: one per run, created before the workers start.
pub struct ControlCoordinator {
    links: Vec<Link>,
    listener: Listener<Ipc>,
    _writer: Writer<Ipc, u64>,
    _own: blackboard::PortFactory<Ipc, u64>,
    _wake: event::PortFactory<Ipc>,
    _node: Node<Ipc>,
}

struct Link {
    sender: FrameSender,
    receiver: FrameReceiver,
    /// Frames taken from this worker, for it to see.
    taken: EntryHandleMut<Ipc, u64, u64>,
    /// Frames that the worker has taken.
    taken_by_worker: EntryHandle<Ipc, u64, u64>,
    heartbeat: EntryHandle<Ipc, u64, Heartbeat>,
    notifier: Notifier<Ipc>,
    watch: Option<ProcessWatch>,
    /// Counter of the newest heartbeat seen, and when it was first seen.
    newest: (u64, Instant),
    _reader: Reader<Ipc, u64>,
    _services: (FrameService, FrameService, blackboard::PortFactory<Ipc, u64>, event::PortFactory<Ipc>),
}

impl ControlCoordinator {
    /// Creates the channel for `ranks` workers of `run`; they connect when they come.
    ///
    /// # Errors
    /// The machine lacks a resource, or the run has a coordinator already.
    pub fn create(run: &RunName, ranks: usize) -> Result<ControlCoordinator, ControlError> {
        if ranks > RANKS_MAX {
            return Err(format!("{ranks} ranks, at most {RANKS_MAX} are possible").into());
        }
        let node = create_node(run, "coordinator")?;
        let (own_name, wake_name) = Names::of_coordinator()?;
        let mut creator = node.service_builder(&own_name).blackboard_creator::<u64>();
        // One place more than needed, so that a process that does not belong finds out why.
        creator = creator.max_readers(ranks + 1).max_nodes(ranks + 2).add(KEY_PID, u64::from(std::process::id()));
        for rank in 0..ranks as u64 {
            creator = creator.add(KEY_CONSUMED + rank, 0u64);
        }
        let own = creator.create().map_err(text("coordinator's blackboard"))?;
        let writer = own.writer_builder().create().map_err(text("coordinator's blackboard"))?;
        let wake = create_wake(&node, &wake_name, ranks)?;
        let listener = wake.listener_builder().create().map_err(text("coordinator's listener"))?;
        let links = (0..ranks).map(|rank| Link::create(&node, rank, &writer)).collect::<Result<_, _>>()?;
        shared_memory::reserve(run).map_err(|error| error.to_string())?;
        Ok(ControlCoordinator { links, listener, _writer: writer, _own: own, _wake: wake, _node: node })
    }

    /// Number of workers the channel was made for.
    pub fn ranks(&self) -> usize {
        self.links.len()
    }

    fn link(&mut self, rank: usize) -> Result<&mut Link, ControlError> {
        let ranks = self.links.len();
        self.links.get_mut(rank).ok_or(ControlError::NoSuchRank { rank, ranks })
    }

    /// Sends `message` to a worker: keeps it (or a copy of a slice) and returns at once; what does not fit into the
    /// worker's buffers yet follows during later calls of this type ([`ControlCoordinator::wait`] is the natural one).
    pub fn send(&mut self, rank: usize, message: impl Into<Vec<u8>>) -> Result<(), ControlError> {
        let link = self.link(rank)?;
        link.sender.outbox.push(message.into());
        link.pump()
    }

    /// True if everything sent to this worker is in its buffers or taken.
    pub fn all_sent(&self, rank: usize) -> bool {
        self.links.get(rank).is_none_or(|link| link.sender.outbox.is_empty())
    }

    /// The next complete message of a worker, if there is one. Never waits.
    pub fn try_receive(&mut self, rank: usize) -> Result<Option<Vec<u8>>, ControlError> {
        let link = self.link(rank)?;
        link.pump()?;
        while let Some(taken) = link.receiver.take()? {
            link.taken.update_with_copy(link.receiver.consumed());
            // A worker that has left needs no waking.
            let _ = link.notifier.notify();
            if taken.is_some() {
                return Ok(taken);
            }
        }
        Ok(None)
    }

    /// Sleeps until a worker has done something worth a look, at most `timeout`. May return early for no reason.
    pub fn wait(&mut self, timeout: Duration) -> Result<(), ControlError> {
        self.pump_all()?;
        match self.listener.timed_wait(|_| {}, timeout) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
            Err(error) => return Err(format!("waiting for workers: {error:?}").into()),
        }
        self.pump_all()
    }

    fn pump_all(&mut self) -> Result<(), ControlError> {
        self.links.iter_mut().try_for_each(Link::pump)
    }

    /// The newest sign of life of a worker; all zero if it has not come yet or there is no such rank.
    pub fn heartbeat(&self, rank: usize) -> Heartbeat {
        self.links.get(rank).map_or(Heartbeat::default(), |link| *link.heartbeat.get())
    }

    /// For how long this worker's heartbeat has not changed, as far as the calls of this method saw; none before it
    /// has connected.
    pub fn silence(&mut self, rank: usize) -> Option<Duration> {
        let link = self.links.get_mut(rank)?;
        let counter = link.heartbeat.get().counter;
        if counter != link.newest.0 {
            link.newest = (counter, Instant::now());
        }
        (counter > 0).then(|| link.newest.1.elapsed())
    }

    /// True once a worker that has connected has ended, for whatever reason. A hung one has not; see
    /// [`ControlCoordinator::silence`].
    pub fn has_ended(&mut self, rank: usize) -> Result<bool, ControlError> {
        let pid = self.heartbeat(rank).pid as u32;
        let link = self.link(rank)?;
        if pid == 0 {
            return Ok(false);
        }
        if link.watch.is_none() {
            let watch = ProcessWatch::new(pid).map_err(|error| format!("cannot watch process {pid}: {error}"))?;
            link.watch = Some(watch);
        }
        Ok(link.watch.as_ref().is_some_and(ProcessWatch::has_ended))
    }
}

impl Link {
    fn create(node: &Node<Ipc>, rank: usize, writer: &Writer<Ipc, u64>) -> Result<Link, String> {
        let names = Names::of_rank(rank)?;
        let down = create_stream(node, &names.down)?;
        let up = create_stream(node, &names.up)?;
        let worker = node
            .service_builder(&names.worker)
            .blackboard_creator::<u64>()
            .max_readers(1)
            .max_nodes(2)
            .add(KEY_CONSUMED, 0u64)
            .add(KEY_HEARTBEAT, Heartbeat::default())
            .create()
            .map_err(text("worker's blackboard"))?;
        let reader = worker.reader_builder().create().map_err(text("worker's blackboard"))?;
        let wake = create_wake(node, &names.wake, 1)?;
        Ok(Link {
            sender: FrameSender::new(&down)?,
            receiver: FrameReceiver::new(&up)?,
            taken: writer.entry(&(KEY_CONSUMED + rank as u64)).map_err(text("coordinator's blackboard"))?,
            taken_by_worker: reader.entry(&KEY_CONSUMED).map_err(text("worker's blackboard"))?,
            heartbeat: reader.entry(&KEY_HEARTBEAT).map_err(text("worker's blackboard"))?,
            notifier: wake.notifier_builder().create().map_err(text("worker's notifier"))?,
            watch: None,
            newest: (0, Instant::now()),
            _reader: reader,
            _services: (down, up, worker, wake),
        })
    }

    fn pump(&mut self) -> Result<(), ControlError> {
        if self.sender.pump(*self.taken_by_worker.get())? {
            let _ = self.notifier.notify();
        }
        Ok(())
    }
}

/// A wake-up service with one listener.
fn create_wake(node: &Node<Ipc>, name: &ServiceName, notifiers: usize) -> Result<event::PortFactory<Ipc>, String> {
    node.service_builder(name)
        .event()
        .max_listeners(1)
        .max_notifiers(notifiers.max(1))
        .max_nodes(notifiers + 1)
        .event_id_max_value(0)
        .create()
        .map_err(text("wake-up service"))
}
