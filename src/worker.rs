//! A worker, a process or a thread: one rank, its device and its rows. It executes the coordinator's messages and ends
//! by itself when the coordinator ends.

mod error;
mod inbox;

use std::ops::ControlFlow;
use std::time::Duration;

pub use error::WorkerError;
use inbox::Inbox;

use crate::gpu::Executor;
use crate::linear_system::{RankSystem, RankSystemArrays, SolveParams, solve_rank};
use crate::math::DIM;
use crate::model::{RankModel, RankState};
use crate::protocol::{BindCores, ExecutorChoice, ToCoordinator, ToWorker, WorkerReady, WorkerSetup};
use crate::step::{ExchangePlan, Failure, Guide, Simulation};
use crate::transport::{
    Connect, Connection, ControlWorker, IceoryxConnect, IceoryxWorker, RunName, SoloTransport, Transport,
    TransportError, decode, share_cores, worker_role,
};

/// Longest wait for the coordinator at the start or for a report, seconds.
const COORDINATOR_PATIENCE: Duration = Duration::from_secs(60);

/// Runs rank `rank` of `run`, whose ranks are processes, until the coordinator orders it to stop.
pub fn run(run: &RunName, rank: usize) -> Result<(), WorkerError> {
    let member = run.join(&worker_role(rank))?;
    let result = IceoryxWorker::connect(run, rank, COORDINATOR_PATIENCE)
        .map_err(WorkerError::from)
        .and_then(|control| serve(rank, Box::new(control), Box::new(IceoryxConnect::new(run))));
    // The last process to leave removes the files of the run from the machine, also after a killed coordinator.
    drop(member);
    if let Err(error) = run.purge_if_last() {
        tracing::warn!("cannot remove the run's files: {error}");
    }
    result
}

/// Executes the coordinator's messages over `control` as rank `rank` until the order to stop. It connects to the other
/// ranks through `data`.
pub fn serve(rank: usize, control: Box<dyn ControlWorker>, data: Box<dyn Connect>) -> Result<(), WorkerError> {
    let mut worker = Worker { rank, inbox: Inbox::new(control), data, executor: None, ports: None, loaded: None };
    while worker.obey()?.is_continue() {}
    Ok(())
}

/// Data of a worker between two messages.
struct Worker {
    rank: usize,
    inbox: Inbox,
    /// The setup that the executor was created for, and the executor unless a simulation owns it.
    executor: Option<(ExecutorKind, Option<Executor>)>,
    ports: Option<Ports>,
    loaded: Option<Loaded>,
    /// Dropped after the ports, whose files it may remove.
    data: Box<dyn Connect>,
}

/// Parameters of an executor.
#[derive(Clone, Copy, PartialEq, Eq)]
struct ExecutorKind {
    choice: ExecutorChoice,
    adapter: Option<usize>,
    threads: usize,
    place: usize,
}

struct Ports {
    epoch: u32,
    transport: Box<dyn Transport>,
}

/// A simulation and the step of its state.
struct Loaded {
    simulation: Simulation,
    step: u32,
}

/// How a step gets to its end.
enum Way {
    /// As the forces have it.
    Free,
    /// Drawn toward a motion.
    Guided(Guide),
    /// Straight to a given state.
    Straight(RankState),
}

