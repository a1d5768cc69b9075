//! The worker's end of the control channel.

use std::cell::Cell;
use std::rc::Rc;
use std::time::{Duration, Instant};

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::reader::{EntryHandle, Reader};
use iceoryx2::port::writer::{EntryHandleMut, Writer};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{blackboard, event};

use super::control::{ControlError, Heartbeat, KEY_CONSUMED, KEY_HEARTBEAT, KEY_PID, Names};
use super::frame_ports::{FrameReceiver, FrameSender, FrameService, open_stream};
use super::node::{Ipc, OpenError, create_node, open_when_created, text};
use crate::transport::process::ProcessWatch;
use crate::transport::wait::{Patience, Stopped};
use crate::transport::{RANKS_MAX, RunName, shared_memory};

/// Longest sleep between two signs of life while waiting for the coordinator.
const BEAT: Duration = Duration::from_millis(20);

/// A worker's end of the control channel. Bound to the thread that made it.
pub struct ControlWorker {
    deadline: Duration,
    sender: FrameSender,
    receiver: FrameReceiver,
    heartbeat: HeartbeatHandle,
    coordinator: ProcessWatch,
    /// Frames taken from the coordinator, for it to see.
    taken: EntryHandleMut<Ipc, u64, u64>,
    /// Frames that the coordinator has taken.
    taken_by_coordinator: EntryHandle<Ipc, u64, u64>,
    listener: Listener<Ipc>,
    notifier: Notifier<Ipc>,
    _writer: Writer<Ipc, u64>,
    _reader: Reader<Ipc, u64>,
    _boards: [blackboard::PortFactory<Ipc, u64>; 2],
    _wakes: [event::PortFactory<Ipc>; 2],
    _streams: [FrameService; 2],
    _node: Node<Ipc>,
}

/// Gives a worker's signs of life; clones share one heartbeat, so that a wait hook can own one.
#[derive(Clone)]
pub struct HeartbeatHandle {
    shared: Rc<(EntryHandleMut<Ipc, u64, Heartbeat>, Cell<Heartbeat>)>,
}

impl HeartbeatHandle {
    /// A sign of life.
    pub fn beat(&self) {
        let (entry, newest) = &*self.shared;
        newest.update(|heartbeat| Heartbeat { counter: heartbeat.counter + 1, ..heartbeat });
        entry.update_with_copy(newest.get());
    }

    /// A sign of life that says where the worker is.
    pub fn progress(&self, step: u64, phase: u64) {
        self.shared.1.update(|heartbeat| Heartbeat { step, phase, ..heartbeat });
        self.beat();
    }
}

impl ControlWorker {
    /// Connects worker `rank` of `run` with its coordinator. `deadline` bounds this and every later [`ControlWorker::send`].
    ///
    /// # Errors
    /// There is no coordinator within the deadline, it made no place for this rank, or another process has taken it.
    pub fn connect(run: &RunName, rank: usize, deadline: Duration) -> Result<ControlWorker, ControlError> {
        if rank >= RANKS_MAX {
            return Err(ControlError::NoSuchRank { rank, ranks: RANKS_MAX });
        }
        let mut patience = Patience::new(deadline, usize::MAX, Box::new(|| false));
        let node = create_node(run, &format!("worker {rank}"))?;
        let (board_name, wake_name) = Names::of_coordinator()?;
        let names = Names::of_rank(rank)?;
        let board = |name: &ServiceName| node.service_builder(name).blackboard_opener::<u64>().open();
        let wake = |name: &ServiceName| node.service_builder(name).event().open();

        let their_board = open_when_created(&mut patience, "coordinator's blackboard", || board(&board_name))?;
        let reader = their_board.reader_builder().create().map_err(text("coordinator's blackboard"))?;
        let pid: EntryHandle<Ipc, u64, u64> = reader.entry(&KEY_PID).map_err(text("coordinator's process"))?;
        let taken_by_coordinator = reader.entry(&(KEY_CONSUMED + rank as u64));
        let taken_by_coordinator =
            taken_by_coordinator.map_err(|_| format!("the coordinator has made no place for rank {rank}"))?;
        // The own place comes before everything shared: who finds it taken learns that and not another limit.
        let own_board = open_when_created(&mut patience, "worker's blackboard", || board(&names.worker));
        let own_board = own_board.map_err(|error| match error {
            OpenError::Failed(message) if message.contains("Exceeds") => {
                ControlError::Mechanism { message: format!("rank {rank} is taken by another process already") }
            }
            other => ControlError::from(other),
        })?;
        let their_wake = open_when_created(&mut patience, "coordinator's wake-up service", || wake(&wake_name))?;
        let notifier = their_wake.notifier_builder().create().map_err(text("coordinator's notifier"))?;

        let writer = own_board.writer_builder().create().map_err(text("worker's blackboard"))?;
        let taken = writer.entry(&KEY_CONSUMED).map_err(text("worker's blackboard"))?;
        let heartbeat = writer.entry(&KEY_HEARTBEAT).map_err(text("worker's blackboard"))?;
        // The listener must be there before the subscriber is: what is sent to the one wakes the other.
        let own_wake = open_when_created(&mut patience, "worker's wake-up service", || wake(&names.wake))?;
        let listener = own_wake.listener_builder().create().map_err(text("worker's listener"))?;
        let up = open_when_created(&mut patience, "control stream", || open_stream(&node, &names.up))?;
        let sender = FrameSender::new(&up)?;
        let down = open_when_created(&mut patience, "control stream", || open_stream(&node, &names.down))?;
        let receiver = FrameReceiver::new(&down)?;
        shared_memory::reserve(run).map_err(|error| error.to_string())?;

        let pid = *pid.get() as u32;
        let coordinator = ProcessWatch::new(pid).map_err(|error| format!("cannot watch process {pid}: {error}"))?;
        let first = Heartbeat { pid: u64::from(std::process::id()), ..Heartbeat::default() };
        let heartbeat = HeartbeatHandle { shared: Rc::new((heartbeat, Cell::new(first))) };
        heartbeat.beat();
        let _ = notifier.notify();
        Ok(ControlWorker {
            deadline,
            sender,
            receiver,
            heartbeat,
            coordinator,
            taken,
            taken_by_coordinator,
            listener,
            notifier,
            _writer: writer,
            _reader: reader,
            _boards: [own_board, their_board],
            _wakes: [own_wake, their_wake],
            _streams: [up, down],
            _node: node,
        })
    }

