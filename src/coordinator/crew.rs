//! The workers of a run as seen by the coordinator: started (or waited for), spoken to, watched, and gone afterwards.
//! Says nothing about what is simulated.

use std::io::Write;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use thiserror::Error;

use crate::protocol::{ToCoordinator, ToWorker};
use crate::step::Failure;
use crate::transport::{ControlCoordinator, ControlError, MessageError, RunError, RunMember, RunName, decode, encode};

/// How long workers get to leave by themselves before they are killed.
const FAREWELL: Duration = Duration::from_secs(2);
/// Longest sleep between two looks at the workers.
const LOOK: Duration = Duration::from_millis(50);
/// How long the other workers get to explain a failure better than the first report of it does.
const ECHO: Duration = Duration::from_millis(500);

/// Where the workers come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Launch {
    /// Start them as children of this process.
    Spawn,
    /// Somebody else starts them (`loomtree-worker --run ID --rank R`); print the run's identifier for that.
    Await,
}

/// Why the crew cannot go on.
#[derive(Debug, Error)]
pub enum CrewError {
    /// A worker ended although nobody told it to.
    #[error("worker {rank} (process {pid}) ended unexpectedly {place}")]
    Died { rank: usize, pid: u32, place: String },
    /// A worker gives no sign of life.
    #[error("worker {rank} (process {pid}) hangs {place}: no sign of life for {silence_s:.1} s")]
    Hung { rank: usize, pid: u32, place: String, silence_s: f64 },
    /// A worker never came.
    #[error("worker {rank} did not start within {waited_s:.0} s")]
    Missing { rank: usize, waited_s: f64 },
    /// A worker reported that it cannot go on.
    #[error("worker {rank}: {failure}")]
    Failed { rank: usize, failure: Failure },
    /// A worker process could not be started.
    #[error("cannot start worker {rank}: {source}")]
    Spawn { rank: usize, source: std::io::Error },
    /// The channel to the workers.
    #[error(transparent)]
    Control(#[from] ControlError),
    /// A worker said something else than it should.
    #[error("message of worker {rank}: {source}")]
    Message { rank: usize, source: MessageError },
    /// A worker answered something else than was asked.
    #[error("worker {rank} answered out of turn")]
    OutOfTurn { rank: usize },
    /// The run's resources.
    #[error(transparent)]
    Run(#[from] RunError),
}

impl CrewError {
    /// The sentence for the user; `vertex_name` names the vertex of a global row.
    pub fn sentence(&self, vertex_name: &dyn Fn(u32) -> String) -> String {
        match self {
            // About the scene, whichever rank saw it.
            CrewError::Failed { failure, .. } if weight(self) == 2 => failure.sentence(vertex_name),
            other => other.to_string(),
        }
    }

    /// True if the user can mend it before the run starts.
    pub fn is_bad_input(&self) -> bool {
        matches!(self, CrewError::Failed { failure: Failure::BadInput(_), .. })
    }
}

/// The workers of one run.
pub struct Crew {
    control: ControlCoordinator,
    children: Vec<Child>,
    heartbeat_limit: Duration,
    /// By rank: has reported that it cannot go on, so its end is no news.
    gave_up: Vec<bool>,
    /// When the first such report came, and the one that explains most.
    reported: Option<(Instant, CrewError)>,
    run: RunName,
    // Dropped last: as long as it lives, the run counts as alive.
    _member: RunMember,
}

impl Crew {
    /// Starts (or waits for) `ranks` workers. A worker that is silent for `heartbeat_limit` counts as hung.
    pub fn assemble(ranks: usize, launch: &Launch, heartbeat_limit: Duration) -> Result<Crew, CrewError> {
        let (run, member) = RunName::create("coordinator")?;
        let control = ControlCoordinator::create(&run, ranks)?;
        let (children, gave_up) = (Vec::new(), vec![false; ranks]);
        let mut crew = Crew { control, children, heartbeat_limit, gave_up, reported: None, run, _member: member };
        match launch {
            Launch::Spawn => crew.spawn(ranks)?,
            // Nobody may be reading; then nobody starts workers either, and they are missed soon enough.
            Launch::Await => drop(writeln!(std::io::stdout(), "{}", crew.run)),
        }
        Ok(crew)
    }

    /// Identifier of the run.
    pub fn run_name(&self) -> &RunName {
        &self.run
    }

    fn spawn(&mut self, ranks: usize) -> Result<(), CrewError> {
        let spawn_error = |rank| move |source| CrewError::Spawn { rank, source };
        for rank in 0..ranks {
            let program = std::env::current_exe().map_err(spawn_error(rank))?;
            let child = Command::new(program)
                .args(["worker", "--run", &self.run.to_string(), "--rank", &rank.to_string()])
                .stdin(Stdio::null())
                // A group of their own: Ctrl-C reaches the coordinator only, which then stops them in order.
                .process_group(0)
                .spawn()
                .map_err(spawn_error(rank))?;
            self.children.push(child);
        }
        Ok(())
    }

    /// Number of workers.
    pub fn ranks(&self) -> usize {
        self.control.ranks()
    }

    /// Sends a message to one worker.
    pub fn send(&mut self, rank: usize, message: &ToWorker, arrays: &[&[u8]]) -> Result<(), CrewError> {
        let bytes = encode(message, arrays).map_err(|source| CrewError::Message { rank, source })?;
        Ok(self.control.send(rank, bytes)?)
    }

    /// Sends a message without arrays to all workers.
    pub fn broadcast(&mut self, message: &ToWorker) -> Result<(), CrewError> {
        (0..self.ranks()).try_for_each(|rank| self.send(rank, message, &[]))
    }

    /// Waits until everything sent to `rank` has been taken, so that large messages do not pile up.
    pub fn flush(&mut self, rank: usize, limit: Duration) -> Result<(), CrewError> {
        let (start, all) = (Instant::now(), (0..self.ranks()).collect::<Vec<_>>());
        while !self.control.all_sent(rank) {
            self.look_after(&all, start, limit)?;
            self.control.wait(LOOK)?;
        }
        Ok(())
    }

    /// Waits for one message of every worker and hands them to `take` (rank, message, arrays) as they come. A worker that is
    /// silent for `limit` counts as hung.
    pub fn collect(
        &mut self,
        limit: Duration,
        mut take: impl FnMut(usize, ToCoordinator, &[&[u8]]) -> bool,
    ) -> Result<(), CrewError> {
        let mut missing: Vec<usize> = (0..self.ranks()).collect();
        let start = Instant::now();
        loop {
            let mut taken = Vec::new();
            for &rank in &missing {
                let Some(bytes) = self.control.try_receive(rank)? else { continue };
                let (message, arrays) =
                    decode::<ToCoordinator>(&bytes).map_err(|source| CrewError::Message { rank, source })?;
                match message {
                    ToCoordinator::Failed(failure) => self.note_failure(rank, failure),
                    other => match take(rank, other, &arrays) {
                        true => taken.push(rank),
                        false => return Err(CrewError::OutOfTurn { rank }),
                    },
                }
            }
            missing.retain(|rank| !taken.contains(rank));
            // Who has answered may leave, if that was its last word.
            self.look_after(&missing, start, limit)?;
            if missing.is_empty() {
                return Ok(());
            }
            self.control.wait(LOOK)?;
        }
    }

    /// Remembers that a worker cannot go on, and why, unless another one has explained it better.
    fn note_failure(&mut self, rank: usize, failure: Failure) {
        self.gave_up[rank] = true;
        let new = CrewError::Failed { rank, failure };
        self.reported = Some(match self.reported.take() {
            Some((since, old)) if weight(&old) >= weight(&new) => (since, old),
            Some((since, _)) => (since, new),
            None => (Instant::now(), new),
        });
    }

    /// The reported failure, once nothing better is to be expected: a worker that has lost another one reports before
    /// it is known who is really to blame, and of ranks that see the same failed solve one knows the vertex.
    fn verdict(&mut self) -> Result<(), CrewError> {
        let Some((since, error)) = &self.reported else { return Ok(()) };
        let patience = match weight(error) {
            0 => self.heartbeat_limit + LOOK,
            1 => ECHO,
            _ => Duration::ZERO,
        };
        if since.elapsed() < patience && !self.gave_up.iter().all(|&gave_up| gave_up) {
            return Ok(());
        }
        self.reported.take().map_or(Ok(()), |(_, error)| Err(error))
    }

    /// Finds dead, hung and missing workers among `ranks`, and those that gave up.
    fn look_after(&mut self, ranks: &[usize], start: Instant, limit: Duration) -> Result<(), CrewError> {
        for rank in ranks.iter().copied().filter(|&rank| !self.gave_up[rank]).collect::<Vec<_>>() {
            let heartbeat = self.control.heartbeat(rank);
            let pid = heartbeat.pid as u32;
            let place = if heartbeat.step == 0 {
                "while setting up".to_string()
            } else {
                format!("in step {}", heartbeat.step)
            };
            let child_ended = self.children.get_mut(rank).is_some_and(|child| matches!(child.try_wait(), Ok(Some(_))));
            if child_ended || self.control.has_ended(rank) {
                // Its last words may be on the way.
                while let Some(bytes) = self.control.try_receive(rank)? {
                    if let Ok((ToCoordinator::Failed(failure), _)) = decode::<ToCoordinator>(&bytes) {
                        self.note_failure(rank, failure);
                    }
                }
                if self.gave_up[rank] {
                    continue;
                }
                let pid = self.children.get(rank).map_or(pid, Child::id);
                return Err(CrewError::Died { rank, pid, place });
            }
            match self.control.silence(rank) {
                Some(silence) if silence > limit => {
                    // It would not hear a farewell, and the others need not wait for it.
                    kill(pid);
                    return Err(CrewError::Hung { rank, pid, place, silence_s: silence.as_secs_f64() });
                }
                None if start.elapsed() > limit.max(Duration::from_secs(60)) => {
                    return Err(CrewError::Missing { rank, waited_s: start.elapsed().as_secs_f64() });
                }
                _ => {}
            }
        }
        self.verdict()
    }

    /// Tells all workers to leave and makes sure that they have.
    pub fn dismiss(mut self) {
        self.end();
    }

    fn end(&mut self) {
        for rank in 0..self.ranks() {
            // A worker that is gone cannot take the message; that is what is wanted.
            let _ = self.send(rank, &ToWorker::Stop, &[]);
        }
        let start = Instant::now();
        while start.elapsed() < FAREWELL && !self.all_gone() {
            for rank in 0..self.ranks() {
                // A worker leaves when its last message has been taken, whatever it says.
                while let Ok(Some(_)) = self.control.try_receive(rank) {}
            }
            let _ = self.control.wait(Duration::from_millis(10));
        }
        if !self.all_gone() {
            for rank in 0..self.ranks() {
                if !self.control.has_ended(rank) {
                    kill(self.control.heartbeat(rank).pid as u32);
                }
            }
            for child in &mut self.children {
                let _ = child.kill();
            }
        }
        for child in &mut self.children {
            let _ = child.wait();
        }
        self.children.clear();
    }

    fn all_gone(&mut self) -> bool {
        let children = self.children.iter_mut().all(|child| !matches!(child.try_wait(), Ok(None)));
        let ranks = self.ranks();
        children && (0..ranks).all(|rank| self.control.heartbeat(rank).pid == 0 || self.control.has_ended(rank))
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        self.end();
        // Ports of killed workers are only given up by removing the run's files.
        if let Err(error) = self.run.purge() {
            tracing::warn!("cannot remove the run's files: {error}");
        }
    }
}

/// Ends a worker that does not listen any more. It has been seen alive, so the number is still its own.
fn kill(pid: u32) {
    if let Some(pid) = i32::try_from(pid).ok().and_then(rustix::process::Pid::from_raw) {
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::KILL);
    }
}

/// How much a failure explains: a lost connection (0) is only the echo of something else.
fn weight(error: &CrewError) -> u8 {
    match error {
        CrewError::Failed { failure: Failure::Transport(_), .. } => 0,
        CrewError::Failed { failure: Failure::Step { .. } | Failure::Other(_), .. } => 1,
        _ => 2,
    }
}