impl Worker {
    /// Waits for a message and executes it; breaks when the run is over.
    fn obey(&mut self) -> Result<ControlFlow<()>, WorkerError> {
        let bytes = self.inbox.next()?;
        let (message, arrays) = decode::<ToWorker>(&bytes)?;
        match message {
            ToWorker::Load { setup, exchange, mut model } => {
                model.set_arrays(&arrays).map_err(|error| self.other(error.to_string()))?;
                drop(arrays);
                drop(bytes);
                self.load(&setup, &exchange, *model)
            }
            ToWorker::Solve { setup, exchange, params, mut system } => {
                let arrays = RankSystemArrays::from_bytes(&arrays, system.double_precision);
                system.arrays = arrays.map_err(|error| self.other(error.to_string()))?;
                drop(bytes);
                self.solve(&setup, &exchange, &params, &system)
            }
            ToWorker::SetState { step } => self.set_state(step, &arrays),
            ToWorker::Step { step, record } => self.step(step, record, Way::Free),
            ToWorker::GuidedStep { step, record, guidance } => {
                let values = self.loaded("GuidedStep")?.simulation.rows().len() * DIM;
                let [start, end] = arrays[..] else {
                    return Err(self.other("a guide of two arrays is missing".into()));
                };
                let [start, end] = [start, end].map(|bytes| bytemuck::pod_collect_to_vec::<u8, f32>(bytes));
                if (start.len(), end.len()) != (values, values) {
                    return Err(self.other(format!("a guide of {} and {} values", start.len(), end.len())));
                }
                self.step(step, record, Way::Guided(Guide { start, end, guidance }))
            }
            ToWorker::Arrive { step, record } => {
                let target = self.state(&arrays)?;
                self.step(step, record, Way::Straight(target))
            }
            ToWorker::SendState => {
                let state = self.loaded("SendState")?.simulation.state();
                self.inbox.send(&ToCoordinator::State, &state.to_bytes())?;
                Ok(ControlFlow::Continue(()))
            }
            ToWorker::Stop => Ok(ControlFlow::Break(())),
        }
    }

    fn load(
        &mut self,
        setup: &WorkerSetup,
        exchange: &ExchangePlan,
        model: RankModel,
    ) -> Result<ControlFlow<()>, WorkerError> {
        self.inbox.progress(0);
        let executor = self.executor(setup)?;
        let (name, device) = (executor.name().to_string(), executor.device_name());
        let simulation = Simulation::new(executor, model, exchange).map_err(|error| self.inbox.fail(error.into()))?;
        if let Err(error) = self.connect(setup) {
            return self.inbox.interrupted(error.into());
        }
        let ready = WorkerReady {
            executor: name,
            device,
            padding_ratio: simulation.padding_ratio,
            epoch_unix_ns: simulation.recorder.epoch_unix_ns,
            memory_bytes: simulation.memory_bytes(),
            preconditioner: simulation.preconditioner(),
        };
        self.loaded = Some(Loaded { simulation, step: 0 });
        self.inbox.send(&ToCoordinator::Ready(ready), &[])?;
        Ok(ControlFlow::Continue(()))
    }

    fn set_state(&mut self, step: u32, arrays: &[&[u8]]) -> Result<ControlFlow<()>, WorkerError> {
        let state = self.state(arrays)?;
        let loaded = self.loaded("SetState")?;
        loaded.simulation.set_state(state);
        loaded.step = step;
        Ok(ControlFlow::Continue(()))
    }

    /// A state of the own rows from the arrays of a message.
    fn state(&mut self, arrays: &[&[u8]]) -> Result<RankState, WorkerError> {
        let simulation = &self.loaded("a state")?.simulation;
        let (rows, plastic) = (simulation.rows().len(), simulation.plastic_counts());
        RankState::from_bytes(arrays, rows, plastic).map_err(|error| self.other(error.to_string()))
    }

    fn step(&mut self, step: u32, record: bool, way: Way) -> Result<ControlFlow<()>, WorkerError> {
        let before = self.loaded("Step")?.step;
        if step != before + 1 {
            return Err(self.other(format!("step {step} was asked of the state of step {before}")));
        }
        self.inbox.progress(step);
        let (Some(Loaded { simulation, step: at }), Some(ports)) = (&mut self.loaded, &mut self.ports) else {
            return Err(self.other("a step without connections to other ranks".into()));
        };
        let transport = ports.transport.as_mut();
        let done = match way {
            Way::Free => simulation.step(transport, step, record),
            Way::Guided(guide) => simulation.guided_step(transport, step, record, guide),
            Way::Straight(target) => simulation.arrive(transport, step, record, target),
        };
        match done {
            Ok(stats) => {
                *at = if stats.arrived == Some(false) { before } else { step };
                let events = simulation.recorder.take();
                self.inbox.send(&ToCoordinator::StepDone(Box::new(stats)), &[bytemuck::cast_slice(&events)])?;
                Ok(ControlFlow::Continue(()))
            }
            Err(error) => self.inbox.interrupted(error),
        }
    }

