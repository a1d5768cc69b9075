//! [`Launcher`] whose workers are threads.

use std::io;
use std::sync::Arc;
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use super::channel::{Shared, WorkerSeat};
use crate::transport::{Launcher, Life};

/// Time that a thread gets to reach its next call after it was given up; then it is left running.
const PATIENCE: Duration = Duration::from_secs(10);
/// Pause between two checks of a thread.
const LOOK: Duration = Duration::from_millis(1);

/// Job of a worker's thread, which gets its seat.
pub type ThreadJob = Box<dyn FnOnce(WorkerSeat) + Send>;

/// Starts workers as threads of this process.
pub struct ThreadLauncher {
    workers: Vec<Worker>,
}

struct Worker {
    start: Option<(WorkerSeat, ThreadJob)>,
    thread: Option<JoinHandle<()>>,
    started: bool,
    shared: Arc<Shared>,
}

impl ThreadLauncher {
    /// A launcher for the workers of `seats`, in the order of their ranks. `job` makes the job of rank r.
    pub fn new(seats: Vec<WorkerSeat>, mut job: impl FnMut(usize) -> ThreadJob) -> ThreadLauncher {
        let worker = |seat: WorkerSeat| {
            let shared = seat.shared().clone();
            let job = job(seat.rank());
            Worker { start: Some((seat, job)), thread: None, started: false, shared }
        };
        ThreadLauncher { workers: seats.into_iter().map(worker).collect() }
    }
}

impl Launcher for ThreadLauncher {
    fn start(&mut self, rank: usize) -> io::Result<()> {
        let worker = &mut self.workers[rank];
        let taken = worker.start.take();
        let (seat, job) = taken.ok_or_else(|| io::Error::other("it was started before"))?;
        worker.thread = Some(Builder::new().name(format!("worker {rank}")).spawn(move || job(seat))?);
        worker.started = true;
        Ok(())
    }

    fn life(&mut self, rank: usize) -> Life {
        match &self.workers[rank] {
            Worker { started: false, .. } => Life::NotStarted,
            Worker { thread: Some(thread), .. } if !thread.is_finished() => Life::Running,
            _ => Life::Ended,
        }
    }

    fn describe(&self, rank: usize) -> String {
        format!("thread {rank} of process {}", std::process::id())
    }

    fn kill(&mut self, rank: usize) {
        self.workers[rank].shared.cut(rank);
    }

    fn wait(&mut self, rank: usize) {
        let Some(thread) = self.workers[rank].thread.take() else { return };
        let start = Instant::now();
        while !thread.is_finished() {
            if start.elapsed() >= PATIENCE {
                tracing::warn!("the thread of worker {rank} does not end and is left behind");
                return;
            }
            std::thread::sleep(LOOK);
        }
        // The panic has been printed, and the coordinator has detected the worker's end.
        let _ = thread.join();
    }

    /// Threads leave no files.
    fn clean_up(&mut self) {}
}
