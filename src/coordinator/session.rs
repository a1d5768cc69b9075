//! A session: a crew of workers that holds one level of a scene at a time, with a state of it, and steps from there.
//! Loading, setting a state and advancing may follow each other in any order and any number of times, on the same
//! processes.
//!
//! Several sessions may run side by side in one program, each on its own thread and with its own run name.

use std::time::Instant;

use thiserror::Error;

use super::crew::{Crew, CrewError, Launch};
use super::options::SessionOptions;
use super::plan::RunPlan;
pub use super::watch::{Next, StepDone, Watch, Way};
use crate::linear_system::{BlockSystem, SolveParams, SolveResult};
use crate::math::{DIM, Vec3};
use crate::model::{NotFinite, PlasticCounts, PlasticElements, RankModel, RankState, State};
use crate::os::signals;
use crate::partition::RowPartition;
use crate::protocol::{ToCoordinator, ToWorker, WorkerReady, WorkerSetup};
use crate::step::{ExchangePlan, Failure, Imposed, StepStats};
use crate::telemetry::Event;
use crate::transport::{MachineError, RunName, SetupTurn};

/// Longest wait of a worker for another one, seconds. Heartbeats detect ended or hung workers long before.
const PATIENCE_S: f64 = 3600.0;

/// Position of this session among the sessions side by side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionPlace {
    /// Number of the session, from 0.
    pub session: usize,
    /// Number of sessions side by side.
    pub sessions: usize,
}

impl SessionPlace {
    /// The only session of a program.
    pub const ALONE: SessionPlace = SessionPlace { session: 0, sessions: 1 };
}

