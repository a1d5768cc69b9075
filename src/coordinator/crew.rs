//! The workers of a run, as the coordinator manages them: it starts them (or waits for them), exchanges messages,
//! detects failures and ends them. The meaning of the messages lies in other modules.

use std::io::Write;
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use thiserror::Error;

use crate::os::clock::AwakeClock;
use crate::os::signals::{self, StopSignal};
use crate::protocol::{CONNECTING, SOLVING, ToCoordinator, ToWorker};
use crate::step::Failure;
use crate::transport::{
    ControlCoordinator, ControlError, Heartbeat, IceoryxCoordinator, Launcher, Life, Machine, MessageError, OneProcess,
    ProcessLauncher, RunError, RunName, SetupTurn, SharedMemoryMachine, Silence, ThreadConnect, ThreadJob,
    ThreadLauncher, WorkerCommand, World, decode, encode, thread_channel,
};
use crate::worker;

/// Time that workers get to leave by themselves before they are killed.
const FAREWELL: Duration = Duration::from_secs(2);
/// Longest sleep between two checks of the workers.
const LOOK: Duration = Duration::from_millis(50);
/// Time that the other workers get, after the first report of a failure, to report a better explanation.
const ECHO: Duration = Duration::from_millis(500);

/// Longest silence of a worker that is started by the program and reads its part or sets it up, and longest time until
/// it appears. A worker that computes may be silent for longer ([`COMPUTING_MOST`]).
const SETUP_LIMIT: Duration = Duration::from_secs(60);
/// The same for workers that somebody starts by hand, and for threads, whose work cannot be told apart.
const AWAIT_LIMIT: Duration = Duration::from_secs(300);
/// Longest time for which all workers wait for each other to connect, and an addition for every worker: they open ports
/// to each other. It passes if files of the run are removed from the machine.
const CONNECT_LIMIT: (Duration, Duration) = (Duration::from_secs(60), Duration::from_secs(2));
/// Longest wait for an answer of workers that have not begun their first step, whatever they do.
const SETUP_MOST: Duration = Duration::from_secs(600);
/// A computing worker may be silent for this multiple of the limit. After that it counts as hung.
const COMPUTING_MOST: u32 = 30;

/// Origin of the workers.
#[derive(Clone, Debug)]
pub enum Launch {
    /// Start them as children of this process, which must be the `loomtree` program.
    Spawn,
    /// Another program starts them (`loomtree-worker --run ID --rank R`); print the run's identifier for it.
    Await,
    /// Start them as threads of this process.
    Threads,
    /// They are the processes of a world that another program has started.
    World(Arc<dyn World>),
}

impl Launch {
    /// The machine of such workers.
    pub fn machine(&self) -> Box<dyn Machine> {
        match self {
            Launch::Spawn | Launch::Await => Box::new(SharedMemoryMachine),
            Launch::Threads => Box::new(OneProcess),
            Launch::World(world) => world.machine(),
        }
    }

    /// Number of workers, if whoever started them has decided it.
    pub fn ranks(&self) -> Option<usize> {
        match self {
            Launch::World(world) => Some(world.ranks()),
            _ => None,
        }
    }
}

/// Error that ends the crew.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error)]
pub enum CrewError {
    /// A worker ended without an order to leave.
    #[error("worker {rank} ({who}) ended unexpectedly {place}{}", how.as_ref().map_or(String::new(), |how| format!(", {how}")))]
    Died { rank: usize, who: String, place: String, how: Option<String> },
    /// A worker does not give a sign of life.
    #[error("worker {rank} ({who}) hangs {place}: no sign of life for {silence_s:.1} s")]
    Hung { rank: usize, who: String, place: String, silence_s: f64 },
    /// A signal requested a stop before the first step, so there is no state to save.
    #[error("stopped by {0} before the first step")]
    Stopped(StopSignal),
    /// A worker never connected.
    #[error("worker {rank} was not set up within {waited_s:.0} s")]
    Missing { rank: usize, waited_s: f64 },
    /// All workers are set up, but they do not reach each other.
    #[error(
        "worker {rank} did not connect to the others within {waited_s:.0} s; files of the run may have been removed \
         from /dev/shm or from the temp folder"
    )]
    Unconnected { rank: usize, waited_s: f64 },
    /// A worker reported that it cannot go on.
    #[error("worker {rank}: {failure}")]
    Failed { rank: usize, failure: Failure },
    /// A worker could not be started.
    #[error("cannot start worker {rank}: {source}")]
    Spawn { rank: usize, source: std::io::Error },
    /// The channel to the workers.
    #[error(transparent)]
    Control(#[from] ControlError),
    /// A worker sent an unexpected message.
    #[error("message of worker {rank}: {source}")]
    Message { rank: usize, source: MessageError },
    /// A worker answered with another message than the expected one.
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
            // An error of the scene, whichever rank detected it.
            CrewError::Failed { failure, .. } if weight(self) == 2 => failure.sentence(vertex_name),
            other => other.to_string(),
        }
    }

    /// True if the user can correct the error before the run starts.
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
    /// Longest silence of a worker during its setup.
    setup_limit: Duration,
    /// Longest time for which all workers connect, and the time since they began to.
    connect_limit: Duration,
    connecting: Option<AwakeClock>,
    /// By rank: time since the last sign of life, and time since it was last seen to compute.
    silences: Vec<[Silence; 2]>,
    /// Held until all workers have begun their first step.
    turn: Option<SetupTurn>,
    /// By rank: it has reported that it cannot continue, so its end is expected.
    gave_up: Vec<bool>,
    /// Time of the first such report, and the report that explains most.
    reported: Option<(Instant, CrewError)>,
}

