//! One time step of one rank [Li et al. 2020, Fig. 2]: the only place that sees all stages.
//!
//! Every rank of a run calls [`Simulation::step`] with the same step number; the calls inside meet over the transport.

use std::time::Instant;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::assembly::fill::{Fill, FillParams, FillTables};
use crate::assembly::{ElementRows, Pattern, SellLayout, SellMatrix};
use crate::forces::bend::Bend;
use crate::forces::stretch::Stretch;
use crate::forces::{
    FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams, TRIANGLE_RECORD_FLOATS, TriangleElement,
};
use crate::gpu::{CpuExecutor, DeviceVec, Executor};
use crate::integrator::advance::Advance;
use crate::integrator::pins::Pins;
use crate::integrator::scatter::Scatter;
use crate::interconnect::QueueNode;
use crate::model::RankModel;
use crate::scene::{Motion, PreconditionerKind, Settings};
use crate::solver::{
    ExchangeMode, HaloExchange, Pcg, PcgError, PcgParams, PcgVectors, PipelinedSpmv, RankPattern, Schwarz,
    TrafficCounter,
};
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Transport, TransportError};

/// How the ranks of a run exchange and who receives what when.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ExchangePlan {
    /// What SpMV exchanges.
    pub mode: ExchangeMode,
    /// Own work queue: one sub-vector per stage.
    pub queue: Vec<QueueNode>,
}

/// Why a rank could not be set up.
#[derive(Debug, Error)]
pub enum SetupError {
    /// A vertex with too many neighbours.
    #[error(transparent)]
    RowTooLong(#[from] crate::assembly::RowTooLong),
    /// The preconditioner that was asked for is not to be had on this executor.
    #[error("{0}")]
    Preconditioner(String),
    /// The device refused.
    #[error(transparent)]
    Device(#[from] crate::gpu::GpuError),
}

/// Why a step failed.
#[derive(Debug, Error)]
pub enum StepError {
    /// A transfer failed: another rank is gone, or the run was told to stop.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A value that is not finite; `vertex` is a global row.
    #[error("step {step}: {quantity} of vertex {vertex} is not finite ({cause}); likely too large: {suspect}")]
    NotFinite { step: u32, vertex: u32, quantity: &'static str, cause: String, suspect: &'static str },
    /// The solve failed for another reason.
    #[error("step {step}: {cause}")]
    Solve { step: u32, cause: String },
    /// The device failed.
    #[error("step {step}: {message}")]
    Device { step: u32, message: String },
}

/// Seconds a rank spent in the stages of a step (wall time of this rank; waiting for others is inside).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageSeconds {
    pub exchange: f64,
    pub elements: f64,
    pub index_fill: f64,
    pub value_fill: f64,
    pub solve: f64,
    pub advance: f64,
    pub total: f64,
}

/// What a rank reports of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepStats {
    /// Step number, from 1.
    pub step: u32,
    /// PCG iterations.
    pub iterations: u32,
    /// Relative residual reached.
    pub residual: f64,
    /// True if PCG met its tolerance.
    pub converged: bool,
    /// Matrix-vector products.
    pub products: u32,
    /// Bytes this rank received for matrix-vector products.
    pub spmv_bytes: u64,
    /// Bytes this rank received otherwise (positions and velocities).
    pub state_bytes: u64,
    /// Bytes of device memory this rank holds.
    pub memory_bytes: u64,
    /// Peak resident memory of this process, bytes; 0 where the system does not tell.
    pub resident_bytes: u64,
    /// Stage times.
    pub seconds: StageSeconds,
}

/// One rank's simulation.
pub struct Simulation {
    executor: Executor,
    settings: Settings,
    motions: Vec<Motion>,
    pins: Pins,
    pins_move: bool,
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

    fill_tables: FillTables,
    matrix: SellMatrix,
    rhs: DeviceVec<f32>,
    inverse_diagonal: DeviceVec<f32>,
    schwarz: Option<Schwarz>,
    vectors: PcgVectors,

