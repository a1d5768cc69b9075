//! One time step of one rank [Li et al. 2020, Fig. 2]. This is the only module that uses all stages.
//!
//! Every rank of a run calls [`Simulation::step`] with the same step number, because the calls inside exchange data.

mod collisions;
mod comparison;
mod creases;
mod elements;
mod error;
mod guidance;
mod guide;
mod inspect;
mod let_go;
mod let_go_pairs;
mod limited;
mod limits;
mod normal_forces;
mod over_time;
mod own_state;
mod pinned;
mod products;
mod second_solve;
mod span;
mod stats;
mod substeps;
mod system;

use std::ops::Range;
use std::rc::Rc;

use crate::assembly::fill::FillParams;
use crate::context::RankContext;
use crate::forces::contact::ContactStep;
use crate::gpu::{CpuExecutor, Executor};
use crate::integrator::inertia::Inertia;
use crate::integrator::pins::{PinPaths, PinTargets, Pins, Spring};
use crate::integrator::surfaces::Surfaces;
use crate::math::DIM;
use crate::model::{RankModel, RankState};
use crate::scene::{Obstacles, Settings};
use crate::solver::{LinearSolver, PcgError, PcgParams, Schwarz, TrafficCounter};
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Transport, TransportError};

use collisions::{Collisions, Limits, RankContacts, Resolved};
use elements::Elements;
pub use error::{Failure, Imposed, SetupError};
use guidance::Guided;
pub use guidance::{Guidance, Guide};
use limited::LimitedTriangles;
use own_state::StateVectors;
use span::Span;
pub use stats::{LetGoCounts, LimitCounts, QueryStats, StageSeconds, StepStats};
use stats::{StageClock, peak_resident_bytes};
pub use substeps::parts_of_step;
pub use system::ExchangePlan;
use system::{Assembled, ColumnOrder, StepMatrix, System};

/// Maximum number of halvings of a step that cannot be solved, or whose end cannot be freed of penetrations.
const HALVINGS_MAX: u32 = 4;
/// Maximum number of halvings of a step whose impacts take many rounds. Shorter steps let contact forces act before
/// impact zones are needed.
const HALVINGS_FOR_SPEED: u32 = 2;
/// k dt^2 / (rho h^2) from which on a solve stops by the energy of its error, too, and is repeated around its result.
/// Cotton in steps of 4 ms reaches it in triangles lower than 1 mm.
const STIFF: f64 = 5e4;
/// Maximum number of halvings of a step whose solve breaks off. After that the best iterate counts.
const HALVINGS_FOR_SOLVE: u32 = 3;
/// Rounds of impact zones after which a step is halved.
const ROUNDS_MOST: u32 = 5;

/// How an attempt to advance over a span ended. It is the same on every rank.
enum Attempt {
    /// The state is that of the end of the span.
    Done,
    /// The span is taken again, in two halves, from the state at its start.
    Again(Again),
}

/// Why a span is taken again. After [`HALVINGS_MAX`] halvings the reason becomes the failure of the run, except that
/// the last iterate of a solve that breaks off is used after [`HALVINGS_FOR_SOLVE`].
enum Again {
    /// Impacts took more rounds than allowed.
    Slow,
    /// The end of the span is not free of penetrations.
    Squeezed(Vec<Imposed>),
    /// Vertices without room between obstacles that overlap have been let go: the same span again.
    LetGo,
    /// The solve broke off. Neither positions nor velocities have been changed.
    Unsolved,
}

/// One rank's simulation.
pub struct Simulation {
    executor: Executor,
    /// Events of the steps for which recording was requested.
    pub recorder: Recorder,
    /// Slots of the matrix divided by its stored blocks.
    pub padding_ratio: f64,
    cloth: RankCloth,
}

