//! The implicit system of a step, (M - dt D - dt^2 K) dv = dt (f + dt K v) on the own rows, and its assembled matrix.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::elements::Elements;
use crate::assembly::fill::{Fill, FillParams, FillTables};
use crate::assembly::{ContactSystem, ElementRows, Numbering, RowTooLong, SellMatrix, SubVectors};
use crate::context::RankContext;
use crate::forces::ContactElement;
use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::model::RankArrays;
use crate::partition::{HaloPlan, RowPartition};
use crate::solver::{
    ExchangeMode, LinearSolver, LinearSystem, Operator, PcgError, PcgInfo, PcgParams, RankPattern, Schwarz,
    StoredMatrix,
};
use crate::telemetry::{Activity, EventName};

/// Exchange mode of a run and the own work queue.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ExchangePlan {
    /// Exchange mode of SpMV.
    pub mode: ExchangeMode,
    /// Own work queue: one sub-vector per stage.
    pub queue: Vec<QueueNode>,
}

/// Data of the own rows besides the elastic part of the matrix.
pub(super) struct System {
    /// Contacts of the step, as elements and as blocks.
    pub contacts: ContactSystem,
    /// Masses, kg.
    pub masses: DeviceVec<f32>,
    /// [`crate::integrator::pins::PRESCRIBED`] for rows that a pin prescribes, dt^2 k for those that a spring of
    /// stiffness k holds, kg, 0 for others.
    pub pinned: DeviceVec<f32>,
    /// dt (f + dt K v), xyz.
    pub rhs: DeviceVec<f32>,
    /// xx, xy, xz, yy, yz, zz of the inverse diagonal block; zeros on pinned rows.
    pub inverse_diagonal: DeviceVec<f32>,
}

impl System {
    pub(super) fn new(executor: &Executor, masses: &[f32]) -> System {
        let rows = masses.len();
        System {
            contacts: ContactSystem::new(executor),
            masses: DeviceVec::upload(executor, masses),
            pinned: DeviceVec::zeros(executor, rows),
            rhs: DeviceVec::zeros(executor, rows * 3),
            inverse_diagonal: DeviceVec::zeros(executor, rows * 6),
        }
    }

    /// Device bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.contacts.bytes()
            + self.masses.bytes()
            + self.pinned.bytes()
            + self.rhs.bytes()
            + self.inverse_diagonal.bytes()
    }
}

/// Numbering of columns, which depends on the exchange mode.
pub(super) struct ColumnOrder {
    /// Row blocks of all ranks.
    rows_of: Vec<Range<usize>>,
    /// Ranks in the order in which their sub-vectors arrive.
    order: Vec<usize>,
    mode: ExchangeMode,
}

impl ColumnOrder {
    pub(super) fn new(partition: &RowPartition, exchange: &ExchangePlan) -> ColumnOrder {
        ColumnOrder {
            rows_of: (0..partition.ranks()).map(|rank| partition.rows_of(rank)).collect(),
            order: exchange.queue.iter().map(|node| node.vector).collect(),
            mode: exchange.mode,
        }
    }

    pub(super) fn numbering<'a>(&'a self, plan: &'a HaloPlan) -> Numbering<'a> {
        Numbering {
            own: plan.own.clone(),
            columns: plan.local_rows,
            global_from_local: &plan.global_from_local,
            sub_vectors: (self.mode == ExchangeMode::Full)
                .then_some(SubVectors { rows_of: &self.rows_of, order: &self.order }),
        }
    }
}

/// Representation of the matrix of a step: assembled, or as element records (`comparison`).
pub(super) trait StepMatrix {
    /// Sets the contacts of a step; see [`ContactSystem::build`].
    fn take_contacts(
        &mut self,
        executor: &Executor,
        contacts: &mut ContactSystem,
        found: &[ContactElement],
        numbering: &Numbering<'_>,
    ) -> Result<(), RowTooLong>;

