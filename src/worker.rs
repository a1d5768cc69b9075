//! A worker process: one rank, its device and its rows. It does what the coordinator's messages say and ends by itself
//! when the coordinator does.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::Duration;

use thiserror::Error;

use crate::gpu::Executor;
use crate::linear_system::{RankSystem, RankSystemArrays, SolveParams, solve_rank};
use crate::model::RankModel;
use crate::protocol::{BindCores, ExecutorChoice, ToCoordinator, ToWorker, WorkerReady, WorkerSetup};
use crate::step::{ExchangePlan, Failure, Simulation};
use crate::transport::{
    ControlError, ControlWorker, EmulatedTransport, IceoryxOptions, IceoryxTransport, MessageError, RunError, RunName,
    SoloTransport, Transport, TransportError, decode, encode, share_cores,
};

/// How long a worker waits for the coordinator when it starts or reports, seconds.
const COORDINATOR_PATIENCE: Duration = Duration::from_secs(60);

/// Why a worker ends without having been told to.
#[derive(Debug, Error)]
pub enum WorkerError {
    /// The coordinator is gone, or the channel to it is broken.
    #[error(transparent)]
    Control(#[from] ControlError),
    /// A message that this worker does not understand.
    #[error("message from the coordinator: {0}")]
    Message(#[from] MessageError),
    /// The run's resources.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A failure that has been reported to the coordinator.
    #[error("{0}")]
    Reported(String),
}

/// The control channel, shared between the main loop and the hook that runs while the transport waits.
#[derive(Clone)]
struct Inbox {
    control: Rc<RefCell<ControlWorker>>,
    waiting: Rc<RefCell<VecDeque<Vec<u8>>>>,
    told_to_stop: Rc<Cell<bool>>,
}

impl Inbox {
    /// Called while waiting for another rank: a sign of life; true if the run is over.
    fn should_stop(&self) -> bool {
        let Ok(mut control) = self.control.try_borrow_mut() else { return false };
        control.heartbeat().beat();
        if control.coordinator_has_ended() {
            return true;
        }
        while let Ok(Some(message)) = control.try_receive() {
            let stop = matches!(decode::<ToWorker>(&message), Ok((ToWorker::Stop, _)));
            self.waiting.borrow_mut().push_back(message);
            if stop {
                self.told_to_stop.set(true);
                return true;
            }
        }
        false
    }

    fn next(&self) -> Result<Vec<u8>, WorkerError> {
        if let Some(message) = self.waiting.borrow_mut().pop_front() {
            return Ok(message);
        }
        loop {
            if let Some(message) = self.control.borrow_mut().receive(Duration::from_secs(3600))? {
                return Ok(message);
            }
        }
    }

    fn send(&self, message: &ToCoordinator, arrays: &[&[u8]]) -> Result<(), WorkerError> {
        let bytes = encode(message, arrays)?;
        Ok(self.control.borrow_mut().send(bytes)?)
    }

    /// What is left to do after a failed transfer: nothing if it failed because the run is over, else report it.
    fn interrupted(&self, failure: Failure) -> Result<(), WorkerError> {
        if self.told_to_stop.get() { Ok(()) } else { Err(self.fail(failure)) }
    }

    fn fail(&self, failure: Failure) -> WorkerError {
        let text = failure.to_string();
        if let Err(error) = self.send(&ToCoordinator::Failed(failure), &[]) {
            return error;
        }
        match self.control.borrow_mut().flush() {
            Ok(()) => WorkerError::Reported(text),
            Err(error) => error.into(),
        }
    }
}

/// Runs rank `rank` of `run` until the coordinator says stop.
pub fn run(run: &RunName, rank: usize) -> Result<(), WorkerError> {
    let member = run.join(&format!("worker {rank}"))?;
    let result = serve(run, rank);
    // The last one to leave removes what the run has put on the machine, also after a killed coordinator.
    drop(member);
    if let Err(error) = run.purge_if_last() {
        tracing::warn!("cannot remove the run's files: {error}");
    }
    result
}

fn serve(run: &RunName, rank: usize) -> Result<(), WorkerError> {
    let control = ControlWorker::connect(run, rank, COORDINATOR_PATIENCE)?;
    let inbox = Inbox { control: Rc::new(RefCell::new(control)), waiting: Rc::default(), told_to_stop: Rc::default() };
    let bytes = inbox.next()?;
    let (message, arrays) = decode::<ToWorker>(&bytes)?;
    match message {
        ToWorker::Simulate { setup, exchange, mut model } => {
            model.set_arrays(&arrays).map_err(|error| inbox.fail(Failure::Other(error.to_string())))?;
            drop(arrays);
            drop(bytes);
            simulate(run, rank, &inbox, &setup, &exchange, *model)
        }
        ToWorker::Solve { setup, exchange, params, mut system } => {
            let arrays = RankSystemArrays::from_bytes(&arrays, system.double_precision);
            system.arrays = arrays.map_err(|error| inbox.fail(Failure::Other(error.to_string())))?;
            drop(bytes);
            solve(run, rank, &inbox, &setup, &exchange, &params, &system)
        }
        ToWorker::Stop => Ok(()),
        other => Err(inbox.fail(Failure::Other(format!("{other:?} before this worker was set up")))),
    }
}

fn simulate(
    run: &RunName,
    rank: usize,
    inbox: &Inbox,
    setup: &WorkerSetup,
    exchange: &ExchangePlan,
    model: RankModel,
) -> Result<(), WorkerError> {
    let executor = make_executor(setup, rank).map_err(|message| inbox.fail(Failure::BadInput(message)))?;
    let (name, device) = (executor.name().to_string(), executor.device_name());
    let mut simulation = Simulation::new(executor, model, exchange).map_err(|error| inbox.fail(error.into()))?;
    let mut transport = match connect(run, rank, inbox, setup) {
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
                inbox.control.borrow().heartbeat().progress(step as u64, 0);
                match simulation.step(transport.as_mut(), step, record) {
                    Ok(stats) => {
                        let events = simulation.recorder.take();
                        inbox.send(&ToCoordinator::StepDone(Box::new(stats)), &[bytemuck::cast_slice(&events)])?;
                    }
                    Err(error) => return inbox.interrupted(error),
                }
            }
            ToWorker::SendState => {
                let (positions, velocities) = simulation.state();
                inbox.send(
                    &ToCoordinator::State,
                    &[bytemuck::cast_slice(&positions), bytemuck::cast_slice(&velocities)],
                )?;
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
    run: &RunName,
    rank: usize,
    inbox: &Inbox,
    setup: &WorkerSetup,
    exchange: &ExchangePlan,
    params: &SolveParams,
    system: &RankSystem,
) -> Result<(), WorkerError> {
    let executor = make_executor(setup, rank).map_err(|message| inbox.fail(Failure::BadInput(message)))?;
    let mut transport = match connect(run, rank, inbox, setup) {
        Ok(transport) => transport,
        Err(error) => return inbox.interrupted(error.into()),
    };
    match solve_rank(&executor, transport.as_mut(), system, exchange.mode, &exchange.queue, params) {
        Ok(mut result) => {
            let events = std::mem::take(&mut result.record.events);
            let (stats, executor, record) = (result.stats, executor.name().to_string(), result.record);
            let solved = ToCoordinator::Solved { stats, executor, record };
            inbox.send(&solved, &[bytemuck::cast_slice(&result.x), bytemuck::cast_slice(&events)])?;
            Ok(inbox.control.borrow_mut().flush()?)
        }
        Err(error) => inbox.interrupted(error.into()),
    }
}

/// Connects with all other ranks; a single rank needs no shared memory.
fn connect(
    run: &RunName,
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
    let options = IceoryxOptions {
        rank,
        ranks: setup.ranks,
        max_len: setup.max_message_values,
        deadline: Duration::from_secs_f64(setup.patience_s),
        on_wait: Box::new(move || hook.should_stop()),
    };
    let deadline = options.deadline;
    let transport = IceoryxTransport::connect(run, options)?;
    Ok(match &setup.links {
        Some(links) => Box::new(EmulatedTransport::new(transport, links.clone(), deadline)),
        None => Box::new(transport),
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
