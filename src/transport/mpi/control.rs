//! Both ends of a [`crate::transport::control`] channel between processes of a world, and their launcher.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::library::Library;
use super::pause::Pause;
use super::stream::{Incoming, Kind, Outgoing};
use super::tags;
use super::vitals::{LOST_AFTER, Vitals};
use crate::os::clock::AwakeClock;
use crate::transport::{ControlCoordinator, ControlError, ControlWorker, Heartbeat, Launcher, Life};

/// Longest time for which a worker waits until the coordinator takes a message.
const DEADLINE: Duration = Duration::from_secs(60);

/// A crew as both its channel and its launcher see it.
pub(super) struct Crew {
    /// Number of the crew, counting from 1.
    pub number: u32,
    /// Process of worker 0.
    pub first: usize,
    /// By rank.
    pub members: Vec<Seat>,
}

/// A worker of a crew.
#[derive(Default)]
pub(super) struct Seat {
    started: AtomicBool,
    left: AtomicBool,
}

/// The coordinator's end.
pub(super) struct MpiCoordinator {
    vitals: Arc<Vitals>,
    crew: Arc<Crew>,
    down: Vec<Outgoing>,
    up: Vec<Incoming>,
    received: Vec<VecDeque<Vec<u8>>>,
}

impl MpiCoordinator {
    pub(super) fn new(library: &Library, vitals: &Arc<Vitals>, crew: &Arc<Crew>) -> MpiCoordinator {
        let processes = crew.first..crew.first + crew.members.len();
        MpiCoordinator {
            vitals: vitals.clone(),
            crew: crew.clone(),
            down: processes.clone().map(|process| Outgoing::new(library, process, tags::DOWN, crew.number)).collect(),
            up: processes.map(|process| Incoming::new(library, process, tags::UP, crew.number)).collect(),
            received: vec![VecDeque::new(); crew.members.len()],
        }
    }

    /// Sends and receives what can be. True if a message has come.
    fn pump(&mut self) -> Result<bool, ControlError> {
        let mut news = false;
        for rank in 0..self.up.len() {
            if self.is_lost(rank) {
                continue;
            }
            self.down[rank].pump()?;
            while let Some((kind, message)) = self.up[rank].next()? {
                news = true;
                match kind {
                    Kind::Message => self.received[rank].push_back(message),
                    Kind::Left => self.crew.members[rank].left.store(true, Ordering::Relaxed),
                }
            }
        }
        Ok(news)
    }

    fn is_lost(&self, rank: usize) -> bool {
        self.vitals.is_lost(self.crew.first + rank)
    }

    fn check(&self, rank: usize) -> Result<(), ControlError> {
        let ranks = self.up.len();
        if rank < ranks { Ok(()) } else { Err(ControlError::NoSuchRank { rank, ranks }) }
    }
}

impl ControlCoordinator for MpiCoordinator {
    fn ranks(&self) -> usize {
        self.up.len()
    }

    fn send(&mut self, rank: usize, message: Vec<u8>) -> Result<(), ControlError> {
        self.check(rank)?;
        self.down[rank].push(Kind::Message, &message);
        if self.is_lost(rank) { Ok(()) } else { self.down[rank].pump() }
    }

    fn all_sent(&self, rank: usize) -> bool {
        self.down.get(rank).is_none_or(Outgoing::is_sent)
    }

    fn try_receive(&mut self, rank: usize) -> Result<Option<Vec<u8>>, ControlError> {
        self.check(rank)?;
        if self.received[rank].is_empty() {
            self.pump()?;
        }
        Ok(self.received[rank].pop_front())
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), ControlError> {
        let start = Instant::now();
        let mut pause = Pause::default();
        while !self.pump()? && start.elapsed() < timeout && self.received.iter().all(VecDeque::is_empty) {
            pause.rest();
        }
        Ok(())
    }

    fn heartbeat(&self, rank: usize) -> Heartbeat {
        self.vitals.heartbeat(self.crew.first + rank, self.crew.number)
    }

    fn has_ended(&mut self, rank: usize) -> bool {
        // An error of the channel is that of the next call.
        let _ = self.pump();
        rank < self.up.len() && (self.is_lost(rank) || self.crew.members[rank].left.load(Ordering::Relaxed))
    }
}

/// Starts workers by a message to their processes, which wait for it.
pub(super) struct MpiLauncher {
    pub library: Library,
    pub vitals: Arc<Vitals>,
    pub crew: Arc<Crew>,
    /// By process: what it is called.
    pub names: Arc<Vec<String>>,
    /// Set where a process can be ended only with all others.
    pub must_abort: Arc<AtomicBool>,
    /// Messages that MPI may still read.
    pub sent: Mutex<Vec<Outgoing>>,
}

impl MpiLauncher {
    fn seat(&self, rank: usize) -> &Seat {
        &self.crew.members[rank]
    }

    fn tell(&self, rank: usize, tag: i32, words: &[u64]) -> Result<(), ControlError> {
        let mut message = Outgoing::new(&self.library, self.crew.first + rank, tag, self.crew.number);
        message.push(Kind::Message, bytemuck::cast_slice(words));
        message.pump()?;
        self.sent.lock().unwrap_or_else(PoisonError::into_inner).push(message);
        Ok(())
    }
}