    stretch: Stretch,
    bend: Bend,
    fill: Fill,
    spmv: PipelinedSpmv,
    pcg: Pcg,
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
        let RankModel { partition, plan, pins, motions, settings, pins_move, arrays } = model;
        let (own, rank) = (plan.own.clone(), plan.rank);
        let triangle_vertices: Vec<[u32; 3]> = arrays.triangles.iter().map(|e| e.vertices).collect();
        let hinge_vertices: Vec<[u32; 4]> = arrays.hinges.iter().map(|e| e.vertices).collect();
        let triangle_rows = ElementRows::new(own.clone(), &triangle_vertices);
        let hinge_rows = ElementRows::new(own.clone(), &hinge_vertices);
        // Without contacts the pattern is fixed, so the Index Table is filled once, on the host.
        let threads = match &executor {
            Executor::Cpu(cpu) => cpu,
            Executor::Gpu(_) => &CpuExecutor::new(1),
        };
        let pattern =
            Pattern::new(threads, own.clone(), (&triangle_rows, &triangle_vertices), (&hinge_rows, &hinge_vertices))?;
        drop((triangle_vertices, hinge_vertices));
        let layout = match exchange.mode {
            ExchangeMode::Halo => SellLayout::halo(&pattern.offsets, &pattern.columns, own.clone()),
            ExchangeMode::Full => {
                let rows_of: Vec<_> = (0..partition.ranks()).map(|r| partition.rows_of(r)).collect();
                let order: Vec<usize> = exchange.queue.iter().map(|node| node.vector).collect();
                SellLayout::full(&pattern.offsets, &pattern.columns, &plan.global_from_local, &rows_of, rank, &order)
            }
        };
        let (rows, local_len) = (own.len(), plan.local_rows * 3);
        let ex = &executor;
        let rows_of_pattern =
            RankPattern { offsets: &pattern.offsets, columns: &pattern.columns, block_address: &layout.block_address };
        let schwarz = Schwarz::wanted(settings.preconditioner, ex, &partition)
            .map_err(SetupError::Preconditioner)?
            .then(|| Schwarz::new(ex, &partition, &plan, exchange.mode, &exchange.queue, rows_of_pattern));
        let simulation = Simulation {
            fabrics: DeviceVec::upload(ex, &arrays.fabrics),
            triangle_records: DeviceVec::zeros(ex, arrays.triangles.len() * TRIANGLE_RECORD_FLOATS),
            hinge_records: DeviceVec::zeros(ex, arrays.hinges.len() * HINGE_RECORD_FLOATS),
            triangles: DeviceVec::upload(ex, &arrays.triangles),
            hinges: DeviceVec::upload(ex, &arrays.hinges),
            masses: DeviceVec::upload(ex, &arrays.masses),
            pinned: DeviceVec::zeros(ex, rows),
            positions: DeviceVec::upload(ex, &arrays.positions),
            velocities: DeviceVec::upload(ex, &arrays.velocities),
            fill_tables: FillTables::new(ex, &pattern, &layout, &triangle_rows, &hinge_rows),
            matrix: SellMatrix::new(ex, rows, &layout),
            rhs: DeviceVec::zeros(ex, rows * 3),
            inverse_diagonal: DeviceVec::zeros(ex, rows * 6),
            schwarz,
            vectors: PcgVectors::new(ex, rows, local_len),
            stretch: Stretch::new(ex),
            bend: Bend::new(ex),
            fill: Fill::new(ex),
            pcg: Pcg::new(ex, &partition, rank),
            advance: Advance::new(ex),
            scatter: Scatter::new(ex),
            padding_ratio: layout.padding_ratio(),
            rows_start: partition.rows_of(rank).start,
            own_rows: rows,
            own_start: own.start * 3,
            spmv: PipelinedSpmv::new(
                ex,
                exchange.mode,
                HaloExchange::new(plan, exchange.queue.clone()),
                exchange.queue.clone(),
                partition.sub_vector_rows(),
            ),
            pins: Pins::new(pins),
            pins_move,
            motions,
            settings,
            executor,
            state_traffic: TrafficCounter::default(),
            recorder: Recorder::new(),
        };
        match simulation.executor.take_fault() {
            Some(fault) => Err(fault.into()),
            None => Ok(simulation),
        }
    }

    /// Advances the own rows from step `step - 1` to `step` (counted from 1). `record`: keep the events of this step.
    pub fn step(&mut self, transport: &mut dyn Transport, step: u32, record: bool) -> Result<StepStats, StepError> {
        self.recorder.begin_step(step, record);
        let clock = StageClock::start();
        let mut seconds = StageSeconds::default();
        let time_s = (step - 1) as f64 * self.settings.step_s;

        // 1. Pins (and obstacles) at t1.
        let targets = self.move_pins(time_s);

        // 2. Proximity: the place of the discrete query. Its pairs become contact elements of stage 3 and change the pattern of
        //    stage 4 and the halo; without them both are fixed.
        self.exchange_state(transport)?;
        clock.lap(&mut seconds.exchange);

        // 3. Assembly elements.
        self.element_records();
        clock.lap(&mut seconds.elements);
        transport.alive()?;

        // 4. Matrix, right-hand side, preconditioner of the own rows.
        self.fill_matrix();
        clock.lap(&mut seconds.value_fill);
        transport.alive()?;

        // 5. (M - dt D - dt^2 K) dv = dt (f + dt K v)
        self.vectors.x.fill_zero(&self.executor);
        self.scatter.apply(&self.executor, &targets.rows, &targets.velocity_changes, 0, &mut self.vectors.x);
        let params = PcgParams {
            relative_tolerance: self.settings.relative_tolerance,
            max_iterations: self.settings.max_iterations,
        };
        self.spmv.traffic = TrafficCounter::default();
        if let Some(schwarz) = &mut self.schwarz {
            let (executor, halo, flags) = (&self.executor, self.spmv.halo(), &mut self.vectors.u);
            let inverse = &self.inverse_diagonal;
            schwarz.set_up(executor, transport, halo, &self.matrix, inverse, flags, &mut self.recorder)?;
        }
        let solved = self.pcg.solve(
            &self.executor,
            transport,
            &mut self.spmv,
            &self.matrix,
            &self.inverse_diagonal,
            self.schwarz.as_mut(),
            &self.rhs,
            &mut self.vectors,
            self.pins_move,
            &params,
            &mut self.recorder,
        );
        let info = solved.map_err(|error| self.explain(step, error))?;
        clock.lap(&mut seconds.solve);

        // 6. v(t1) = v(t0) + dv, x(t1) = x(t0) + dt v(t1); pins exactly.
        let start = self.recorder.now();
        self.advance.advance(
            &self.executor,
            self.settings.step_s as f32,
            &self.vectors.x,
            self.own_start,
            &mut self.velocities,
            &mut self.positions,
        );
        self.scatter.apply(&self.executor, &targets.rows, &targets.velocities, self.own_start, &mut self.velocities);
        self.scatter.apply(&self.executor, &targets.rows, &targets.positions, self.own_start, &mut self.positions);
        self.recorder.end(
            EventName::Advance,
            Activity::Compute,
            start,
            self.own_rows as u64 * 60,
            self.own_rows as u64 * 9,
        );
        clock.lap(&mut seconds.advance);

        // 7. Continuous collision detection over the step and impact zones until nothing penetrates: their place.

        if let Some(fault) = self.executor.take_fault() {
            return Err(StepError::Device { step, message: fault.to_string() });
        }
        seconds.total = clock.total();
        let state_bytes = std::mem::take(&mut self.state_traffic).received_bytes;
        Ok(StepStats {
            step,
            iterations: info.iterations,
            residual: info.relative_residual,
            converged: info.converged,
            products: info.products,
            spmv_bytes: self.spmv.traffic.received_bytes,
            state_bytes,
            memory_bytes: self.memory_bytes(),
            resident_bytes: peak_resident_bytes(),
            seconds,
        })
    }

    /// Times `repeat` products of the current matrix on a single rank: seconds of each, and the bytes that one moves.
    pub fn time_products(&mut self, repeat: u32) -> Result<(Vec<f64>, u64), TransportError> {
        let mut alone = crate::transport::SoloTransport::new(Box::new(|| false));
        let mut y = DeviceVec::zeros(&self.executor, self.own_rows * 3);
        let mut seconds = Vec::new();
        for _ in 0..=repeat {
            let start = Instant::now();
            self.spmv.apply(
                &self.executor,
                &mut alone,
                &self.matrix,
                &mut self.vectors.u,
                &mut y,
                &mut self.recorder,
            )?;
            self.executor.finish();
            seconds.push(start.elapsed().as_secs_f64());
        }
        // The first one warms up.
        seconds.remove(0);
        let bytes =
            (0..self.matrix.sections.len()).map(|section| self.matrix.section_bytes(section)).sum::<u64>() + y.bytes();
        Ok((seconds, bytes))
    }

    /// Own rows' positions and velocities, xyz in global order.
    pub fn state(&self) -> (Vec<f32>, Vec<f32>) {
        let mut state = (vec![0.0; self.own_rows * 3], vec![0.0; self.own_rows * 3]);
        self.positions.read_range(&self.executor, self.own_start, &mut state.0);
        self.velocities.read_range(&self.executor, self.own_start, &mut state.1);
        state
    }

    /// Bytes of device memory (on the cpu executor: of host memory).
    pub fn memory_bytes(&self) -> u64 {
        self.fabrics.bytes()
            + self.triangles.bytes()
            + self.hinges.bytes()
            + self.triangle_records.bytes()
            + self.hinge_records.bytes()
            + self.masses.bytes()
            + self.pinned.bytes()
            + self.positions.bytes()
            + self.velocities.bytes()
            + self.fill_tables.bytes()
            + self.matrix.bytes()
            + self.rhs.bytes()
            + self.inverse_diagonal.bytes()
            + self.vectors.bytes()
            + self.schwarz.as_ref().map_or(0, Schwarz::bytes)
    }

    /// The preconditioner in use.
    pub fn preconditioner(&self) -> PreconditionerKind {
        match self.schwarz {
            None => PreconditionerKind::Jacobi,
            Some(_) => PreconditionerKind::Schwarz,
        }
    }

    /// Executor name, for reports.
    pub fn executor_name(&self) -> String {
        self.executor.name().to_string()
    }

    fn move_pins(&mut self, time_s: f64) -> crate::integrator::pins::PinTargets {
        let step_s = self.settings.step_s;
        if self.pins.changes(time_s, step_s) {
            let (positions, velocities) = self.state();
            let held = self.pins.regrip(time_s, step_s, &positions, &velocities);
            let mut pinned = vec![0u32; self.own_rows];
            held.iter().for_each(|&row| pinned[row as usize] = 1);
            self.pinned.write_range(&self.executor, 0, &pinned);
        }
        self.pins.targets(time_s, step_s, &self.motions)
    }

    /// Halo positions and velocities of the state at t0.
    fn exchange_state(&mut self, transport: &mut dyn Transport) -> Result<(), TransportError> {
        let start = self.recorder.now();
        let halo = self.spmv.halo();
        halo.publish(&self.executor, transport, &[&self.positions, &self.velocities], &mut self.recorder)?;
        halo.receive(
            &self.executor,
            transport,
            &mut [&mut self.positions, &mut self.velocities],
            &mut self.recorder,
            &mut self.state_traffic,
        )?;
        self.recorder.end(EventName::ExchangeState, Activity::Compute, start, 0, 0);
        Ok(())
    }

    fn element_records(&mut self) {
        let start = self.recorder.now();
        let params = |count: usize| StepParams {
            step_s: self.settings.step_s as f32,
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

    fn fill_matrix(&mut self) {
        let start = self.recorder.now();
        let params = FillParams {
            gravity: self.settings.gravity_m_s2.to_array(),
            step_s: self.settings.step_s as f32,
            rows: self.own_rows as u32,
        };
        self.fill.apply(
            &self.executor,
            &params,
            &self.fill_tables,
            &self.triangles,
            &self.triangle_records,
            &self.hinge_records,
            &self.masses,
            &self.pinned,
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

    /// Finds the vertex behind a failed solve and names what usually causes it.
    fn explain(&self, step: u32, error: PcgError) -> StepError {
        let cause = match error {
            PcgError::Transport(error) => return StepError::Transport(error),
            other => other.to_string(),
        };
        if let Some(fault) = self.executor.take_fault() {
            return StepError::Device { step, message: fault.to_string() };
        }
        let (positions, velocities) = self.state();
        let rhs = self.rhs.read(&self.executor);
        let suspects = [
            ("position", &positions, "simulation.step_s or the start state"),
            ("velocity", &velocities, "simulation.step_s or air.wind"),
            ("force", &rhs, "fabric stiffness (stretching, bending) or simulation.step_s"),
        ];
        for (quantity, values, suspect) in suspects {
            if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                return StepError::NotFinite {
                    step,
                    vertex: (self.rows_start + at / 3) as u32,
                    quantity,
                    cause,
                    suspect,
                };
            }
        }
        StepError::Solve { step, cause }
    }
}

/// High-water mark of this process's resident memory.
fn peak_resident_bytes() -> u64 {
    let Ok(status) = std::fs::read_to_string("/proc/self/status") else { return 0 };
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok())
        .map_or(0, |kilobytes| kilobytes * 1024)
}

/// Splits a step's time into stages.
struct StageClock {
    start: Instant,
    last: std::cell::Cell<Instant>,
}

impl StageClock {
    fn start() -> StageClock {
        let now = Instant::now();
        StageClock { start: now, last: std::cell::Cell::new(now) }
    }

    /// Adds the time since the last lap to `stage`.
    fn lap(&self, stage: &mut f64) {
        let now = Instant::now();
        *stage += (now - self.last.replace(now)).as_secs_f64();
    }

    fn total(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }
}