/// A rank's part of the cloth, with the modules that advance it.
struct RankCloth {
    settings: Settings,
    /// Mean of the smallest altitudes of the triangles at rest, meters.
    cell_m: f64,
    /// Own rows in the global order.
    rows: Range<usize>,
    pins: Pins,
    pins_move: bool,
    /// See [`STIFF`].
    stiff: bool,
    /// See [`crate::model::GlobalModel::stiffness_ratio`].
    stiffness_ratio: f64,
    /// True until the first step from the start state or from a state that was set.
    state_is_new: bool,
    pin_paths: PinPaths,
    /// True if a pin of any rank is a spring.
    springs: bool,
    /// Springs on own rows in this part of the step.
    own_springs: Vec<Spring>,
    state: StateVectors,
    elements: Elements,
    /// Present if a fabric of the scene has strain limits.
    limited: Option<LimitedTriangles>,
    system: System,
    columns: ColumnOrder,
    matrix: Box<dyn StepMatrix>,
    solver: LinearSolver,
    inertia: Inertia,
    /// Factor on the friction coefficients of the scene at this time.
    friction_factor: f32,
    /// Present during a step that is drawn toward a guide.
    guided: Option<Guided>,
    collisions: Option<Collisions>,
}

impl Simulation {
    /// Sets a rank up on `executor`.
    pub fn new(executor: Executor, model: RankModel, exchange: &ExchangePlan) -> Result<Simulation, SetupError> {
        let (cloth, padding_ratio) = RankCloth::new(&executor, model, exchange)?;
        match executor.take_fault() {
            Some(fault) => Err(fault.into()),
            None => Ok(Simulation { recorder: Recorder::new(executor.clock()), executor, padding_ratio, cloth }),
        }
    }

    /// Advances the own rows from step `step - 1` to `step` (counted from 1). `record`: keep the events of this step.
    pub fn step(&mut self, transport: &mut dyn Transport, step: u32, record: bool) -> Result<StepStats, Failure> {
        self.recorder.begin_step(step, record);
        let clock = StageClock::start();
        let span = Span::of_step(step, self.cloth.settings.step_s);
        let mut stats = StepStats { step, converged: true, ..StepStats::default() };
        self.cloth.solver.spmv.traffic = TrafficCounter::default();
        let mut rank = RankContext { executor: &self.executor, transport, recorder: &mut self.recorder };
        self.cloth.advance_in_parts(&mut rank, span, &mut stats)?;
        self.cloth.yield_beyond(&mut rank, &mut stats)?;
        if let Some(collisions) = &mut self.cloth.collisions {
            collisions.take_up(&mut rank, &mut stats)?;
        }
        self.cloth.pins.let_go(span.end_s, span.length_s);
        self.cloth.state_is_new = false;
        if let Some(fault) = self.executor.take_fault() {
            return Err(Failure::in_step(step, fault));
        }
        stats.seconds.total = clock.total();
        stats.spmv_bytes = self.cloth.solver.spmv.traffic.received_bytes;
        stats.state_bytes += self.cloth.state.take_received_bytes();
        stats.memory_bytes = self.memory_bytes();
        stats.resident_bytes = peak_resident_bytes();
        Ok(stats)
    }

    /// Continues from `state`, the own rows of a state that every rank receives before the next step. No result of
    /// earlier steps is reused: pins take hold anew, and collision detection starts anew.
    pub fn set_state(&mut self, state: RankState) {
        let (executor, cloth) = (&self.executor, &mut self.cloth);
        let values = cloth.rows.len() * DIM;
        assert_eq!((state.positions.len(), state.velocities.len()), (values, values), "the state of the own rows");
        cloth.elements.set_plastic(executor, &state);
        cloth.take_rest_shapes(executor);
        if let Some(collisions) = &mut cloth.collisions {
            collisions.forget_state(&state.let_go);
        }
        cloth.pins.set_holds(&state.holds);
        cloth.state.set(executor, Rc::new(state));
        cloth.system.pinned.fill_zero(executor);
        cloth.state_is_new = true;
    }
}