    /// Computes the matrix, right-hand side and inverse diagonal from the records.
    fn fill(&mut self, rank: &mut RankContext<'_>, params: &FillParams, elements: &Elements, system: &mut System);

    /// Solves for dv = `solver.vectors.x`.
    fn solve(
        &mut self,
        rank: &mut RankContext<'_>,
        elements: &Elements,
        system: &System,
        solver: &mut LinearSolver,
        params: &PcgParams,
    ) -> Result<PcgInfo, PcgError>;

    /// Calls `work` with the matrix and the vector that solves multiply by it.
    fn with_operator(
        &mut self,
        rank: &mut RankContext<'_>,
        elements: &Elements,
        system: &System,
        solver: &mut LinearSolver,
        work: &mut dyn FnMut(&mut RankContext<'_>, &mut dyn Operator, &mut DeviceVec<f32>),
    );

    /// Bytes that a product moves on this rank: the matrix or the records, and the result.
    fn product_bytes(&self, elements: &Elements, system: &System) -> u64;

    /// Device bytes.
    fn bytes(&self) -> u64;

    /// The stored elastic blocks; none without a stored matrix.
    fn stored(&self) -> Option<&SellMatrix>;
}

/// The elastic part of the matrix in sliced block ELL; the pattern is fixed for a run.
pub(super) struct Assembled {
    tables: FillTables,
    elastic: SellMatrix,
    fill: Fill,
}

impl Assembled {
    /// The Index Table of the elastic elements and a zero matrix.
    ///
    /// # Errors
    /// A vertex is coupled to more vertices than a row can hold.
    pub(super) fn new(
        executor: &Executor,
        arrays: &RankArrays,
        elements: &Elements,
        numbering: &Numbering<'_>,
    ) -> Result<Assembled, RowTooLong> {
        let of_triangle: Vec<[u32; 3]> = arrays.triangles.iter().map(|e| e.vertices).collect();
        let triangle_rows = ElementRows::new(numbering.own.clone(), &of_triangle);
        drop(of_triangle);
        let of_hinge: Vec<[u32; 4]> = elements.hinges.host(executor).iter().map(|e| e.vertices).collect();
        let hinge_rows = ElementRows::new(numbering.own.clone(), &of_hinge);
        drop(of_hinge);
        let (triangles, hinges) = ((&triangle_rows, &elements.triangles), (&hinge_rows, &elements.hinges));
        let (tables, elastic) = FillTables::new(executor, numbering, triangles, hinges)?;
        Ok(Assembled { tables, elastic, fill: Fill::new(executor) })
    }

    /// Slots divided by stored blocks.
    pub(super) fn padding_ratio(&self) -> f64 {
        self.elastic.padding_ratio()
    }

    pub(super) fn schwarz(
        &self,
        executor: &Executor,
        partition: &RowPartition,
        plan: &HaloPlan,
        exchange: &ExchangePlan,
        numbering: &Numbering<'_>,
    ) -> Schwarz {
        let (offsets, block_address) = self.tables.blocks(executor);
        let columns = self.tables.local_columns(executor, &self.elastic, numbering);
        let pattern = RankPattern { offsets: &offsets, columns: &columns, block_address: &block_address };
        Schwarz::new(executor, partition, plan, exchange.mode, &exchange.queue, pattern)
    }
}

impl StepMatrix for Assembled {
    fn take_contacts(
        &mut self,
        executor: &Executor,
        contacts: &mut ContactSystem,
        found: &[ContactElement],
        numbering: &Numbering<'_>,
    ) -> Result<(), RowTooLong> {
        contacts.build(executor, found, numbering, &self.elastic)
    }

    fn fill(&mut self, rank: &mut RankContext<'_>, params: &FillParams, elements: &Elements, system: &mut System) {
        let start = rank.recorder.before_kernels();
        let System { contacts, masses, pinned, rhs, inverse_diagonal } = system;
        contacts.fill(rank.executor);
        let Elements { triangles, triangle_records, hinge_records, fibers, .. } = elements;
        self.fill.apply(
            rank.executor,
            params,
            &self.tables,
            triangles,
            triangle_records,
            hinge_records,
            fibers,
            masses,
            pinned,
            contacts.sums(),
            &mut self.elastic,
            rhs,
            inverse_diagonal,
        );
        let blocks = self.elastic.blocks as u64;
        let bytes = triangle_records.bytes() + hinge_records.bytes() + blocks * 36 + self.tables.bytes();
        rank.recorder.end(EventName::ValueFill, Activity::Compute, start, bytes, blocks * 90);
    }

    fn solve(
        &mut self,
        rank: &mut RankContext<'_>,
        _: &Elements,
        system: &System,
        solver: &mut LinearSolver,
        params: &PcgParams,
    ) -> Result<PcgInfo, PcgError> {
        let System { contacts, rhs, inverse_diagonal, .. } = system;
        let system = LinearSystem { matrix: contacts.system(&self.elastic), inverse_diagonal, rhs };
        solver.set_up(rank, &system)?;
        solver.solve(rank, &system, params)
    }

    fn with_operator(
        &mut self,
        rank: &mut RankContext<'_>,
        _: &Elements,
        system: &System,
        solver: &mut LinearSolver,
        work: &mut dyn FnMut(&mut RankContext<'_>, &mut dyn Operator, &mut DeviceVec<f32>),
    ) {
        let matrix = system.contacts.system(&self.elastic);
        work(rank, &mut StoredMatrix { spmv: &mut solver.spmv, matrix }, &mut solver.vectors.u);
    }

    fn product_bytes(&self, _: &Elements, system: &System) -> u64 {
        let matrix = system.contacts.system(&self.elastic);
        let sections = 0..self.elastic.sections.len();
        sections.map(|section| matrix.section_bytes(section)).sum::<u64>() + self.elastic.rows as u64 * 12
    }

    fn bytes(&self) -> u64 {
        self.tables.bytes() + self.elastic.bytes()
    }

    fn stored(&self) -> Option<&SellMatrix> {
        Some(&self.elastic)
    }
}
