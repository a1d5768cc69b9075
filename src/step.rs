//! One time step of one rank [Li et al. 2020, Fig. 2]: the only place that sees all stages.
//!
//! Every rank of a run calls [`Simulation::step`] with the same step number; the calls inside meet over the transport.

mod collisions;
mod error;
mod inspect;
mod own_state;
mod products;
mod stats;

use std::ops::Range;
use std::rc::Rc;

use serde::{Deserialize, Serialize};

use crate::assembly::fill::{Fill, FillParams, FillTables};
use crate::assembly::{ContactSystem, ElementRows, Numbering, SellMatrix, SubVectors};
use crate::context::RankContext;
use crate::forces::bend::Bend;
use crate::forces::stretch::Stretch;
use crate::forces::{
    FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams, TRIANGLE_RECORD_FLOATS, TriangleElement,
};
use crate::gpu::{CpuExecutor, DeviceVec, Executor};
use crate::integrator::advance::Advance;
use crate::integrator::pins::{PinTargets, Pins};
use crate::integrator::scatter::Scatter;
use crate::interconnect::QueueNode;
use crate::model::{RankModel, RankState};
use crate::scene::{Motion, Settings};
use crate::solver::comparison::{MatrixFree, MatrixFreeProduct};
use crate::solver::{ExchangeMode, LinearSolver, LinearSystem, PcgParams, RankPattern, Schwarz, TrafficCounter};
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Transport, TransportError};

use collisions::{Collisions, Resolved, Span};
pub use error::{Failure, Imposed, SetupError};
use own_state::StateCopy;
pub use stats::{QueryStats, StageSeconds, StepStats};
use stats::{StageClock, peak_resident_bytes};

/// Times a step may be cut in two if its end cannot be freed of penetrations otherwise.
const HALVINGS_MAX: u32 = 4;
/// Times a step may be cut in two because its impacts take many rounds: contact forces stop in short steps what zones have to
/// disentangle after a long one.
const HALVINGS_FOR_SPEED: u32 = 2;
/// Rounds of impact zones before that.
const ROUNDS_MOST: u32 = 5;

/// How the ranks of a run exchange and who receives what when.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ExchangePlan {
    /// What SpMV exchanges.
    pub mode: ExchangeMode,
    /// Own work queue: one sub-vector per stage.
    pub queue: Vec<QueueNode>,
}

/// The matrix of a step as element records; borrows only what it is made of.
macro_rules! element_matrix {
    ($simulation:ident) => {{
        let [triangle_lists, hinge_lists] = $simulation.fill_tables.lists();
        $crate::solver::comparison::ElementMatrix {
            triangle_lists,
            hinge_lists,
            triangles: &$simulation.triangles,
            hinges: &$simulation.hinges,
            triangle_records: &$simulation.triangle_records,
            hinge_records: &$simulation.hinge_records,
            masses: &$simulation.masses,
            contacts: $simulation.contacts.contact_records(),
        }
    }};
}
use element_matrix;

/// One rank's simulation.
pub struct Simulation {
    executor: Executor,
    settings: Settings,
    motions: Vec<Motion>,
    pins: Pins,
    pins_move: bool,
    /// The state was set from outside and no step has been made from it yet.
    state_is_new: bool,
    rows_start: usize,
    own_rows: usize,
    own_start: usize,

    fabrics: DeviceVec<FabricTable>,
    triangles: DeviceVec<TriangleElement>,
    hinges: DeviceVec<HingeElement>,
    triangle_records: DeviceVec<f32>,
    hinge_records: DeviceVec<f32>,
    masses: DeviceVec<f32>,
    pinned: DeviceVec<u32>,
    positions: DeviceVec<f32>,
    velocities: DeviceVec<f32>,
    copy: StateCopy,