impl RankCloth {
    /// The state at the start of a run, and the data that depends only on the pattern of the matrix; also the slots of
    /// the matrix divided by its stored blocks.
    fn new(executor: &Executor, model: RankModel, exchange: &ExchangePlan) -> Result<(RankCloth, f64), SetupError> {
        let RankModel {
            partition,
            plan,
            pins,
            motions,
            followed,
            surfaces,
            springs,
            settings,
            cell_m,
            pins_move,
            stiffness_ratio,
            plastic,
            closing,
            collision,
            mut arrays,
        } = model;
        let columns = ColumnOrder::new(&partition, exchange);
        let elements = Elements::new(executor, &arrays, plastic, closing);
        let matrix = Assembled::new(executor, &arrays, &elements, &columns.numbering(&plan))?;
        let threads = host_threads(executor, partition.ranks());
        let collisions = collision
            .map(|model| Collisions::new(threads, partition, plan.clone(), model, settings.step_s))
            .transpose()?;
        let schwarz = Schwarz::wanted(settings.preconditioner, executor, &partition, settings.relative_tolerance)
            .map_err(SetupError::Preconditioner)?
            .then(|| matrix.schwarz(executor, &partition, &plan, exchange, &columns.numbering(&plan)));
        let followed = Obstacles::from_parts(followed, std::mem::take(&mut arrays.followed), Vec::new())
            .ok_or_else(|| SetupError::Pins("the followed vertices do not fit their header".into()))?;
        let surfaces = Obstacles::from_parts(surfaces, std::mem::take(&mut arrays.surface_positions), Vec::new())
            .and_then(|obstacles| {
                let vertices = std::mem::take(&mut arrays.surface_vertices);
                let triangles = std::mem::take(&mut arrays.surface_triangles);
                Surfaces { obstacles, vertices, triangles }.checked()
            })
            .ok_or_else(|| SetupError::Pins("the obstacles to take hold of do not fit their header".into()))?;
        let padding_ratio = matrix.padding_ratio();
        let cloth = RankCloth {
            cell_m,
            rows: partition.rows_of(plan.rank),
            pins: Pins::new(pins),
            pins_move,
            stiff: stiffness_ratio >= STIFF,
            stiffness_ratio,
            state_is_new: true,
            pin_paths: PinPaths { motions, followed, surfaces, touch_m: settings.thickness_m },
            springs,
            own_springs: Vec::new(),
            state: StateVectors::new(executor, &arrays, plan.own.clone()),
            elements,
            limited: LimitedTriangles::of(&arrays),
            system: System::new(executor, &arrays.masses),
            columns,
            matrix: Box::new(matrix),
            solver: LinearSolver::new(executor, &partition, plan, exchange.mode, &exchange.queue, schwarz),
            inertia: Inertia::new(executor),
            friction_factor: 1.0,
            guided: None,
            collisions,
            settings,
        };
        Ok((cloth, padding_ratio))
    }

    /// Advances over `span`; if one attempt does not get there, from its start in two halves, and so on down to
    /// 2^[`HALVINGS_MAX`] parts. Any stage of [`RankCloth::solve_over`] may ask for shorter steps by returning
    /// [`Attempt::Again`], on all ranks alike.
    fn advance_over(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        halvings: u32,
        stats: &mut StepStats,
    ) -> Result<(), Failure> {
        let state = self.collisions.is_some().then(|| self.state.recorded(rank));
        let pins = self.pins.clone();
        let again = loop {
            match self.solve_over(rank, span, halvings, stats)? {
                Attempt::Done => return Ok(()),
                Attempt::Again(Again::LetGo) => {
                    // Each time a pair more, of finitely many.
                    if let Some(state) = &state {
                        self.state.set(rank.executor, Rc::clone(state));
                    }
                    self.pins = pins.clone();
                }
                Attempt::Again(again) => break again,
            }
        };
        if halvings == HALVINGS_MAX {
            return Err(match again {
                Again::Slow => Failure::Squeezed { step: stats.step, imposed: Vec::new() },
                Again::Squeezed(imposed) => Failure::Squeezed { step: stats.step, imposed },
                Again::Unsolved => unreachable!("solves ask for at most {HALVINGS_FOR_SOLVE} halvings"),
                Again::LetGo => unreachable!("the span was taken again"),
            });
        }
        if let (Some(state), Again::Slow | Again::Squeezed(_)) = (state, &again) {
            self.state.set(rank.executor, state);
        }
        self.pins = pins;
        stats.zones.halvings += 1;
        for half in span.halves() {
            self.advance_over(rank, half, halvings + 1, stats)?;
        }
        Ok(())
    }

