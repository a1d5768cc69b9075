//! The workers of a run as seen by the coordinator: started (or waited for), spoken to, watched, and gone afterwards.
//! Says nothing about what is simulated.

use std::io::Write;
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use thiserror::Error;

use crate::os::clock::AwakeClock;
use crate::os::signals::{self, StopSignal};
use crate::protocol::{SOLVING, ToCoordinator, ToWorker};
use crate::step::Failure;
use crate::transport::{
    ControlCoordinator, ControlError, Heartbeat, IceoryxCoordinator, Launcher, Life, Machine, MessageError, OneProcess,
    ProcessLauncher, RunError, RunName, SetupTurn, SharedMemoryMachine, Silence, ThreadConnect, ThreadJob,
    ThreadLauncher, WorkerCommand, decode, encode, thread_channel,
};
use crate::worker;

/// How long workers get to leave by themselves before they are killed.
const FAREWELL: Duration = Duration::from_secs(2);
/// Longest sleep between two looks at the workers.
const LOOK: Duration = Duration::from_millis(50);
/// How long the other workers get to explain a failure better than the first report of it does.
const ECHO: Duration = Duration::from_millis(500);

/// Longest wait for an answer of workers that have not begun their first step: they may wait for each other for ever.
const SETUP_MOST: Duration = Duration::from_secs(600);
/// A worker that computes may be silent for this many times the limit: it is then taken to compute for ever.
const COMPUTING_MOST: u32 = 30;

/// Where the workers come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Launch {
    /// Start them as children of this process, which must be the `loomtree` program.
    Spawn,
    /// Somebody else starts them (`loomtree-worker --run ID --rank R`); print the run's identifier for that.
    Await,
    /// Start them as threads of this process.
    Threads,
}

impl Launch {
    /// The place where such workers live.
    pub fn machine(&self) -> Box<dyn Machine> {
        match self {
            Launch::Spawn | Launch::Await => Box::new(SharedMemoryMachine),
            Launch::Threads => Box::new(OneProcess),
        }
    }
}

/// Why the crew cannot go on.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error)]
pub enum CrewError {
    /// A worker ended although nobody told it to.
    #[error("worker {rank} ({who}) ended unexpectedly {place}{}", how.as_ref().map_or(String::new(), |how| format!(", {how}")))]
    Died { rank: usize, who: String, place: String, how: Option<String> },
    /// A worker gives no sign of life.
    #[error("worker {rank} ({who}) hangs {place}: no sign of life for {silence_s:.1} s")]
    Hung { rank: usize, who: String, place: String, silence_s: f64 },
    /// A signal asked to stop before the first step: there is nothing to keep.
    #[error("stopped by {0} before the first step")]
    Stopped(StopSignal),
    /// A worker never came.
    #[error("worker {rank} was not set up within {waited_s:.0} s")]
    Missing { rank: usize, waited_s: f64 },
    /// A worker reported that it cannot go on.
    #[error("worker {rank}: {failure}")]
    Failed { rank: usize, failure: Failure },
    /// A worker could not be started.
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
    control: Box<dyn ControlCoordinator>,
    launcher: Box<dyn Launcher>,
    machine: Box<dyn Machine>,
    heartbeat_limit: Duration,
    /// By rank: since the last sign of life, and since it was last seen to compute.
    silences: Vec<[Silence; 2]>,
    /// Kept until all workers have begun their first step.
    turn: Option<SetupTurn>,
    /// By rank: has reported that it cannot go on, so its end is no news.
    gave_up: Vec<bool>,
    /// When the first such report came, and the one that explains most.
    reported: Option<(Instant, CrewError)>,
}

impl Crew {
    /// Starts (or waits for) `ranks` workers. A worker that is silent for `heartbeat_limit` counts as hung.
    pub fn assemble(ranks: usize, launch: &Launch, heartbeat_limit: Duration) -> Result<Crew, CrewError> {
        let command: Option<WorkerCommand> = match launch {
            Launch::Spawn => Some(Box::new(worker_command)),
            Launch::Await => None,
            Launch::Threads => {
                let (control, seats) = thread_channel(ranks);
                let connect = ThreadConnect::default();
                let launcher = ThreadLauncher::new(seats, |rank| -> ThreadJob {
                    let connect = connect.clone();
                    Box::new(move |seat| {
                        // The coordinator hears of a failure over the channel.
                        let _ = worker::serve(rank, Box::new(seat.connect()), Box::new(connect));
                    })
                });
                return Crew::start(Box::new(control), Box::new(launcher), launch.machine(), heartbeat_limit);
            }
        };
        let launcher = ProcessLauncher::new(ranks, command)?;
        let control = IceoryxCoordinator::create(launcher.run(), ranks)?;
        if *launch == Launch::Await {
            // Nobody may be reading; then nobody starts workers either, and they are missed soon enough.
            drop(writeln!(std::io::stdout(), "{}", launcher.run()));
        }
        Crew::start(Box::new(control), Box::new(launcher), launch.machine(), heartbeat_limit)
    }

    /// Starts the workers of `launcher`, which connect with `control` and live on `machine`.
    pub fn start(
        control: Box<dyn ControlCoordinator>,
        launcher: Box<dyn Launcher>,
        machine: Box<dyn Machine>,
        heartbeat_limit: Duration,
    ) -> Result<Crew, CrewError> {
        let ranks = control.ranks();
        let (silences, gave_up) = (vec![Default::default(); ranks], vec![false; ranks]);
        let (turn, reported) = (None, None);
        let mut crew = Crew { control, launcher, machine, heartbeat_limit, silences, turn, gave_up, reported };
        for rank in 0..ranks {
            crew.launcher.start(rank).map_err(|source| CrewError::Spawn { rank, source })?;
        }
        Ok(crew)
    }