    fill_tables: FillTables,
    matrix: SellMatrix,
    /// If set, `matrix` stays empty and products are made from the element records.
    matrix_free: Option<MatrixFree>,
    contacts: ContactSystem,
    /// Row blocks of all ranks, and the order in which their sub-vectors arrive.
    rows_of: Vec<Range<usize>>,
    order: Vec<usize>,
    mode: ExchangeMode,
    collisions: Option<Collisions>,
    rhs: DeviceVec<f32>,
    inverse_diagonal: DeviceVec<f32>,
    solver: LinearSolver,

    stretch: Stretch,
    bend: Bend,
    fill: Fill,
    advance: Advance,
    scatter: Scatter,
    /// Slots over stored blocks of the matrix.
    pub padding_ratio: f64,
    state_traffic: TrafficCounter,
    /// Events of the steps for which recording was asked.
    pub recorder: Recorder,
}

impl Simulation {
    /// Sets a rank up on `executor`.
    pub fn new(executor: Executor, model: RankModel, exchange: &ExchangePlan) -> Result<Simulation, SetupError> {
        let RankModel { partition, plan, pins, motions, settings, pins_move, collision, arrays } = model;
        let own = plan.own.clone();
        let triangle_vertices: Vec<[u32; 3]> = arrays.triangles.iter().map(|e| e.vertices).collect();
        let hinge_vertices: Vec<[u32; 4]> = arrays.hinges.iter().map(|e| e.vertices).collect();
        let triangle_rows = ElementRows::new(own.clone(), &triangle_vertices);
        let hinge_rows = ElementRows::new(own.clone(), &hinge_vertices);
        drop((triangle_vertices, hinge_vertices));
        let (triangles, hinges) =
            (DeviceVec::upload(&executor, &arrays.triangles), DeviceVec::upload(&executor, &arrays.hinges));
        let rows_of: Vec<_> = (0..partition.ranks()).map(|r| partition.rows_of(r)).collect();
        let order: Vec<usize> = exchange.queue.iter().map(|node| node.vector).collect();
        let numbering = Numbering {
            own: own.clone(),
            columns: plan.local_rows,
            global_from_local: &plan.global_from_local,
            sub_vectors: (exchange.mode == ExchangeMode::Full)
                .then_some(SubVectors { rows_of: &rows_of, order: &order }),
        };
        let (fill_tables, matrix) =
            FillTables::new(&executor, &numbering, (&triangle_rows, &triangles), (&hinge_rows, &hinges))?;
        let rows = own.len();
        let ex = &executor;
        let collisions = collision
            .map(|model| {
                Collisions::new(host_threads(ex, partition.ranks()), partition, plan.clone(), model, settings.step_s)
            })
            .transpose()?;
        let schwarz = Schwarz::wanted(settings.preconditioner, ex, &partition, settings.relative_tolerance)
            .map_err(SetupError::Preconditioner)?
            .then(|| {
                let (offsets, block_address) = fill_tables.blocks(ex);
                let columns = fill_tables.local_columns(ex, &matrix, &numbering);
                let pattern = RankPattern { offsets: &offsets, columns: &columns, block_address: &block_address };
                Schwarz::new(ex, &partition, &plan, exchange.mode, &exchange.queue, pattern)
            });
        let simulation = Simulation {
            fabrics: DeviceVec::upload(ex, &arrays.fabrics),
            triangle_records: DeviceVec::zeros(ex, arrays.triangles.len() * TRIANGLE_RECORD_FLOATS),
            hinge_records: DeviceVec::zeros(ex, arrays.hinges.len() * HINGE_RECORD_FLOATS),
            triangles,
            hinges,
            masses: DeviceVec::upload(ex, &arrays.masses),
            pinned: DeviceVec::zeros(ex, rows),
            positions: DeviceVec::upload(ex, &arrays.positions),
            velocities: DeviceVec::upload(ex, &arrays.velocities),
            copy: StateCopy::default(),
            fill_tables,
            padding_ratio: matrix.padding_ratio(),
            matrix,
            matrix_free: None,
            contacts: ContactSystem::new(ex),
            collisions,
            rows_of,
            order,
            mode: exchange.mode,
            rhs: DeviceVec::zeros(ex, rows * 3),
            inverse_diagonal: DeviceVec::zeros(ex, rows * 6),
            rows_start: partition.rows_of(plan.rank).start,
            solver: LinearSolver::new(ex, &partition, plan, exchange.mode, &exchange.queue, schwarz),
            stretch: Stretch::new(ex),
            bend: Bend::new(ex),
            fill: Fill::new(ex),
            advance: Advance::new(ex),
            scatter: Scatter::new(ex),
            own_rows: rows,
            own_start: own.start * 3,
            pins: Pins::new(pins),
            pins_move,
            state_is_new: true,
            motions,
            settings,
            recorder: Recorder::new(executor.clock()),
            executor,
            state_traffic: TrafficCounter::default(),
        };
        match simulation.executor.take_fault() {
            Some(fault) => Err(fault.into()),
            None => Ok(simulation),
        }
    }