    /// One implicit step over `span` [Li et al. 2020, Fig. 2], the part of a step after `halvings` of it.
    fn solve_over(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        halvings: u32,
        stats: &mut StepStats,
    ) -> Result<Attempt, Failure> {
        let clock = StageClock::start();

        // 1. Settings, pins and obstacles at t1.
        self.take_time(rank.executor, span);
        let targets = self.move_pins(rank, span)?;
        self.aim(rank, span);
        let prescribed = self.starts_prescribed(rank, &targets)?;

        // 2. Proximity: pairs closer than the thickness become contact elements; with them come halo rows.
        self.find_contacts(rank, span, stats)?;
        clock.restart();
        self.state.exchange(rank, self.solver.spmv.halo())?;
        clock.lap_kernels(rank.executor, &mut stats.seconds.exchange);

        // 3. Assembly elements.
        self.element_records(rank, span, span.length_s);
        clock.lap_kernels(rank.executor, &mut stats.seconds.elements);
        rank.transport.alive()?;

        // 4. Matrix, right-hand side, preconditioner of the own rows.
        self.fill_matrix(rank, span, span.length_s);
        clock.lap_kernels(rank.executor, &mut stats.seconds.value_fill);
        rank.transport.alive()?;

        // 5. (M - dt D - dt^2 K) dv = dt (f + dt K v)
        self.state.prescribe(rank.executor, &targets, &mut self.solver.vectors.x);
        let relative_tolerance = self.first_tolerance(stats.contacts > 0);
        let solved = self.solve(rank, relative_tolerance, prescribed, halvings < HALVINGS_FOR_SOLVE, stats)?;
        clock.lap_kernels(rank.executor, &mut stats.seconds.solve);
        if !solved {
            return Ok(Attempt::Again(Again::Unsolved));
        }

        let before =
            (self.stiff || self.limited.is_some() || self.collisions.is_some()).then(|| self.state.recorded(rank));
        // 6. v(t1) = v(t0) + dv, x(t1) = x(t0) + dt v(t1); pins exactly.
        self.state.advance(rank, span, &self.solver.vectors.x, &targets);
        clock.lap_kernels(rank.executor, &mut stats.seconds.advance);
        if let Some(before) = before {
            let solved_again = self.solve_again(rank, span, &before, &targets, stats)?;
            self.keep_limits(rank, span, &before, &targets, solved_again, stats)?;
        }

        // 7. Continuous collision detection over the step and impact zones until nothing penetrates.
        self.resolve_impacts(rank, span, halvings, stats)
    }

    /// True if a pin of any rank changes its velocity, so that the solve starts from prescribed values. A pin at rest
    /// does so only in the first step from a state that was set.
    fn starts_prescribed(&mut self, rank: &mut RankContext<'_>, targets: &PinTargets) -> Result<bool, TransportError> {
        if self.pins_move || !self.state_is_new {
            return Ok(self.pins_move);
        }
        let start = rank.recorder.now();
        let own = targets.velocity_changes.iter().any(|change| *change != [0.0; 3]);
        let mut all = Vec::new();
        rank.transport.all_gather(&[f64::from(u8::from(own))], &mut all)?;
        rank.recorder.end(EventName::AllReduce, Activity::Wait, start, size_of::<f64>() as u64, 0);
        Ok(all.iter().flatten().any(|&of_rank| of_rank != 0.0))
    }

