//! [`crate::transport::control`] between threads of one process: queues under one lock.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::transport::{ControlCoordinator, ControlError, ControlWorker, Heartbeat};

/// Longest sleep of a worker between two signs of life.
const BEAT: Duration = Duration::from_millis(20);
/// How a worker names its coordinator.
const HERE: &str = "a thread of this process";

/// A channel for `ranks` workers: the coordinator's end and the workers' seats, by rank.
pub fn thread_channel(ranks: usize) -> (ThreadCoordinator, Vec<WorkerSeat>) {
    let links = (0..ranks).map(|_| Link::default()).collect();
    let shared = Arc::new(Shared {
        state: Mutex::new(State { links, coordinator_gone: false, news: 0 }),
        changed: Condvar::new(),
    });
    let seats = (0..ranks).map(|rank| WorkerSeat { rank, shared: shared.clone() }).collect();
    (ThreadCoordinator { ranks, shared, seen: 0 }, seats)
}

pub(super) struct Shared {
    state: Mutex<State>,
    /// Notified after every change.
    changed: Condvar,
}

struct State {
    links: Vec<Link>,
    coordinator_gone: bool,
    /// Counts the changes that workers make: messages sent and received, and their end.
    news: u64,
}

#[derive(Default)]
struct Link {
    /// Messages to the worker and from it.
    down: VecDeque<Vec<u8>>,
    up: VecDeque<Vec<u8>>,
    heartbeat: Heartbeat,
    worker_gone: bool,
    /// The worker was given up; for it the coordinator has ended.
    cut: bool,
}

impl Shared {
    /// Every change under the lock is complete, so the state stays consistent if a thread panics with it.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A change made by the coordinator.
    fn change(&self, change: impl FnOnce(&mut State)) {
        change(&mut self.lock());
        self.changed.notify_all();
    }

    /// A change by a worker, which must wake the coordinator.
    fn report(&self, mut state: MutexGuard<'_, State>) {
        state.news += 1;
        drop(state);
        self.changed.notify_all();
    }

    /// Sleeps until something changes, at most `limit`.
    fn sleep<'a>(&self, state: MutexGuard<'a, State>, limit: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, limit).unwrap_or_else(PoisonError::into_inner).0
    }

    /// Makes worker `rank` believe that its coordinator has ended.
    pub(super) fn cut(&self, rank: usize) {
        self.change(|state| state.links[rank].cut = true);
    }
}

/// The coordinator's end. The workers detect its end when it is dropped.
pub struct ThreadCoordinator {
    ranks: usize,
    shared: Arc<Shared>,
    /// Number of changes that it has been woken for.
    seen: u64,
}

impl ThreadCoordinator {
    fn check(&self, rank: usize) -> Result<(), ControlError> {
        let ranks = self.ranks;
        if rank < ranks { Ok(()) } else { Err(ControlError::NoSuchRank { rank, ranks }) }
    }
}

impl Drop for ThreadCoordinator {
    fn drop(&mut self) {
        self.shared.change(|state| state.coordinator_gone = true);
    }
}

impl ControlCoordinator for ThreadCoordinator {
    fn ranks(&self) -> usize {
        self.ranks
    }

    fn send(&mut self, rank: usize, message: Vec<u8>) -> Result<(), ControlError> {
        self.check(rank)?;
        self.shared.change(|state| state.links[rank].down.push_back(message));
        Ok(())
    }

    fn all_sent(&self, rank: usize) -> bool {
        self.shared.lock().links.get(rank).is_none_or(|link| link.down.is_empty())
    }

    fn try_receive(&mut self, rank: usize) -> Result<Option<Vec<u8>>, ControlError> {
        self.check(rank)?;
        let message = self.shared.lock().links[rank].up.pop_front();
        if message.is_some() {
            self.shared.changed.notify_all();
        }
        Ok(message)
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), ControlError> {
        let mut state = self.shared.lock();
        if state.news == self.seen {
            state = self.shared.sleep(state, timeout);
        }
        self.seen = state.news;
        Ok(())
    }

    fn heartbeat(&self, rank: usize) -> Heartbeat {
        self.shared.lock().links.get(rank).map_or(Heartbeat::default(), |link| link.heartbeat)
    }

    fn has_ended(&mut self, rank: usize) -> bool {
        self.shared.lock().links.get(rank).is_some_and(|link| link.worker_gone)
    }
}

/// A worker's place; the worker's thread turns it into its end of the channel.
pub struct WorkerSeat {
    rank: usize,
    shared: Arc<Shared>,
}

impl WorkerSeat {
    /// The place's rank.
    pub fn rank(&self) -> usize {
        self.rank
    }

    pub(super) fn shared(&self) -> &Arc<Shared> {
        &self.shared
    }

    /// Connects the calling thread with its coordinator, which detects the worker's end when the returned value is
    /// dropped.
    pub fn connect(self) -> ThreadWorker {
        let worker = ThreadWorker { rank: self.rank, shared: self.shared };
        worker.beat();
        worker
    }
}

/// A worker's end.
pub struct ThreadWorker {
    rank: usize,
    shared: Arc<Shared>,
}

impl ThreadWorker {
    fn gone(&self, state: &State) -> Result<(), ControlError> {
        let gone = state.coordinator_gone || state.links[self.rank].cut;
        if gone { Err(ControlError::CoordinatorGone { who: HERE.to_string() }) } else { Ok(()) }
    }
}

impl Drop for ThreadWorker {
    fn drop(&mut self) {
        let mut state = self.shared.lock();
        state.links[self.rank].worker_gone = true;
        self.shared.report(state);
    }
}

impl ControlWorker for ThreadWorker {
    fn beat(&self) {
        self.shared.lock().links[self.rank].heartbeat.counter += 1;
    }

    fn progress(&self, step: u64) {
        let heartbeat = &mut self.shared.lock().links[self.rank].heartbeat;
        (heartbeat.counter, heartbeat.step) = (heartbeat.counter + 1, step);
    }

    fn coordinator_has_ended(&self) -> bool {
        self.gone(&self.shared.lock()).is_err()
    }

    fn send(&mut self, message: Vec<u8>) -> Result<(), ControlError> {
        let mut state = self.shared.lock();
        self.gone(&state)?;
        let link = &mut state.links[self.rank];
        link.heartbeat.counter += 1;
        link.up.push_back(message);
        self.shared.report(state);
        Ok(())
    }

    fn flush(&mut self) -> Result<(), ControlError> {
        let mut state = self.shared.lock();
        while !state.links[self.rank].up.is_empty() {
            self.gone(&state)?;
            state.links[self.rank].heartbeat.counter += 1;
            state = self.shared.sleep(state, BEAT);
        }
        Ok(())
    }

    fn try_receive(&mut self) -> Result<Option<Vec<u8>>, ControlError> {
        let mut state = self.shared.lock();
        let message = state.links[self.rank].down.pop_front();
        if message.is_some() {
            self.shared.report(state);
        }
        Ok(message)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Vec<u8>>, ControlError> {
        let start = Instant::now();
        let mut state = self.shared.lock();
        loop {
            let link = &mut state.links[self.rank];
            link.heartbeat.counter += 1;
            if let Some(message) = link.down.pop_front() {
                self.shared.report(state);
                return Ok(Some(message));
            }
            self.gone(&state)?;
            let waited = start.elapsed();
            if waited >= timeout {
                return Ok(None);
            }
            state = self.shared.sleep(state, BEAT.min(timeout - waited));
        }
    }
}