    /// Advances the own rows from step `step - 1` to `step` (counted from 1). `record`: keep the events of this step.
    pub fn step(&mut self, transport: &mut dyn Transport, step: u32, record: bool) -> Result<StepStats, Failure> {
        self.recorder.begin_step(step, record);
        let clock = StageClock::start();
        let step_s = self.settings.step_s;
        let span = Span { start_s: (step - 1) as f64 * step_s, end_s: step as f64 * step_s, length_s: step_s };
        let mut stats = StepStats { step, converged: true, ..StepStats::default() };
        self.solver.spmv.traffic = TrafficCounter::default();
        self.advance_over(transport, span, 0, &mut stats)?;
        self.state_is_new = false;
        if let Some(fault) = self.executor.take_fault() {
            return Err(Failure::in_step(step, fault));
        }
        stats.seconds.total = clock.total();
        stats.spmv_bytes = self.solver.spmv.traffic.received_bytes;
        stats.state_bytes += std::mem::take(&mut self.state_traffic).received_bytes;
        stats.memory_bytes = self.memory_bytes();
        stats.resident_bytes = peak_resident_bytes();
        Ok(stats)
    }

    /// Advances over `span`, in two halves if its end cannot be freed of penetrations in one.
    fn advance_over(
        &mut self,
        transport: &mut dyn Transport,
        span: Span,
        halvings: u32,
        stats: &mut StepStats,
    ) -> Result<(), Failure> {
        let before = self.collisions.is_some().then(|| (self.recorded_state(), self.pins.clone()));
        let rounds_most = if halvings < HALVINGS_FOR_SPEED { ROUNDS_MOST } else { u32::MAX };
        let imposed = match self.solve_over(transport, span, rounds_most, stats)? {
            Resolved::Free(_) => return Ok(()),
            Resolved::Slow => Vec::new(),
            Resolved::Squeezed(imposed) => imposed,
        };
        let (Some((state, pins)), true) = (before, halvings < HALVINGS_MAX) else {
            return Err(Failure::Squeezed { step: stats.step, imposed });
        };
        self.set_own_state(state);
        self.pins = pins;
        stats.zones.halvings += 1;
        for half in span.halves() {
            self.advance_over(transport, half, halvings + 1, stats)?;
        }
        Ok(())
    }