impl Crew {
    /// Starts (or waits for) `ranks` workers, the first of which is worker `first` of all crews side by side. A worker
    /// that is silent for `heartbeat_limit` counts as hung.
    pub fn assemble(first: usize, ranks: usize, launch: &Launch, heartbeat_limit: Duration) -> Result<Crew, CrewError> {
        let command: Option<WorkerCommand> = match launch {
            Launch::Spawn => Some(Box::new(worker_command)),
            Launch::Await => None,
            Launch::Threads => {
                let (control, seats) = thread_channel(ranks);
                let connect = ThreadConnect::default();
                let launcher = ThreadLauncher::new(seats, |rank| -> ThreadJob {
                    let connect = connect.clone();
                    Box::new(move |seat| {
                        // The channel reports a failure to the coordinator.
                        let _ = worker::serve(rank, Box::new(seat.connect()), Box::new(connect));
                    })
                });
                return Crew::start(Box::new(control), Box::new(launcher), launch.machine(), heartbeat_limit);
            }
            Launch::World(world) => {
                let (control, launcher) = world.crew(first, ranks)?;
                return Crew::start(control, launcher, launch.machine(), heartbeat_limit);
            }
        };
        let launcher = ProcessLauncher::new(ranks, command)?;
        let control = IceoryxCoordinator::create(launcher.run(), ranks)?;
        if matches!(launch, Launch::Await) {
            // If no one reads this line, no one starts workers, and their absence is detected soon.
            drop(writeln!(std::io::stdout(), "{}", launcher.run()));
        }
        let mut crew = Crew::start(Box::new(control), Box::new(launcher), launch.machine(), heartbeat_limit)?;
        if matches!(launch, Launch::Spawn) {
            crew.setup_limit = SETUP_LIMIT;
        }
        Ok(crew)
    }

    /// Starts the workers of `launcher`, which connect through `control` and run on `machine`.
    pub fn start(
        control: Box<dyn ControlCoordinator>,
        launcher: Box<dyn Launcher>,
        machine: Box<dyn Machine>,
        heartbeat_limit: Duration,
    ) -> Result<Crew, CrewError> {
        let ranks = control.ranks();
        let (silences, gave_up) = (vec![Default::default(); ranks], vec![false; ranks]);
        let (turn, reported) = (None, None);
        let mut crew = Crew {
            control,
            launcher,
            machine,
            heartbeat_limit,
            setup_limit: AWAIT_LIMIT,
            connect_limit: CONNECT_LIMIT.0 + CONNECT_LIMIT.1 * ranks as u32,
            connecting: None,
            silences,
            turn,
            gave_up,
            reported,
        };
        for rank in 0..ranks {
            crew.launcher.start(rank).map_err(|source| CrewError::Spawn { rank, source })?;
        }
        Ok(crew)
    }

    /// Name of the run on this machine, if its workers are processes.
    pub fn run_name(&self) -> Option<&RunName> {
        self.launcher.run_name()
    }

    /// Holds the lock for the setup until all workers have begun their first step.
    pub fn keep(&mut self, turn: SetupTurn) {
        self.turn = Some(turn);
    }

    /// Sets the longest time for which all workers may wait for each other to connect.
    pub fn limit_connecting(&mut self, limit: Duration) {
        self.connect_limit = limit;
    }

    /// Longest silence of a worker during its setup.
    pub fn setup_limit(&self) -> Duration {
        self.setup_limit
    }

    /// Number of workers.
    pub fn ranks(&self) -> usize {
        self.control.ranks()
    }

    /// The machine of the workers.
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

    /// Waits until `rank` has received everything sent to it, so that large messages do not pile up.
    pub fn flush(&mut self, rank: usize, limit: Duration) -> Result<(), CrewError> {
        let (mut clock, all) = (AwakeClock::start(), (0..self.ranks()).collect::<Vec<_>>());
        while !self.control.all_sent(rank) {
            self.look_after(&all, clock.elapsed(), limit)?;
            self.control.wait(LOOK)?;
        }
        Ok(())
    }

