//! The worker's end of a [`crate::transport::control`] channel between processes of one machine.

use std::cell::Cell;
use std::time::{Duration, Instant};

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::reader::{EntryHandle, Reader};
use iceoryx2::port::writer::{EntryHandleMut, Writer};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{blackboard, event};

use super::control::{Beat, KEY_CONSUMED, KEY_HEARTBEAT, KEY_PID, Names};
use super::frame_ports::{FrameReceiver, FrameSender, FrameService, open_stream};
use super::node::{Ipc, OpenError, create_node, open_when_created, text};
use crate::os::clock::AwakeClock;
use crate::transport::process::ProcessWatch;
use crate::transport::wait::{Patience, Stopped};
use crate::transport::{ControlError, ControlWorker, RANKS_MAX, RunName, shared_memory};

/// Longest sleep between two signs of life during a wait for the coordinator.
const BEAT: Duration = Duration::from_millis(20);

/// The control end of a worker process.
pub struct IceoryxWorker {
    deadline: Duration,
    sender: FrameSender,
    receiver: FrameReceiver,
    heartbeat: EntryHandleMut<Ipc, u64, Beat>,
    /// Current value of `heartbeat`.
    beat: Cell<Beat>,
    coordinator: ProcessWatch,
    /// Number of frames received from the coordinator, published for the coordinator.
    taken: EntryHandleMut<Ipc, u64, u64>,
    /// Number of frames that the coordinator has received.
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

impl IceoryxWorker {
    /// Connects worker `rank` of `run` with its coordinator. `deadline` bounds this and every later call that sends.
    ///
    /// # Errors
    /// The coordinator did not appear within the deadline, has no place for this rank, or another process has taken the
    /// place.
    pub fn connect(run: &RunName, rank: usize, deadline: Duration) -> Result<IceoryxWorker, ControlError> {
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
        // The own place is claimed first, so that a second process of this rank gets this error and not that of another
        // limit.
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
        // The listener must exist before the subscriber, because a message to the subscriber wakes the listener.
        let own_wake = open_when_created(&mut patience, "worker's wake-up service", || wake(&names.wake))?;
        let listener = own_wake.listener_builder().create().map_err(text("worker's listener"))?;
        let up = open_when_created(&mut patience, "control stream", || open_stream(&node, &names.up))?;
        let sender = FrameSender::new(&up)?;
        let down = open_when_created(&mut patience, "control stream", || open_stream(&node, &names.down))?;
        let receiver = FrameReceiver::new(&down)?;
        shared_memory::reserve(run).map_err(|error| error.to_string())?;

        let coordinator = ProcessWatch::new(*pid.get() as u32);
        let worker = IceoryxWorker {
            deadline,
            sender,
            receiver,
            heartbeat,
            beat: Cell::new(Beat { pid: u64::from(std::process::id()), ..Beat::default() }),
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
        };
        worker.beat();
        let _ = worker.notifier.notify();
        Ok(worker)
    }

    fn wait_until(&mut self, what: &'static str, done: impl Fn(&Self) -> bool) -> Result<(), ControlError> {
        let mut clock = AwakeClock::start();
        loop {
            self.pump()?;
            if done(self) {
                return Ok(());
            }
            self.check_coordinator()?;
            let waited = clock.elapsed();
            // A coordinator that the user has suspended (Ctrl-Z) may continue later.
            if waited >= self.deadline && self.coordinator.is_stopped() {
                clock = AwakeClock::start();
            } else if waited >= self.deadline {
                return Err(ControlError::TimedOut { what, waited_s: waited.as_secs_f64() });
            }
            self.sleep(self.deadline.saturating_sub(waited))?;
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
            true => Err(ControlError::CoordinatorGone { who: format!("process {}", self.coordinator.pid()) }),
            false => Ok(()),
        }
    }

    fn sleep(&self, limit: Duration) -> Result<(), ControlError> {
        self.beat();
        match self.listener.timed_wait(|_| {}, limit.min(BEAT)) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
            Err(error) => Err(format!("waiting for the coordinator: {error:?}").into()),
        }
    }
}

impl ControlWorker for IceoryxWorker {
    fn beat(&self) {
        self.beat.update(|beat| Beat { counter: beat.counter + 1, ..beat });
        self.heartbeat.update_with_copy(self.beat.get());
    }

    fn progress(&self, step: u64) {
        self.beat.update(|beat| Beat { step, ..beat });
        self.beat();
    }

    fn coordinator_has_ended(&self) -> bool {
        self.coordinator.has_ended()
    }

    /// Returns when at most two frames are not yet received.
    fn send(&mut self, message: Vec<u8>) -> Result<(), ControlError> {
        self.sender.outbox.push(message);
        self.wait_until("the coordinator to take a message", |worker| worker.sender.outbox.is_empty())
    }

    fn flush(&mut self) -> Result<(), ControlError> {
        self.wait_until("the coordinator to take the last message", |worker| {
            worker.sender.outbox.is_empty() && *worker.taken_by_coordinator.get() >= worker.sender.outbox.frames_sent()
        })
    }

    fn try_receive(&mut self) -> Result<Option<Vec<u8>>, ControlError> {
        while let Some(taken) = self.receiver.take()? {
            self.taken.update_with_copy(self.receiver.consumed());
            let _ = self.notifier.notify();
            if taken.is_some() {
                return Ok(taken);
            }
        }
        Ok(None)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Vec<u8>>, ControlError> {
        let start = Instant::now();
        loop {
            // Checked before the receipt, so that messages sent before its end are still received.
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