    /// Contacts of the state at t0: their elements, their halo rows, and the obstacle vertices they touch.
    fn find_contacts(&mut self, rank: &mut RankContext<'_>, span: Span, stats: &mut StepStats) -> Result<(), Failure> {
        let Some(collisions) = &mut self.collisions else { return Ok(()) };
        let own = self.state.recorded(rank);
        let gravity_m_s2 = self.settings.gravity_m_s2.to_array();
        let found = collisions.contacts(rank, (&own.positions, &own.velocities), gravity_m_s2, span, stats)?;
        self.take_contacts(rank, found, stats)
    }

    /// Obstacle vertices, Index Table and halo of the contacts.
    fn take_contacts(
        &mut self,
        rank: &mut RankContext<'_>,
        mut found: RankContacts,
        stats: &mut StepStats,
    ) -> Result<(), Failure> {
        let clock = StageClock::start();
        let start = rank.recorder.now();
        let rows = found.plan.local_rows;
        self.state.put_obstacles(rank.executor, rows, &found.obstacle_positions, &found.obstacle_velocities);
        self.solver.vectors.grow(rank.executor, rows);
        let numbering = self.columns.numbering(&found.plan);
        self.change_friction(&mut found.elements);
        let contacts = &mut self.system.contacts;
        let taken = self.matrix.take_contacts(rank.executor, contacts, &found.elements, &numbering);
        taken.map_err(|error| Failure::in_step(stats.step, error))?;
        self.solver.spmv.halo().set_plan(found.plan);
        rank.recorder.end(EventName::IndexFill, Activity::Compute, start, self.system.contacts.bytes(), 0);
        clock.lap_kernels(rank.executor, &mut stats.seconds.index_fill);
        Ok(())
    }

    /// `ahead_s`: forces are those at this time after the state, to first order.
    fn element_records(&mut self, rank: &mut RankContext<'_>, span: Span, ahead_s: f64) {
        let start = rank.recorder.before_kernels();
        self.elements.fill_records(rank.executor, &self.settings, span, ahead_s, &self.state);
        let step_s = span.length_s as f32;
        let velocities = &self.state.velocities;
        let at_end = ahead_s == 0.0;
        let starts = if at_end { &self.state.start_velocities } else { velocities };
        let falls_m = self.settings.gravity_m_s2 * (step_s * step_s);
        let step = ContactStep {
            step_s,
            stiffness_ratio: self.settings.contact_stiffness as f32,
            at_end,
            fall_m: if at_end { [0.0; 3] } else { falls_m.to_array() },
            rows: self.solver.spmv.halo().plan().local_rows as u32,
        };
        self.system.contacts.records(rank.executor, &step, velocities, starts);
        let (bytes, flops) = (self.elements.moved_bytes(), self.elements.flops());
        rank.recorder.end(EventName::Elements, Activity::Compute, start, bytes, flops);
    }

    /// `ahead_s`: as that of [`RankCloth::element_records`].
    fn fill_matrix(&mut self, rank: &mut RankContext<'_>, span: Span, ahead_s: f64) {
        let params = FillParams {
            gravity: (self.settings.gravity_m_s2 * self.gravity_share()).to_array(),
            step_s: span.length_s as f32,
            rows: self.rows.len() as u32,
        };
        self.matrix.fill(rank, &params, &self.elements, &mut self.system);
        self.push(rank, span);
        self.pull_along(rank);
        self.pull_springs(rank, span, ahead_s);
    }