/// Error that ends a session.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error)]
pub enum SessionError {
    /// The workers.
    #[error(transparent)]
    Crew(#[from] CrewError),
    /// The machine lacks room for the transfers.
    #[error(transparent)]
    Machine(#[from] MachineError),
    /// A value of the collected state is not finite. Workers themselves detect such values in a solve.
    #[error(transparent)]
    State(Failure),
    /// A state of another mesh.
    #[error("a state of {positions} vertices does not fit the loaded level, which has {vertices}")]
    Unfit { positions: usize, vertices: usize },
    /// A state of another mesh, or of a scene of which other fabrics are plastic.
    #[error("a state of {creases} creases does not fit the loaded level, which has {hinges}")]
    UnfitCreases { creases: usize, hinges: usize },
    /// A state of another mesh, or of a scene of which other fabrics stay stretched.
    #[error("a state of {stretches} rest stretches does not fit the loaded level, which has {triangles}")]
    UnfitStretches { stretches: usize, triangles: usize },
    /// A state that has let go of an obstacle that is not there.
    #[error("a state that has let go of obstacle {obstacle} does not fit the loaded level, which has {obstacles}")]
    NoObstacle { obstacle: u32, obstacles: usize },
    /// The motion that a step is to follow.
    #[error("{0}")]
    Way(String),
    /// A request to a session without a level.
    #[error("no level is loaded")]
    NotLoaded,
}

/// The level and state that the workers hold.
struct Loaded {
    partition: RowPartition,
    /// Vertex of the mesh of every row.
    order: Vec<u32>,
    /// As [`RankModel::plastic_elements`].
    plastic: Vec<PlasticElements>,
    /// Of a state.
    plastic_counts: PlasticCounts,
    obstacles: usize,
    step: u32,
}

struct Ports {
    epoch: u32,
    max_message_values: usize,
    emulated: bool,
}

/// Workers that can be loaded. Bound to the thread that created it.
pub struct Session {
    crew: Crew,
    options: SessionOptions,
    place: SessionPlace,
    ports: Option<Ports>,
    loaded: Option<Loaded>,
}

impl Session {
    /// Starts (or waits for) the workers and returns at once. Missing workers are detected when a level is loaded.
    ///
    /// # Errors
    /// A worker cannot be started or the machine lacks a resource.
    pub fn assemble(place: SessionPlace, options: &SessionOptions, launch: &Launch) -> Result<Session, SessionError> {
        // The lock is released when all workers have begun their first step, because the free shared memory is checked
        // before that.
        let turn = matches!(launch, Launch::Spawn).then(|| SetupTurn::wait(|| signals::stop_requested().is_some()));
        let mut crew = Crew::assemble(place.session * options.workers, options.workers, launch, options.silence)?;
        turn.into_iter().for_each(|turn| crew.keep(turn));
        Ok(Session { crew, options: options.clone(), place, ports: None, loaded: None })
    }

    /// Name of the run on this machine, if the workers are processes.
    pub fn run_name(&self) -> Option<&RunName> {
        self.crew.run_name()
    }

    /// Sends every worker its part of `level`, in the start state of the scene (step 0), and waits until all workers
    /// are connected. The workers first drop the data that they held before.
    ///
    /// # Errors
    /// A worker failed, or the transfers do not fit into shared memory.
    pub fn load(&mut self, level: &RunPlan) -> Result<Vec<WorkerReady>, SessionError> {
        self.loaded = None;
        let model = level.model();
        let links = level.links(&model);
        let setups = self.setups(level.message_values(), links.is_some())?;
        let setup_limit = self.crew.setup_limit();
        RankModel::split(&model, &level.partition, |rank, mut part| {
            let exchange = ExchangePlan { mode: level.exchange, queue: level.transfers.schedule.queues[rank].clone() };
            if let Some(collision) = &mut part.collision {
                collision.memory_limit_bytes = level.table_bytes;
            }
            // The serializer skips the arrays, because they follow the header unserialized.
            let links = links.as_ref().map(|links| links[rank].clone());
            let setup = WorkerSetup { links, ..setups[rank].clone() };
            let message = ToWorker::Load { setup, exchange, model: Box::new(part) };
            let ToWorker::Load { model, .. } = &message else { unreachable!("made above") };
            self.crew.send(rank, &message, &model.to_bytes())?;
            // Only one part at a time is in transit, so that the coordinator's memory stays at one part.
            self.crew.flush(rank, setup_limit)
        })?;
        let mut ready: Vec<Option<WorkerReady>> = vec![None; level.partition.ranks()];
        self.crew.collect(setup_limit, |rank, message, _| match message {
            ToCoordinator::Ready(worker) => {
                ready[rank] = Some(worker);
                true
            }
            _ => false,
        })?;
        self.loaded = Some(Loaded {
            partition: level.partition,
            plastic: RankModel::plastic_elements(&model, &level.partition),
            plastic_counts: model.plastic_elements().counts(),
            obstacles: model.obstacles.len(),
            order: model.original_from_global,
            step: 0,
        });
        let ready: Vec<WorkerReady> = ready.into_iter().flatten().collect();
        for (rank, worker) in ready.iter().enumerate() {
            let rows = level.partition.rows_of(rank);
            tracing::debug!(
                "rank {rank}: {} on {}, rows {}..{}, preconditioner {}",
                worker.executor,
                worker.device,
                rows.start,
                rows.end,
                worker.preconditioner.name()
            );
        }
        Ok(ready)
    }

    /// Sets the state of the loaded level to `state`, that of step `step`.
    ///
    /// # Errors
    /// A worker failed, no level is loaded, or the state does not belong to a mesh of this size.
    pub fn set_state(&mut self, state: &State, step: u32) -> Result<(), SessionError> {
        let loaded = self.loaded.as_mut().ok_or(SessionError::NotLoaded)?;
        let vertices = loaded.order.len();
        if state.vertices() != Some(vertices) {
            return Err(SessionError::Unfit { positions: state.positions.len(), vertices });
        }
        let (found, loaded_counts) = (state.plastic_counts(), loaded.plastic_counts);
        if found.creases != loaded_counts.creases {
            return Err(SessionError::UnfitCreases { creases: found.creases, hinges: loaded_counts.creases });
        }
        if found.stretches != loaded_counts.stretches {
            let (stretches, triangles) = (found.stretches, loaded_counts.stretches);
            return Err(SessionError::UnfitStretches { stretches, triangles });
        }
        let obstacles = loaded.obstacles;
        if let Some(one) = state.let_go.iter().find(|one| one.obstacle as usize >= obstacles) {
            return Err(SessionError::NoObstacle { obstacle: one.obstacle, obstacles });
        }
        let setup_limit = self.crew.setup_limit();
        for rank in 0..loaded.partition.ranks() {
            let part = state.gather(&loaded.order[loaded.partition.rows_of(rank)], &loaded.plastic[rank]);
            self.crew.send(rank, &ToWorker::SetState { step }, &part.to_bytes())?;
            self.crew.flush(rank, setup_limit)?;
        }
        loaded.step = step;
        Ok(())
    }

    /// Advances to step `to`, or until `watch` stops it.
    ///
    /// # Errors
    /// A worker failed, or a value of a requested state is not finite. The workers cannot be used afterwards.
    pub fn advance(&mut self, to: u32, watch: &mut dyn Watch) -> Result<(), SessionError> {
        let from = self.loaded.as_ref().ok_or(SessionError::NotLoaded)?.step;
        for step in from + 1..=to {
            let record = watch.wants_events(step);
            let mut done = self.step(step, record, &watch.way(step, false).map_err(SessionError::Way)?)?;
            if done.ranks[0].arrived == Some(false) {
                let other = match watch.way(step, true).map_err(SessionError::Way)? {
                    Way::Straight(_) => Way::Free,
                    other => other,
                };
                done = self.step(step, record, &other)?;
            }
            let arrived = done.ranks[0].arrived == Some(true);
            match watch.step(done) {
                Next::Step => {}
                Next::Leave => break,
                Next::State => {
                    let state = self.state()?;
                    if let Some(found) = state.first_not_finite() {
                        return Err(SessionError::State(not_finite(step, found)));
                    }
                    if watch.state(step, state).is_break() {
                        break;
                    }
                }
            }
            if arrived {
                break;
            }
        }
        Ok(())
    }

    fn step(&mut self, step: u32, record: bool, way: &Way) -> Result<StepDone, SessionError> {
        let start = Instant::now();
        self.order_step(step, record, way)?;
        let ranks = self.crew.ranks();
        let mut stats = vec![StepStats::default(); ranks];
        let mut events = vec![Vec::new(); ranks];
        let collected = self.crew.collect(self.options.silence, |rank, message, arrays| match (message, arrays) {
            (ToCoordinator::StepDone(done), [bytes]) => {
                stats[rank] = *done;
                events[rank] = bytes.chunks_exact(size_of::<Event>()).map(bytemuck::pod_read_unaligned).collect();
                true
            }
            _ => false,
        });
        let loaded = self.loaded.as_mut().ok_or(SessionError::NotLoaded)?;
        collected.map_err(|error| in_mesh_order(error, &loaded.order))?;
        if stats[0].arrived != Some(false) {
            loaded.step = step;
        }
        Ok(StepDone { step, ranks: stats, events, wall_s: start.elapsed().as_secs_f64() })
    }

    fn order_step(&mut self, step: u32, record: bool, way: &Way) -> Result<(), SessionError> {
        let loaded = self.loaded.as_ref().ok_or(SessionError::NotLoaded)?;
        let vertices = loaded.order.len();
        let unfit = |positions: usize| SessionError::Unfit { positions, vertices };
        let setup_limit = self.crew.setup_limit();
        match way {
            Way::Free => self.crew.broadcast(&ToWorker::Step { step, record })?,
            Way::Guided { start, end, guidance } => {
                if let Some(wrong) = [start, end].into_iter().find(|positions| positions.len() != vertices) {
                    return Err(unfit(wrong.len()));
                }
                for rank in 0..loaded.partition.ranks() {
                    let rows = &loaded.order[loaded.partition.rows_of(rank)];
                    let own = |all: &[Vec3]| rows.iter().map(|&v| all[v as usize]).collect::<Vec<_>>();
                    let (start, end) = (own(start), own(end));
                    let arrays = [bytemuck::cast_slice(&start), bytemuck::cast_slice(&end)];
                    self.crew.send(rank, &ToWorker::GuidedStep { step, record, guidance: *guidance }, &arrays)?;
                    self.crew.flush(rank, setup_limit)?;
                }
            }
            Way::Straight(state) => {
                if state.vertices() != Some(vertices) {
                    return Err(unfit(state.positions.len()));
                }
                for rank in 0..loaded.partition.ranks() {
                    let part = state.gather(&loaded.order[loaded.partition.rows_of(rank)], &loaded.plastic[rank]);
                    self.crew.send(rank, &ToWorker::Arrive { step, record }, &part.to_bytes())?;
                    self.crew.flush(rank, setup_limit)?;
                }
            }
        }
        Ok(())
    }

    /// The state of the whole cloth.
    ///
    /// # Errors
    /// A worker failed, or no level is loaded.
    pub fn state(&mut self) -> Result<State, SessionError> {
        let loaded = self.loaded.as_ref().ok_or(SessionError::NotLoaded)?;
        let Loaded { partition, order, plastic, plastic_counts, .. } = loaded;
        self.crew.broadcast(&ToWorker::SendState)?;
        let mut state = State::zeros(order.len(), *plastic_counts);
        self.crew.collect(self.options.silence, |rank, message, arrays| {
            let rows = partition.rows_of(rank);
            let ToCoordinator::State = message else { return false };
            let Ok(part) = RankState::from_bytes(arrays, rows.len(), plastic[rank].counts()) else { return false };
            state.scatter(&order[rows], &plastic[rank], &part);
            true
        })?;
        Ok(state)
    }

    /// Solves a linear system on all workers, each with its part of `system` and `rhs`. Returns the results by rank and
    /// the name of the executor. `exchange`: that of every rank. The loaded level is dropped first.
    ///
    /// # Errors
    /// A worker failed, or the transfers do not fit into shared memory.
    pub fn solve(
        &mut self,
        system: BlockSystem,
        rhs: Vec<f64>,
        partition: &RowPartition,
        exchange: &[ExchangePlan],
        params: SolveParams,
    ) -> Result<(Vec<SolveResult>, String), SessionError> {
        self.loaded = None;
        // The exchange of a solution in double precision carries two f32 per value.
        let setups = self.setups(partition.sub_vector_rows() * 2 * DIM, false)?;
        let setup_limit = self.crew.setup_limit();
        system.split(rhs, partition, |rank, mut part| {
            let arrays = std::mem::take(&mut part.arrays);
            let (setup, exchange) = (setups[rank].clone(), exchange[rank].clone());
            let message = ToWorker::Solve { setup, exchange, params, system: Box::new(part) };
            self.crew.send(rank, &message, &arrays.to_bytes())?;
            self.crew.flush(rank, setup_limit)
        })?;
        let mut results: Vec<Option<SolveResult>> = vec![None; partition.ranks()];
        let mut name = String::new();
        self.crew.collect(self.options.silence, |rank, message, arrays| match (message, arrays) {
            (ToCoordinator::Solved { stats, executor, mut record }, [x, events]) => {
                let x = x.chunks_exact(size_of::<f64>()).map(bytemuck::pod_read_unaligned).collect();
                record.events = events.chunks_exact(size_of::<Event>()).map(bytemuck::pod_read_unaligned).collect();
                results[rank] = Some(SolveResult { stats, x, record });
                name = executor;
                true
            }
            _ => false,
        })?;
        Ok((results.into_iter().flatten().collect(), name))
    }

    /// Orders the workers to leave and waits until they have ended.
    pub fn dismiss(self) {
        self.crew.dismiss();
    }

    /// Setups of the workers, by rank. Messages that exceed the existing ports require new ports.
    fn setups(&mut self, max_message_values: usize, emulated: bool) -> Result<Vec<WorkerSetup>, SessionError> {
        let ranks = self.crew.ranks();
        // A single rank does not send messages.
        let max_message_values = if ranks == 1 { 0 } else { max_message_values };
        let epoch = match &self.ports {
            // Emulated links belong to a level.
            Some(ports) if max_message_values <= ports.max_message_values && !emulated && !ports.emulated => {
                ports.epoch
            }
            there => {
                // On later loads the workers drop their ports first and check the free memory themselves.
                if there.is_none() {
                    self.crew.machine().check_transfers(ranks, max_message_values)?;
                }
                let epoch = there.as_ref().map_or(0, |ports| ports.epoch + 1);
                self.ports = Some(Ports { epoch, max_message_values, emulated });
                epoch
            }
        };
        let setup = WorkerSetup {
            executor: self.options.executor,
            adapter: self.options.adapter,
            threads: self.options.threads_of(self.place.sessions, self.crew.machine()),
            bind_cores: self.options.bind_cores,
            ranks,
            place: 0,
            places: 1,
            epoch,
            max_message_values: self.ports.as_ref().map_or(max_message_values, |ports| ports.max_message_values),
            patience_s: PATIENCE_S,
            links: None,
        };
        let placed = |rank: usize| {
            let (index, workers) = (self.place.session * ranks + rank, self.place.sessions * ranks);
            let (place, places) = self.crew.machine().place(index, workers);
            WorkerSetup { place, places, ..setup.clone() }
        };
        Ok((0..ranks).map(placed).collect())
    }
}

impl SessionError {
    /// The sentence for the user; `vertex_name` names a vertex of the mesh.
    pub fn sentence(&self, vertex_name: &dyn Fn(u32) -> String) -> String {
        match self {
            SessionError::Crew(error) => error.sentence(vertex_name),
            SessionError::State(failure) => failure.sentence(vertex_name),
            other => other.to_string(),
        }
    }

    /// True if the user can correct the error before the run starts.
    pub fn is_bad_input(&self) -> bool {
        match self {
            SessionError::Crew(error) => error.is_bad_input(),
            SessionError::Machine(error) => matches!(error, MachineError::TooSmall(_)),
            _ => false,
        }
    }
}

/// Its row is the vertex of the mesh, as in all output of a session.
fn not_finite(step: u32, found: NotFinite) -> Failure {
    Failure::NotFinite {
        step,
        row: found.vertex,
        quantity: found.quantity.into(),
        cause: "after the step".into(),
        suspect: "simulation.step_s, the start velocity or a force".into(),
    }
}

/// Converts the rows that workers name to vertices of the mesh.
fn in_mesh_order(mut error: CrewError, order: &[u32]) -> CrewError {
    let vertex = |row: &mut u32| *row = order.get(*row as usize).copied().unwrap_or(*row);
    if let CrewError::Failed { failure, .. } = &mut error {
        match failure {
            Failure::NotFinite { row, .. } => vertex(row),
            Failure::Squeezed { imposed, .. } => imposed.iter_mut().for_each(|one| match one {
                Imposed::Pin(row) => vertex(row),
                Imposed::Obstacle(_) => {}
            }),
            _ => {}
        }
    }
    error
}
