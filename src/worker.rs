//! A worker, a process or a thread: one rank, its device and its rows. It does what the coordinator's messages say and ends
//! by itself when the coordinator does.

mod error;
mod inbox;

use std::time::Duration;

pub use error::WorkerError;
use inbox::Inbox;

use crate::gpu::Executor;
use crate::linear_system::{RankSystem, RankSystemArrays, SolveParams, solve_rank};
use crate::model::RankModel;
use crate::protocol::{BindCores, ExecutorChoice, ToCoordinator, ToWorker, WorkerReady, WorkerSetup};
use crate::step::{ExchangePlan, Failure, Simulation};
use crate::transport::{
    Connect, Connection, ControlWorker, IceoryxConnect, IceoryxWorker, RunName, SoloTransport, Transport,
    TransportError, decode, share_cores, worker_role,
};

/// How long a worker waits for the coordinator when it starts or reports, seconds.
const COORDINATOR_PATIENCE: Duration = Duration::from_secs(60);

/// Runs rank `rank` of `run`, whose ranks are processes, until the coordinator says stop.
pub fn run(run: &RunName, rank: usize) -> Result<(), WorkerError> {
    let member = run.join(&worker_role(rank))?;
    let result = IceoryxWorker::connect(run, rank, COORDINATOR_PATIENCE)
        .map_err(WorkerError::from)
        .and_then(|control| serve(rank, Box::new(control), Box::new(IceoryxConnect::new(run))));
    // The last one to leave removes what the run has put on the machine, also after a killed coordinator.
    drop(member);
    if let Err(error) = run.purge_if_last() {
        tracing::warn!("cannot remove the run's files: {error}");
    }
    result
}

/// Does what the coordinator's messages over `control` say, as rank `rank`, until they say stop; joins the other ranks by
/// `data`.
pub fn serve(rank: usize, control: Box<dyn ControlWorker>, mut data: Box<dyn Connect>) -> Result<(), WorkerError> {
    let inbox = Inbox::new(control);
    let bytes = inbox.next()?;
    let (message, arrays) = decode::<ToWorker>(&bytes)?;
    match message {
        ToWorker::Simulate { setup, exchange, mut model } => {
            model.set_arrays(&arrays).map_err(|error| inbox.fail(Failure::Other(error.to_string())))?;
            drop(arrays);
            drop(bytes);
            simulate(data.as_mut(), rank, &inbox, &setup, &exchange, *model)
        }
        ToWorker::Solve { setup, exchange, params, mut system } => {
            let arrays = RankSystemArrays::from_bytes(&arrays, system.double_precision);
            system.arrays = arrays.map_err(|error| inbox.fail(Failure::Other(error.to_string())))?;
            drop(bytes);
            solve(data.as_mut(), rank, &inbox, &setup, &exchange, &params, &system)
        }
        ToWorker::Stop => Ok(()),
        other => Err(inbox.fail(Failure::Other(format!("{other:?} before this worker was set up")))),
    }
}

fn simulate(
    data: &mut dyn Connect,
    rank: usize,
    inbox: &Inbox,
    setup: &WorkerSetup,
    exchange: &ExchangePlan,
    model: RankModel,
) -> Result<(), WorkerError> {
    let executor = make_executor(setup, rank).map_err(|message| inbox.fail(Failure::BadInput(message)))?;
    let (name, device) = (executor.name().to_string(), executor.device_name());
    let mut simulation = Simulation::new(executor, model, exchange).map_err(|error| inbox.fail(error.into()))?;
    let mut transport = match connect(data, rank, inbox, setup) {
        Ok(transport) => transport,
        Err(error) => return inbox.interrupted(error.into()),
    };
    let ready = WorkerReady {
        executor: name,
        device,
        padding_ratio: simulation.padding_ratio,
        epoch_unix_ns: simulation.recorder.epoch_unix_ns,
        memory_bytes: simulation.memory_bytes(),
        preconditioner: simulation.preconditioner(),
    };
    inbox.send(&ToCoordinator::Ready(ready), &[])?;
    loop {
        match decode::<ToWorker>(&inbox.next()?)?.0 {
            ToWorker::Step { step, record } => {
                inbox.progress(step);
                match simulation.step(transport.as_mut(), step, record) {
                    Ok(stats) => {
                        let events = simulation.recorder.take();
                        inbox.send(&ToCoordinator::StepDone(Box::new(stats)), &[bytemuck::cast_slice(&events)])?;
                    }
                    Err(error) => return inbox.interrupted(error),
                }
            }
            ToWorker::SendState => {
                inbox.send(&ToCoordinator::State, &simulation.state().to_bytes())?;
            }
            ToWorker::Stop => return Ok(()),
            ToWorker::Simulate { .. } | ToWorker::Solve { .. } => {
                return Err(inbox.fail(Failure::Other("this worker is set up already".into())));
            }
        }
    }
}

/// One linear solve; the worker leaves afterwards.
fn solve(
    data: &mut dyn Connect,
    rank: usize,
    inbox: &Inbox,
    setup: &WorkerSetup,
    exchange: &ExchangePlan,
    params: &SolveParams,
    system: &RankSystem,
) -> Result<(), WorkerError> {
    let executor = make_executor(setup, rank).map_err(|message| inbox.fail(Failure::BadInput(message)))?;
    let mut transport = match connect(data, rank, inbox, setup) {
        Ok(transport) => transport,
        Err(error) => return inbox.interrupted(error.into()),
    };
    match solve_rank(&executor, transport.as_mut(), system, exchange.mode, &exchange.queue, params) {
        Ok(mut result) => {
            let events = std::mem::take(&mut result.record.events);
            let (stats, executor, record) = (result.stats, executor.name().to_string(), result.record);
            let solved = ToCoordinator::Solved { stats, executor, record };
            inbox.send(&solved, &[bytemuck::cast_slice(&result.x), bytemuck::cast_slice(&events)])?;
            inbox.flush()
        }
        Err(error) => inbox.interrupted(error.into()),
    }
}

/// Connects with all other ranks; a single rank needs no shared memory.
fn connect(
    data: &mut dyn Connect,
    rank: usize,
    inbox: &Inbox,
    setup: &WorkerSetup,
) -> Result<Box<dyn Transport>, TransportError> {
    let hook = inbox.clone();
    if setup.threads == 1 && setup.bind_cores == BindCores::Auto {
        share_cores(rank, setup.ranks);
    }
    if setup.ranks == 1 {
        let transport = SoloTransport::new(Box::new(move || hook.should_stop()));
        return Ok(Box::new(transport));
    }
    data.connect(Connection {
        rank,
        ranks: setup.ranks,
        epoch: 0,
        max_len: setup.max_message_values,
        deadline: Duration::from_secs_f64(setup.patience_s),
        on_wait: Box::new(move || hook.should_stop()),
        links: setup.links.clone(),
    })
}

/// The executor that `setup` asks for.
pub fn make_executor(setup: &WorkerSetup, rank: usize) -> Result<Executor, String> {
    let executor = match setup.executor {
        ExecutorChoice::Cpu => return Ok(Executor::cpu(setup.threads)),
        ExecutorChoice::Gpu => Executor::gpu(setup.adapter, rank),
        ExecutorChoice::Auto => Executor::auto(setup.adapter, rank, setup.threads),
    };
    executor.map_err(|error| error.to_string())
}