    /// Waits for one message of every worker and passes each to `take` (rank, message, arrays) on arrival. A worker
    /// that is silent for `limit` counts as hung.
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
            // A worker that has answered may leave.
            self.look_after(&missing, clock.elapsed(), limit)?;
            if missing.is_empty() {
                return Ok(());
            }
            self.control.wait(LOOK)?;
        }
    }

    /// Records that a worker cannot continue, and why, unless another worker has reported a better explanation.
    fn note_failure(&mut self, rank: usize, failure: Failure) {
        self.gave_up[rank] = true;
        let new = CrewError::Failed { rank, failure };
        self.reported = Some(match self.reported.take() {
            Some((since, old)) if weight(&old) >= weight(&new) => (since, old),
            Some((since, _)) => (since, new),
            None => (Instant::now(), new),
        });
    }

    /// The reported failure, once no better explanation is expected. A worker that has lost another one reports before
    /// the lost one is known to have ended, and of the ranks with the same failed solve only one knows the vertex.
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

    /// Detects ended, hung and missing workers among `ranks`, for which the caller has `waited`, and workers that
    /// reported a failure.
    fn look_after(&mut self, ranks: &[usize], waited: Duration, limit: Duration) -> Result<(), CrewError> {
        let steps: Vec<u64> = (0..self.ranks()).map(|rank| self.control.heartbeat(rank).step).collect();
        self.check_connecting(&steps, ranks)?;
        if steps.iter().all(|&step| step > 0 && step != CONNECTING) {
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
                CONNECTING => "while connecting to the others".to_string(),
                SOLVING => "while solving".to_string(),
                step => format!("in step {step}"),
            };
            if self.launcher.life(rank) == Life::Ended || self.control.has_ended(rank) {
                // Its last message may still be in transit.
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
                    // It cannot receive an order to leave, and the others need not wait for it.
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

    /// Error if all workers have been connecting for too long; `steps` by rank, `missing` = those without an answer.
    fn check_connecting(&mut self, steps: &[u64], missing: &[usize]) -> Result<(), CrewError> {
        let waiting = missing.first().filter(|_| steps.iter().all(|&step| step == CONNECTING));
        let Some(&rank) = waiting else {
            self.connecting = None;
            return Ok(());
        };
        let waited = self.connecting.get_or_insert_with(AwakeClock::start).elapsed();
        if waited <= self.connect_limit {
            return Ok(());
        }
        Err(CrewError::Unconnected { rank, waited_s: waited.as_secs_f64() })
    }

    /// Time for which a worker has been silent; none before it has connected. It is zero while the worker computes, up
    /// to [`COMPUTING_MOST`] times the limit: some steps are long, and a worker cannot give a sign of life within a
    /// kernel.
    fn silence(&mut self, rank: usize, heartbeat: Heartbeat, limit: Duration) -> Option<Duration> {
        let [signs, work] = &mut self.silences[rank];
        let silence = signs.of(heartbeat)?;
        if silence <= limit / 4 {
            return Some(silence);
        }
        let Some(ticks) = self.launcher.work_of(rank) else { return Some(silence) };
        // It counts from the first check, a quarter of the limit after the last sign of life.
        let idle = work.of(Heartbeat { counter: ticks + 1, step: 0 }).unwrap_or_default();
        let computes = idle <= limit * 3 / 4 && silence <= limit.saturating_mul(COMPUTING_MOST);
        Some(if computes { Duration::ZERO } else { silence })
    }

    /// Orders all workers to leave and waits until they have ended.
    pub fn dismiss(mut self) {
        self.end();
    }

    fn end(&mut self) {
        for rank in 0..self.ranks() {
            // A worker that has ended cannot receive the order and does not need it.
            let _ = self.send(rank, &ToWorker::Stop, &[]);
        }
        let start = Instant::now();
        while start.elapsed() < FAREWELL && !self.all_gone() {
            for rank in 0..self.ranks() {
                // A worker may leave as soon as its last message has been received.
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

    /// True if no started or connected worker runs any more.
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
    // A process group of their own: Ctrl-C reaches only the coordinator, which then stops them in order.
    command.stdin(Stdio::null()).process_group(0);
    Ok(command)
}

/// Rank of an explanation. A lost connection (0) only follows from another failure.
fn weight(error: &CrewError) -> u8 {
    match error {
        CrewError::Failed { failure: Failure::Transport(_), .. } => 0,
        CrewError::Failed { failure: Failure::Step { .. } | Failure::Other(_), .. } => 1,
        _ => 2,
    }
}