    /// The worker's heartbeat, to be given by its wait hook and its steps. Waiting in this type gives it too.
    pub fn heartbeat(&self) -> HeartbeatHandle {
        self.heartbeat.clone()
    }

    /// True once the coordinator has ended, for whatever reason.
    pub fn coordinator_has_ended(&self) -> bool {
        self.coordinator.has_ended()
    }

    /// Sends `message`; returns when all of it is on its way, that is, at most two frames are not yet taken.
    ///
    /// # Errors
    /// The coordinator has ended or takes nothing within the deadline.
    pub fn send(&mut self, message: impl Into<Vec<u8>>) -> Result<(), ControlError> {
        self.sender.outbox.push(message.into());
        self.wait_until("the coordinator to take a message", |worker| worker.sender.outbox.is_empty())
    }

    /// Waits until the coordinator has taken everything sent. A worker that leaves without this may take its last
    /// messages with it.
    pub fn flush(&mut self) -> Result<(), ControlError> {
        self.wait_until("the coordinator to take the last message", |worker| {
            worker.sender.outbox.is_empty() && *worker.taken_by_coordinator.get() >= worker.sender.outbox.frames_sent()
        })
    }

    fn wait_until(&mut self, what: &'static str, done: impl Fn(&Self) -> bool) -> Result<(), ControlError> {
        let start = Instant::now();
        loop {
            self.pump()?;
            if done(self) {
                return Ok(());
            }
            self.check_coordinator()?;
            let waited = start.elapsed();
            if waited >= self.deadline {
                return Err(ControlError::TimedOut { what, waited_s: waited.as_secs_f64() });
            }
            self.sleep(self.deadline - waited)?;
        }
    }

    /// The next complete message of the coordinator, if there is one. Never waits.
    pub fn try_receive(&mut self) -> Result<Option<Vec<u8>>, ControlError> {
        while let Some(taken) = self.receiver.take()? {
            self.taken.update_with_copy(self.receiver.consumed());
            let _ = self.notifier.notify();
            if taken.is_some() {
                return Ok(taken);
            }
        }
        Ok(None)
    }

    /// The next message of the coordinator; none if there is none within `timeout`.
    ///
    /// # Errors
    /// The coordinator has ended and left nothing to receive.
    pub fn receive(&mut self, timeout: Duration) -> Result<Option<Vec<u8>>, ControlError> {
        let start = Instant::now();
        loop {
            // Asked before looking: what it sent before it ended is still received.
            let coordinator = self.check_coordinator();
            if let Some(message) = self.try_receive()? {
                return Ok(Some(message));
            }
            coordinator?;
            let waited = start.elapsed();
            if waited >= timeout {
                return Ok(None);
            }
            self.sleep(timeout - waited)?;
        }
    }

    fn pump(&mut self) -> Result<(), ControlError> {
        if self.sender.pump(*self.taken_by_coordinator.get())? {
            let _ = self.notifier.notify();
        }
        Ok(())
    }

    fn check_coordinator(&self) -> Result<(), ControlError> {
        match self.coordinator.has_ended() {
            true => Err(ControlError::CoordinatorGone { pid: self.coordinator.pid() }),
            false => Ok(()),
        }
    }

    fn sleep(&self, limit: Duration) -> Result<(), ControlError> {
        self.heartbeat.beat();
        match self.listener.timed_wait(|_| {}, limit.min(BEAT)) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
            Err(error) => Err(format!("waiting for the coordinator: {error:?}").into()),
        }
    }
}

impl From<OpenError> for ControlError {
    fn from(error: OpenError) -> ControlError {
        match error {
            OpenError::Stopped(Stopped::TimedOut { waited_s }) => {
                ControlError::TimedOut { what: "the coordinator to start", waited_s }
            }
            OpenError::Stopped(Stopped::Aborted) => ControlError::Mechanism { message: "told to stop".to_string() },
            OpenError::Failed(message) => ControlError::Mechanism { message },
        }
    }
}