    /// One implicit step over `span` [Li et al. 2020, Fig. 2].
    fn solve_over(
        &mut self,
        transport: &mut dyn Transport,
        span: Span,
        rounds_most: u32,
        stats: &mut StepStats,
    ) -> Result<Resolved, Failure> {
        let clock = StageClock::start();

        // 1. Pins and obstacles at t1.
        let targets = self.move_pins(span);
        let prescribed = self.starts_prescribed(transport, &targets)?;

        // 2. Proximity: pairs closer than the thickness become contact elements; with them come halo rows.
        self.find_contacts(transport, span, stats)?;
        clock.restart();
        self.exchange_state(transport)?;
        clock.lap_kernels(&self.executor, &mut stats.seconds.exchange);

        // 3. Assembly elements.
        self.element_records(span);
        clock.lap_kernels(&self.executor, &mut stats.seconds.elements);
        transport.alive()?;

        // 4. Matrix, right-hand side, preconditioner of the own rows.
        self.fill_matrix(span);
        clock.lap_kernels(&self.executor, &mut stats.seconds.value_fill);
        transport.alive()?;

        // 5. (M - dt D - dt^2 K) dv = dt (f + dt K v)
        self.solver.vectors.x.fill_zero(&self.executor);
        self.scatter.apply(&self.executor, &targets.rows, &targets.velocity_changes, 0, &mut self.solver.vectors.x);
        self.solve(transport, prescribed, stats)?;
        clock.lap_kernels(&self.executor, &mut stats.seconds.solve);

        // 6. v(t1) = v(t0) + dv, x(t1) = x(t0) + dt v(t1); pins exactly.
        self.advance_state(span, &targets);
        clock.lap_kernels(&self.executor, &mut stats.seconds.advance);

        // 7. Continuous collision detection over the step and impact zones until nothing penetrates.
        self.resolve_impacts(transport, span, rounds_most, stats)
    }

    fn move_pins(&mut self, span: Span) -> PinTargets {
        let (time_s, step_s) = (span.start_s, span.length_s);
        if self.pins.changes(time_s, step_s) {
            let own = self.recorded_state();
            let held = self.pins.regrip(time_s, step_s, &own.positions, &own.velocities);
            let mut pinned = vec![0u32; self.own_rows];
            held.iter().for_each(|&row| pinned[row as usize] = 1);
            self.pinned.write_range(&self.executor, 0, &pinned);
        }
        self.pins.targets(time_s, step_s, &self.motions)
    }

    /// Whether a pin of any rank changes its velocity, so that the solve starts from prescribed values. A pin that rests
    /// does so only in the first step from a state that was set.
    fn starts_prescribed(
        &mut self,
        transport: &mut dyn Transport,
        targets: &PinTargets,
    ) -> Result<bool, TransportError> {
        if self.pins_move || !self.state_is_new {
            return Ok(self.pins_move);
        }
        let start = self.recorder.now();
        let own = targets.velocity_changes.iter().any(|change| *change != [0.0; 3]);
        let mut all = Vec::new();
        transport.all_gather(&[f64::from(u8::from(own))], &mut all)?;
        self.recorder.end(EventName::AllReduce, Activity::Wait, start, size_of::<f64>() as u64, 0);
        Ok(all.iter().flatten().any(|&of_rank| of_rank != 0.0))
    }

    /// Contacts of the state at t0: their elements, their halo rows, and the obstacle vertices they touch.
    fn find_contacts(
        &mut self,
        transport: &mut dyn Transport,
        span: Span,
        stats: &mut StepStats,
    ) -> Result<(), Failure> {
        if self.collisions.is_none() {
            return Ok(());
        }
        let own = self.recorded_state();
        let Some(collisions) = &mut self.collisions else { return Ok(()) };
        let gravity_m_s2 = self.settings.gravity_m_s2.to_array();
        let found = collisions.contacts(
            &self.executor,
            transport,
            (&own.positions, &own.velocities),
            gravity_m_s2,
            span,
            stats,
            &mut self.recorder,
        )?;
        let clock = StageClock::start();
        let start = self.recorder.now();
        let rows = found.plan.local_rows;
        let local_len = rows * 3 + found.obstacle_positions.len();
        for (local, obstacles) in
            [(&mut self.positions, &found.obstacle_positions), (&mut self.velocities, &found.obstacle_velocities)]
        {
            if local.len() < local_len {
                local.resize(&self.executor, local_len);
            }
            local.write_range(&self.executor, rows * 3, obstacles);
        }
        self.solver.vectors.grow(&self.executor, rows);
        let numbering = Numbering {
            own: found.plan.own.clone(),
            columns: rows,
            global_from_local: &found.plan.global_from_local,
            sub_vectors: (self.mode == ExchangeMode::Full)
                .then_some(SubVectors { rows_of: &self.rows_of, order: &self.order }),
        };
        let built = self.contacts.build(&self.executor, &found.elements, &numbering, &self.matrix);
        built.map_err(|error| Failure::in_step(stats.step, error))?;
        self.solver.spmv.halo().set_plan(found.plan);
        self.recorder.end(EventName::IndexFill, Activity::Compute, start, self.contacts.bytes(), 0);
        clock.lap_kernels(&self.executor, &mut stats.seconds.index_fill);
        Ok(())
    }

