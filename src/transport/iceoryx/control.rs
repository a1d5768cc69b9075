//! The coordinator's end of a [`crate::transport::control`] channel between processes of one machine.
//!
//! Every message is cut into frames (see `frames`), with one stream for each direction and rank. A reader counts the
//! frames that it has received on its blackboard, so that a sender sends only frames that fit. A process that sends or
//! receives wakes the other end.

use std::time::Duration;

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::reader::{EntryHandle, Reader};
use iceoryx2::port::writer::{EntryHandleMut, Writer};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{blackboard, event};

use super::frame_ports::{FrameReceiver, FrameSender, FrameService, create_stream};
use super::node::{Ipc, create_node, create_wake, service_name, text};
use crate::transport::process::ProcessWatch;
use crate::transport::{ControlCoordinator, ControlError, Heartbeat, RANKS_MAX, RunName, shared_memory};

pub(super) const KEY_CONSUMED: u64 = 0;
pub(super) const KEY_HEARTBEAT: u64 = 1;
/// Key on the coordinator's blackboard, after the counters of frames received from each rank.
pub(super) const KEY_PID: u64 = RANKS_MAX as u64;

/// A [`Heartbeat`] in shared memory.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[repr(C)]
pub(super) struct Beat {
    pub counter: u64,
    /// Process of the worker; 0 = none yet.
    pub pid: u64,
    pub step: u64,
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

/// The coordinator's end of a run whose workers are processes.
pub struct IceoryxCoordinator {
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
    /// Number of frames received from this worker, published for the worker.
    taken: EntryHandleMut<Ipc, u64, u64>,
    /// Number of frames that the worker has received.
    taken_by_worker: EntryHandle<Ipc, u64, u64>,
    heartbeat: EntryHandle<Ipc, u64, Beat>,
    notifier: Notifier<Ipc>,
    watch: Option<ProcessWatch>,
    _reader: Reader<Ipc, u64>,
    _services: (FrameService, FrameService, blackboard::PortFactory<Ipc, u64>, event::PortFactory<Ipc>),
}

impl IceoryxCoordinator {
    /// Creates the channel for `ranks` workers of `run`, which connect later.
    ///
    /// # Errors
    /// The machine lacks a resource, or the run has a coordinator already.
    pub fn create(run: &RunName, ranks: usize) -> Result<IceoryxCoordinator, ControlError> {
        if ranks > RANKS_MAX {
            return Err(format!("{ranks} ranks, at most {RANKS_MAX} are possible").into());
        }
        shared_memory::check_free_for_control(ranks).map_err(|error| error.to_string())?;
        let node = create_node(run, "coordinator")?;
        let (own_name, wake_name) = Names::of_coordinator()?;
        let mut creator = node.service_builder(&own_name).blackboard_creator::<u64>();
        // One place more than needed, so that a process that does not belong to the run gets an error.
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
        Ok(IceoryxCoordinator { links, listener, _writer: writer, _own: own, _wake: wake, _node: node })
    }

    fn link(&mut self, rank: usize) -> Result<&mut Link, ControlError> {
        let ranks = self.links.len();
        self.links.get_mut(rank).ok_or(ControlError::NoSuchRank { rank, ranks })
    }

    fn pump_all(&mut self) -> Result<(), ControlError> {
        self.links.iter_mut().try_for_each(Link::pump)
    }
}

impl ControlCoordinator for IceoryxCoordinator {
    fn ranks(&self) -> usize {
        self.links.len()
    }

    fn send(&mut self, rank: usize, message: Vec<u8>) -> Result<(), ControlError> {
        let link = self.link(rank)?;
        link.sender.outbox.push(message);
        link.pump()
    }

    fn all_sent(&self, rank: usize) -> bool {
        self.links.get(rank).is_none_or(|link| link.sender.outbox.is_empty())
    }

    fn try_receive(&mut self, rank: usize) -> Result<Option<Vec<u8>>, ControlError> {
        let link = self.link(rank)?;
        link.pump()?;
        while let Some(taken) = link.receiver.take()? {
            link.taken.update_with_copy(link.receiver.consumed());
            // A worker that has left does not need to be woken.
            let _ = link.notifier.notify();
            if taken.is_some() {
                return Ok(taken);
            }
        }
        Ok(None)
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), ControlError> {
        self.pump_all()?;
        match self.listener.timed_wait(|_| {}, timeout) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
            Err(error) => return Err(format!("waiting for workers: {error:?}").into()),
        }
        self.pump_all()
    }

    fn heartbeat(&self, rank: usize) -> Heartbeat {
        let beat = self.links.get(rank).map_or(Beat::default(), |link| *link.heartbeat.get());
        Heartbeat { counter: beat.counter, step: beat.step }
    }

    fn has_ended(&mut self, rank: usize) -> bool {
        let Some(link) = self.links.get_mut(rank) else { return false };
        let pid = link.heartbeat.get().pid as u32;
        pid != 0 && link.watch.get_or_insert_with(|| ProcessWatch::new(pid)).has_ended()
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
            .add(KEY_HEARTBEAT, Beat::default())
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