    fn solve(
        &mut self,
        setup: &WorkerSetup,
        exchange: &ExchangePlan,
        params: &SolveParams,
        system: &RankSystem,
    ) -> Result<ControlFlow<()>, WorkerError> {
        let executor = self.executor(setup)?;
        if let Err(error) = self.connect(setup) {
            return self.inbox.interrupted(error.into());
        }
        let Some(ports) = &mut self.ports else { return Err(self.other("a solve without connections".into())) };
        self.inbox.solving();
        let solved = solve_rank(&executor, ports.transport.as_mut(), system, exchange.mode, &exchange.queue, params);
        match solved {
            Ok(mut result) => {
                let events = std::mem::take(&mut result.record.events);
                let (stats, name, record) = (result.stats, executor.name().to_string(), result.record);
                let solved = ToCoordinator::Solved { stats, executor: name, record };
                self.inbox.send(&solved, &[bytemuck::cast_slice(&result.x), bytemuck::cast_slice(&events)])?;
                self.executor = self.executor.take().map(|(kind, _)| (kind, Some(executor)));
                Ok(ControlFlow::Continue(()))
            }
            Err(error) => self.inbox.interrupted(error.into()),
        }
    }

    /// The executor for `setup`. It reuses the existing one if the parameters are the same, and drops the loaded
    /// simulation.
    fn executor(&mut self, setup: &WorkerSetup) -> Result<Executor, WorkerError> {
        let WorkerSetup { executor: choice, adapter, threads, place, .. } = *setup;
        let kind = ExecutorKind { choice, adapter, threads, place };
        let used = self.loaded.take().map(|loaded| loaded.simulation.into_executor());
        let there = self.executor.take().and_then(|(made_for, spare)| Some((made_for, used.or(spare)?)));
        let executor = match there {
            Some((made_for, executor)) if made_for == kind => executor,
            _ => make_executor(setup, kind.place).map_err(|text| self.inbox.fail(Failure::BadInput(text)))?,
        };
        self.executor = Some((kind, None));
        Ok(executor)
    }

    /// Connects with all other ranks unless they are connected in this epoch.
    fn connect(&mut self, setup: &WorkerSetup) -> Result<(), TransportError> {
        if self.ports.as_ref().is_some_and(|ports| ports.epoch == setup.epoch) {
            return Ok(());
        }
        self.inbox.connecting();
        // The shared memory of the old ports becomes free for the new ones.
        self.ports = None;
        let transport = connect(self.data.as_mut(), self.rank, &self.inbox, setup)?;
        self.ports = Some(Ports { epoch: setup.epoch, transport });
        Ok(())
    }

    /// The loaded simulation, which `message` requires.
    fn loaded(&mut self, message: &str) -> Result<&mut Loaded, WorkerError> {
        match &mut self.loaded {
            Some(loaded) => Ok(loaded),
            None => Err(self.inbox.fail(Failure::Other(format!("{message} before a model was loaded")))),
        }
    }

    fn other(&self, text: String) -> WorkerError {
        self.inbox.fail(Failure::Other(text))
    }
}

/// Connects with all other ranks; a single rank does not need shared memory.
fn connect(
    data: &mut dyn Connect,
    rank: usize,
    inbox: &Inbox,
    setup: &WorkerSetup,
) -> Result<Box<dyn Transport>, TransportError> {
    let hook = inbox.clone();
    if setup.threads == 1 && setup.bind_cores == BindCores::Auto {
        share_cores(setup.place, setup.places);
    }
    if setup.ranks == 1 {
        let transport = SoloTransport::new(Box::new(move || hook.should_stop()));
        return Ok(Box::new(transport));
    }
    data.connect(Connection {
        rank,
        ranks: setup.ranks,
        epoch: setup.epoch,
        max_len: setup.max_message_values,
        deadline: Duration::from_secs_f64(setup.patience_s),
        on_wait: Box::new(move || hook.should_stop()),
        links: setup.links.clone(),
    })
}

/// The executor for `setup`; `place`: index of this rank among those of its machine.
pub fn make_executor(setup: &WorkerSetup, place: usize) -> Result<Executor, String> {
    let executor = match setup.executor {
        ExecutorChoice::Cpu => return Ok(Executor::cpu(setup.threads)),
        ExecutorChoice::Gpu => Executor::gpu(setup.adapter, place),
        ExecutorChoice::Auto => Executor::auto(setup.adapter, place, setup.threads),
    };
    executor.map_err(|error| error.to_string())
}