    /// Halo positions and velocities of the state at t0.
    fn exchange_state(&mut self, transport: &mut dyn Transport) -> Result<(), TransportError> {
        let start = self.recorder.now();
        let halo = self.solver.spmv.halo();
        halo.start(&self.executor, transport, &[&self.positions, &self.velocities], &mut self.recorder)?;
        halo.finish(
            &self.executor,
            transport,
            &mut [&mut self.positions, &mut self.velocities],
            &mut self.recorder,
            &mut self.state_traffic,
        )?;
        self.recorder.end(EventName::ExchangeState, Activity::Compute, start, 0, 0);
        Ok(())
    }

    fn element_records(&mut self, span: Span) {
        let start = self.recorder.before_kernels();
        let params = |count: usize| StepParams {
            step_s: span.length_s as f32,
            air_density: self.settings.air_density_kg_m3 as f32,
            air_drag: self.settings.air_drag_kg_m2_s as f32,
            count: count as u32,
            wind: self.settings.wind_m_s.to_array(),
            padding: 0.0,
        };
        self.stretch.apply(
            &self.executor,
            &params(self.triangles.len()),
            &self.fabrics,
            &self.triangles,
            &self.positions,
            &self.velocities,
            &mut self.triangle_records,
        );
        self.bend.apply(
            &self.executor,
            &params(self.hinges.len()),
            &self.fabrics,
            &self.hinges,
            &self.positions,
            &self.velocities,
            &mut self.hinge_records,
        );
        let stiffness_ratio = self.settings.contact_stiffness as f32;
        self.contacts.records(&self.executor, span.length_s as f32, stiffness_ratio, &self.velocities);
        let bytes =
            self.triangles.bytes() + self.hinges.bytes() + self.triangle_records.bytes() + self.hinge_records.bytes();
        self.recorder.end(
            EventName::Elements,
            Activity::Compute,
            start,
            bytes,
            self.triangles.len() as u64 * 300 + self.hinges.len() as u64 * 200,
        );
    }

    fn fill_matrix(&mut self, span: Span) {
        let start = self.recorder.before_kernels();
        let params = FillParams {
            gravity: self.settings.gravity_m_s2.to_array(),
            step_s: span.length_s as f32,
            rows: self.own_rows as u32,
        };
        self.contacts.fill(&self.executor);
        self.fill.apply(
            &self.executor,
            &params,
            &self.fill_tables,
            &self.triangles,
            &self.triangle_records,
            &self.hinge_records,
            &self.masses,
            &self.pinned,
            self.contacts.sums(),
            &mut self.matrix,
            &mut self.rhs,
            &mut self.inverse_diagonal,
        );
        let bytes = self.triangle_records.bytes()
            + self.hinge_records.bytes()
            + self.matrix.blocks as u64 * 36
            + self.fill_tables.bytes();
        self.recorder.end(EventName::ValueFill, Activity::Compute, start, bytes, self.matrix.blocks as u64 * 90);
    }