    /// Solves for dv. False: the solve broke off and `may_halve` is true, because shorter steps can mend that: mass
    /// outweighs stiffness there. Otherwise a solve that broke off counts with its last iterate, which has the smallest
    /// energy so far.
    fn solve(
        &mut self,
        rank: &mut RankContext<'_>,
        relative_tolerance: f64,
        prescribed: bool,
        may_halve: bool,
        stats: &mut StepStats,
    ) -> Result<bool, Failure> {
        let params = PcgParams {
            relative_tolerance,
            max_iterations: self.settings.max_iterations,
            energy: self.stiff,
            nonzero_start: prescribed,
        };
        let solved = self.matrix.solve(rank, &self.elements, &self.system, &mut self.solver, &params);
        let info = match solved {
            Ok(info) => info,
            Err(PcgError::NotPositiveDefinite { iteration, .. }) => {
                (stats.iterations, stats.products) = (stats.iterations + iteration, stats.products + iteration + 1);
                stats.breakdowns += 1;
                stats.converged &= may_halve;
                return Ok(!may_halve);
            }
            Err(PcgError::NotFinite { iteration }) if may_halve => {
                if let Some(fault) = rank.executor.take_fault() {
                    return Err(Failure::in_step(stats.step, fault));
                }
                (stats.iterations, stats.products) = (stats.iterations + iteration, stats.products + iteration + 1);
                stats.breakdowns += 1;
                return Ok(false);
            }
            Err(error) => return Err(self.explain(rank.executor, stats.step, error)),
        };
        stats.iterations += info.iterations;
        stats.products += info.products;
        stats.converged &= info.converged;
        stats.residual = stats.residual.max(info.relative_residual);
        Ok(true)
    }

    /// Frees the state at t1 of penetrations. Moved vertices get the velocity of their motion over the step.
    fn resolve_impacts(
        &mut self,
        rank: &mut RankContext<'_>,
        span: Span,
        halvings: u32,
        stats: &mut StepStats,
    ) -> Result<Attempt, Failure> {
        let Some(collisions) = &mut self.collisions else { return Ok(Attempt::Done) };
        let own = self.state.recorded(rank);
        if let Some(at) = own.positions.iter().position(|x| !x.is_finite()) {
            return Err(Failure::NotFinite {
                step: stats.step,
                row: (self.rows.start + at / 3) as u32,
                quantity: "position".into(),
                cause: "after the step".into(),
                suspect: "simulation.step_s or a velocity".into(),
            });
        }
        let rounds_most = if halvings < HALVINGS_FOR_SPEED { ROUNDS_MOST } else { u32::MAX };
        let limits = Limits { rounds_most, at_last: halvings == HALVINGS_MAX };
        let moved = match collisions.resolve(rank, &own.positions, span, limits, stats)? {
            Resolved::Free(moved) => moved,
            Resolved::Slow => return Ok(Attempt::Again(Again::Slow)),
            Resolved::LetGo => return Ok(Attempt::Again(Again::LetGo)),
            Resolved::Squeezed(imposed) => return Ok(Attempt::Again(Again::Squeezed(imposed))),
        };
        if !moved.is_empty() {
            let (mut positions, mut velocities) = (own.positions.clone(), own.velocities.clone());
            for (row, x) in moved {
                let at = row as usize * 3;
                for axis in 0..3 {
                    velocities[at + axis] += (x[axis] - positions[at + axis]) / span.length_s as f32;
                }
                positions[at..at + 3].copy_from_slice(&x);
            }
            self.state.set(rank.executor, Rc::new(RankState { positions, velocities, ..RankState::default() }));
        }
        Ok(Attempt::Done)
    }
}

/// Threads for work on the host: those of the cpu executor, or with a device a rank's share of the cores.
fn host_threads(executor: &Executor, ranks: usize) -> CpuExecutor {
    match executor {
        Executor::Cpu(cpu) => CpuExecutor::new(cpu.threads()),
        Executor::Gpu(_) => CpuExecutor::new((crate::transport::cores() / ranks).max(1)),
    }
}