    /// Name of the run on this machine, if its workers are processes.
    pub fn run_name(&self) -> Option<&RunName> {
        self.launcher.run_name()
    }

    /// Keeps the turn to set up until all workers have begun their first step.
    pub fn keep(&mut self, turn: SetupTurn) {
        self.turn = Some(turn);
    }

    /// Number of workers.
    pub fn ranks(&self) -> usize {
        self.control.ranks()
    }

    /// The place where the workers live.
    pub fn machine(&self) -> &dyn Machine {
        self.machine.as_ref()
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
        let (mut clock, all) = (AwakeClock::start(), (0..self.ranks()).collect::<Vec<_>>());
        while !self.control.all_sent(rank) {
            self.look_after(&all, clock.elapsed(), limit)?;
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
        let mut clock = AwakeClock::start();
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
            self.look_after(&missing, clock.elapsed(), limit)?;
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

    /// Finds dead, hung and missing workers among `ranks`, for which the caller has `waited`, and those that gave up.
    fn look_after(&mut self, ranks: &[usize], waited: Duration, limit: Duration) -> Result<(), CrewError> {
        if (0..self.ranks()).all(|rank| self.control.heartbeat(rank).step > 0) {
            self.turn = None;
        } else if let Some(signal) = signals::stop_requested() {
            return Err(CrewError::Stopped(signal));
        } else if waited > SETUP_MOST {
            let rank = ranks.first().copied().unwrap_or(0);
            return Err(CrewError::Missing { rank, waited_s: waited.as_secs_f64() });
        }
        for rank in ranks.iter().copied().filter(|&rank| !self.gave_up[rank]).collect::<Vec<_>>() {
            let heartbeat = self.control.heartbeat(rank);
            let place = match heartbeat.step {
                0 => "while setting up".to_string(),
                SOLVING => "while solving".to_string(),
                step => format!("in step {step}"),
            };
            if self.launcher.life(rank) == Life::Ended || self.control.has_ended(rank) {
                // Its last words may be on the way.
                while let Some(bytes) = self.control.try_receive(rank)? {
                    if let Ok((ToCoordinator::Failed(failure), _)) = decode::<ToCoordinator>(&bytes) {
                        self.note_failure(rank, failure);
                    }
                }
                if self.gave_up[rank] {
                    continue;
                }
                let (who, how) = (self.launcher.describe(rank), self.launcher.end_of(rank));
                return Err(CrewError::Died { rank, who, place, how });
            }
            match self.silence(rank, heartbeat, limit) {
                Some(silence) if silence > limit => {
                    // It would not hear a farewell, and the others need not wait for it.
                    self.launcher.kill(rank);
                    let who = self.launcher.describe(rank);
                    return Err(CrewError::Hung { rank, who, place, silence_s: silence.as_secs_f64() });
                }
                None if waited > limit.max(Duration::from_secs(60)) => {
                    return Err(CrewError::Missing { rank, waited_s: waited.as_secs_f64() });
                }
                _ => {}
            }
        }
        self.verdict()
    }

    /// For how long a worker has been silent; zero while it computes, up to [`COMPUTING_MOST`] times the limit: some steps
    /// are long, and a worker has no turn to give a sign of life in the middle of a kernel. None before it has connected.
    fn silence(&mut self, rank: usize, heartbeat: Heartbeat, limit: Duration) -> Option<Duration> {
        let [signs, work] = &mut self.silences[rank];
        let silence = signs.of(heartbeat)?;
        if silence <= limit / 4 {
            return Some(silence);
        }
        let Some(ticks) = self.launcher.work_of(rank) else { return Some(silence) };
        // It counts from the first look at it, a quarter of the limit after the last sign of life.
        let idle = work.of(Heartbeat { counter: ticks + 1, step: 0 }).unwrap_or_default();
        let computes = idle <= limit * 3 / 4 && silence <= limit.saturating_mul(COMPUTING_MOST);
        Some(if computes { Duration::ZERO } else { silence })
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
        for rank in 0..self.ranks() {
            if !self.is_gone(rank) {
                self.launcher.kill(rank);
            }
        }
        for rank in 0..self.ranks() {
            self.launcher.wait(rank);
        }
    }

    fn all_gone(&mut self) -> bool {
        (0..self.ranks()).all(|rank| self.is_gone(rank))
    }

    /// True if nothing runs that was started here or has connected.
    fn is_gone(&mut self, rank: usize) -> bool {
        let connected = self.control.heartbeat(rank).counter > 0;
        self.launcher.life(rank) != Life::Running && (!connected || self.control.has_ended(rank))
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        self.end();
        self.launcher.clean_up();
    }
}

/// This program as a worker of `run`.
fn worker_command(run: &RunName, rank: usize) -> std::io::Result<Command> {
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["worker", "--run", &run.to_string(), "--rank", &rank.to_string()]);
    // A group of their own: Ctrl-C reaches the coordinator only, which then stops them in order.
    command.stdin(Stdio::null()).process_group(0);
    Ok(command)
}

/// How much a failure explains: a lost connection (0) is only the echo of something else.
fn weight(error: &CrewError) -> u8 {
    match error {
        CrewError::Failed { failure: Failure::Transport(_), .. } => 0,
        CrewError::Failed { failure: Failure::Step { .. } | Failure::Other(_), .. } => 1,
        _ => 2,
    }
}