    fn solve(&mut self, transport: &mut dyn Transport, prescribed: bool, stats: &mut StepStats) -> Result<(), Failure> {
        let params = PcgParams {
            relative_tolerance: self.settings.relative_tolerance,
            max_iterations: self.settings.max_iterations,
            nonzero_start: prescribed,
        };
        let rank = &mut RankContext { executor: &self.executor, transport, recorder: &mut self.recorder };
        let solved = match &mut self.matrix_free {
            None => {
                let matrix = self.contacts.system(&self.matrix);
                let system = LinearSystem { matrix, inverse_diagonal: &self.inverse_diagonal, rhs: &self.rhs };
                self.solver.set_up(rank, &system)?;
                self.solver.solve(rank, &system, &params)
            }
            Some(kernel) => {
                let elements = element_matrix!(self);
                let (inverse, rhs) = (&self.inverse_diagonal, &self.rhs);
                let solver = &mut self.solver;
                solver.solve_with(rank, |spmv| MatrixFreeProduct { spmv, elements, kernel }, inverse, rhs, &params)
            }
        };
        let info = solved.map_err(|error| self.explain(stats.step, error))?;
        stats.iterations += info.iterations;
        stats.products += info.products;
        stats.converged &= info.converged;
        stats.residual = stats.residual.max(info.relative_residual);
        Ok(())
    }

    fn advance_state(&mut self, span: Span, targets: &PinTargets) {
        let start = self.recorder.before_kernels();
        self.copy.forget();
        self.advance.advance(
            &self.executor,
            span.length_s as f32,
            &self.solver.vectors.x,
            self.own_start,
            &mut self.velocities,
            &mut self.positions,
        );
        self.scatter.apply(&self.executor, &targets.rows, &targets.velocities, self.own_start, &mut self.velocities);
        self.scatter.apply(&self.executor, &targets.rows, &targets.positions, self.own_start, &mut self.positions);
        let rows = self.own_rows as u64;
        self.recorder.end(EventName::Advance, Activity::Compute, start, rows * 60, rows * 9);
    }

    /// Frees the state at t1 of penetrations; moved vertices get the velocity that brought them where they are.
    fn resolve_impacts(
        &mut self,
        transport: &mut dyn Transport,
        span: Span,
        rounds_most: u32,
        stats: &mut StepStats,
    ) -> Result<Resolved, Failure> {
        if self.collisions.is_none() {
            return Ok(Resolved::Free(Vec::new()));
        }
        let own = self.recorded_state();
        let Some(collisions) = &mut self.collisions else { return Ok(Resolved::Free(Vec::new())) };
        if let Some(at) = own.positions.iter().position(|x| !x.is_finite()) {
            return Err(Failure::NotFinite {
                step: stats.step,
                row: (self.rows_start + at / 3) as u32,
                quantity: "position".into(),
                cause: "after the step".into(),
                suspect: "simulation.step_s or a velocity".into(),
            });
        }
        let resolved =
            collisions.resolve(&self.executor, transport, &own.positions, rounds_most, stats, &mut self.recorder)?;
        if let Resolved::Free(moved) = &resolved
            && !moved.is_empty()
        {
            let (mut positions, mut velocities) = (own.positions.clone(), own.velocities.clone());
            for &(row, x) in moved {
                let at = row as usize * 3;
                for axis in 0..3 {
                    velocities[at + axis] += (x[axis] - positions[at + axis]) / span.length_s as f32;
                }
                positions[at..at + 3].copy_from_slice(&x);
            }
            self.set_own_state(Rc::new(RankState { positions, velocities }));
        }
        Ok(resolved)
    }
}

/// Threads for work that stays on the host: the executor's own, or a rank's share of the cores beside a device.
fn host_threads(executor: &Executor, ranks: usize) -> CpuExecutor {
    match executor {
        Executor::Cpu(cpu) => CpuExecutor::new(cpu.threads()),
        Executor::Gpu(_) => CpuExecutor::new((crate::transport::cores() / ranks).max(1)),
    }
}