impl Launcher for MpiLauncher {
    fn start(&mut self, rank: usize) -> io::Result<()> {
        let Crew { number, first, members } = &*self.crew;
        let words = [u64::from(*number), rank as u64, members.len() as u64, *first as u64];
        self.tell(rank, tags::BEGIN, &words).map_err(io::Error::other)?;
        self.seat(rank).started.store(true, Ordering::Relaxed);
        Ok(())
    }

    fn life(&mut self, rank: usize) -> Life {
        let Seat { started, left } = self.seat(rank);
        match started.load(Ordering::Relaxed) {
            false => Life::NotStarted,
            true if left.load(Ordering::Relaxed) || self.vitals.is_lost(self.crew.first + rank) => Life::Ended,
            true => Life::Running,
        }
    }

    fn end_of(&mut self, rank: usize) -> Option<String> {
        let lost = self.vitals.is_lost(self.crew.first + rank);
        lost.then(|| format!("nothing was heard from it for {} s", LOST_AFTER.as_secs()))
    }

    fn work_of(&self, rank: usize) -> Option<u64> {
        self.vitals.work(self.crew.first + rank)
    }

    fn describe(&self, rank: usize) -> String {
        self.names[self.crew.first + rank].clone()
    }

    /// A worker that listens leaves; one that does not is ended with all others when the program ends.
    fn kill(&mut self, rank: usize) {
        if self.life(rank) == Life::Running {
            self.must_abort.store(true, Ordering::Relaxed);
            // Who cannot be reached is lost, which is found by its silence.
            let _ = self.tell(rank, tags::CUT, &[]);
        }
    }

    /// The processes go on, to wait for the next crew.
    fn wait(&mut self, _rank: usize) {}

    fn clean_up(&mut self) {}
}

/// A worker's end.
pub(super) struct MpiWorker {
    vitals: Arc<Vitals>,
    up: Outgoing,
    down: Incoming,
    /// A coordinator that gives up this worker says so here.
    cut: RefCell<Incoming>,
    is_cut: RefCell<bool>,
    coordinator: String,
    pause: Pause,
}

impl MpiWorker {
    /// The end of the worker of this process in crew `crew`.
    pub(super) fn new(library: &Library, vitals: &Arc<Vitals>, crew: u32, coordinator: String) -> MpiWorker {
        vitals.begin(crew);
        vitals.beat();
        MpiWorker {
            vitals: vitals.clone(),
            up: Outgoing::new(library, 0, tags::UP, crew),
            down: Incoming::new(library, 0, tags::DOWN, crew),
            cut: RefCell::new(Incoming::new(library, 0, tags::CUT, crew)),
            is_cut: RefCell::new(false),
            coordinator,
            pause: Pause::default(),
        }
    }

    fn check_coordinator(&self) -> Result<(), ControlError> {
        match self.coordinator_has_ended() {
            true => Err(ControlError::CoordinatorGone { who: self.coordinator.clone() }),
            false => Ok(()),
        }
    }

    fn wait_until(&mut self, what: &'static str, done: impl Fn(&Outgoing) -> bool) -> Result<(), ControlError> {
        let mut clock = AwakeClock::start();
        loop {
            self.up.pump()?;
            if done(&self.up) {
                return Ok(());
            }
            self.check_coordinator()?;
            self.beat();
            let waited = clock.elapsed();
            if waited >= DEADLINE {
                return Err(ControlError::TimedOut { what, waited_s: waited.as_secs_f64() });
            }
            self.pause.rest();
        }
    }
}

impl ControlWorker for MpiWorker {
    fn beat(&self) {
        self.vitals.beat();
    }

    fn progress(&self, step: u64) {
        self.vitals.set_step(step);
    }

    /// The end of its process is noticed by [`super::vitals`], which then ends this process.
    fn coordinator_has_ended(&self) -> bool {
        let mut is_cut = self.is_cut.borrow_mut();
        *is_cut |= matches!(self.cut.borrow_mut().next(), Ok(Some(_)));
        *is_cut
    }

    fn send(&mut self, message: Vec<u8>) -> Result<(), ControlError> {
        self.check_coordinator()?;
        self.beat();
        self.up.push(Kind::Message, &message);
        self.pause = Pause::default();
        self.wait_until("the coordinator to take a message", Outgoing::is_sent)
    }

    fn flush(&mut self) -> Result<(), ControlError> {
        self.wait_until("the coordinator to take the last message", Outgoing::is_complete)
    }

    fn try_receive(&mut self) -> Result<Option<Vec<u8>>, ControlError> {
        self.up.pump()?;
        Ok(self.down.next()?.map(|(_, message)| message))
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Vec<u8>>, ControlError> {
        let start = Instant::now();
        self.pause = Pause::default();
        loop {
            self.beat();
            // Checked before the receipt, so that messages sent before its end are still received.
            let coordinator = self.check_coordinator();
            if let Some(message) = self.try_receive()? {
                return Ok(Some(message));
            }
            coordinator?;
            if start.elapsed() >= timeout {
                return Ok(None);
            }
            self.pause.rest();
        }
    }
}

impl Drop for MpiWorker {
    fn drop(&mut self) {
        self.up.push(Kind::Left, &[]);
        // Where nobody takes it, nobody needs it.
        let _ = self.flush();
    }
}
