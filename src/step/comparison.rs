//! Steps and products without a stored matrix, and products after all transfers, for benchmarks
//! [Li et al. 2020, Figs. 5, 18]. Without a stored matrix: native executor and halo rows only.

use std::ops::Range;
use std::time::Instant;

use super::elements::Elements;
use super::products::time_operator;
use super::system::{StepMatrix, System};
use super::{SetupError, Simulation};
use crate::assembly::fill::FillParams;
use crate::assembly::{ContactSystem, ElementRows, Numbering, RowLists, RowTooLong, SellMatrix};
use crate::context::RankContext;
use crate::forces::ContactElement;
use crate::gpu::{DeviceVec, Executor};
use crate::solver::comparison::{ElementMatrix, GatherFirst, MatrixFree, MatrixFreeProduct, fill_diagonal};
use crate::solver::{ExchangeMode, LinearSolver, Operator, PcgError, PcgInfo, PcgParams};
use crate::telemetry::{Activity, EventName};
use crate::transport::{Transport, TransportError};

/// The matrix of a step as the records of its elements.
struct Unassembled {
    lists: ElasticLists,
    kernel: MatrixFree,
}

/// Triangles and hinges that each own row gathers.
struct ElasticLists {
    triangles: Lists,
    hinges: Lists,
}

/// Elements of one kind that each own row gathers.
struct Lists {
    offsets: DeviceVec<u32>,
    entries: DeviceVec<u32>,
}

impl Lists {
    fn new<const CORNERS: usize>(executor: &Executor, own: Range<usize>, vertices: Vec<[u32; CORNERS]>) -> Lists {
        let rows = ElementRows::new(own, &vertices);
        let upload = |words: &[u32]| DeviceVec::upload(executor, words);
        Lists { offsets: upload(&rows.offsets), entries: upload(&rows.entries) }
    }

    fn view(&self) -> RowLists<'_> {
        RowLists { offsets: &self.offsets, entries: &self.entries }
    }

    fn bytes(&self) -> u64 {
        self.offsets.bytes() + self.entries.bytes()
    }
}

impl ElasticLists {
    /// `own`: own rows among the local ones.
    fn new(executor: &Executor, own: Range<usize>, elements: &Elements) -> ElasticLists {
        let triangles = elements.triangles.host(executor).iter().map(|e| e.vertices).collect();
        let hinges = elements.hinges.host(executor).iter().map(|e| e.vertices).collect();
        let triangles = Lists::new(executor, own.clone(), triangles);
        ElasticLists { triangles, hinges: Lists::new(executor, own, hinges) }
    }

    fn matrix<'a>(
        &'a self,
        elements: &'a Elements,
        masses: &'a DeviceVec<f32>,
        contacts: &'a ContactSystem,
    ) -> ElementMatrix<'a> {
        ElementMatrix {
            triangle_lists: self.triangles.view(),
            hinge_lists: self.hinges.view(),
            triangles: &elements.triangles,
            hinges: &elements.hinges,
            triangle_records: &elements.triangle_records,
            hinge_records: &elements.hinge_records,
            masses,
            contacts: contacts.contact_records(),
        }
    }
}

impl StepMatrix for Unassembled {
    fn take_contacts(
        &mut self,
        executor: &Executor,
        contacts: &mut ContactSystem,
        found: &[ContactElement],
        numbering: &Numbering<'_>,
    ) -> Result<(), RowTooLong> {
        contacts.take(executor, found, numbering.own.clone());
        Ok(())
    }

    fn fill(&mut self, rank: &mut RankContext<'_>, params: &FillParams, elements: &Elements, system: &mut System) {
        let start = rank.recorder.before_kernels();
        system.contacts.fill_sums(rank.executor);
        let System { contacts, masses, pinned, rhs, inverse_diagonal } = system;
        let matrix = self.lists.matrix(elements, masses, contacts);
        fill_diagonal(rank.executor, params, &matrix, pinned, contacts.sums(), rhs, inverse_diagonal);
        let bytes = elements.triangle_records.bytes() + elements.hinge_records.bytes();
        rank.recorder.end(EventName::ValueFill, Activity::Compute, start, bytes, 0);
    }

    fn solve(
        &mut self,
        rank: &mut RankContext<'_>,
        elements: &Elements,
        system: &System,
        solver: &mut LinearSolver,
        params: &PcgParams,
    ) -> Result<PcgInfo, PcgError> {
        let elements = self.lists.matrix(elements, &system.masses, &system.contacts);
        let (kernel, inverse, rhs) = (&mut self.kernel, &system.inverse_diagonal, &system.rhs);
        solver.solve_with(rank, |spmv| MatrixFreeProduct { spmv, elements, kernel }, inverse, rhs, params)
    }

    fn with_operator(
        &mut self,
        rank: &mut RankContext<'_>,
        elements: &Elements,
        system: &System,
        solver: &mut LinearSolver,
        work: &mut dyn FnMut(&mut RankContext<'_>, &mut dyn Operator, &mut DeviceVec<f32>),
    ) {
        let elements = self.lists.matrix(elements, &system.masses, &system.contacts);
        let (spmv, kernel) = (&mut solver.spmv, &mut self.kernel);
        work(rank, &mut MatrixFreeProduct { spmv, elements, kernel }, &mut solver.vectors.u);
    }

    fn product_bytes(&self, elements: &Elements, system: &System) -> u64 {
        self.lists.matrix(elements, &system.masses, &system.contacts).product_bytes()
    }

    fn bytes(&self) -> u64 {
        self.lists.triangles.bytes() + self.lists.hinges.bytes() + self.kernel.bytes()
    }

    fn stored(&self) -> Option<&SellMatrix> {
        None
    }
}

impl Simulation {
    /// Drops the stored matrix. From now on every product is computed from the element records, with block Jacobi as
    /// the preconditioner. Own rows have the same bits on any number of ranks, but not the bits of the stored product.
    ///
    /// # Errors
    /// On a device, and with whole sub-vectors, because only the cpu executor with halo rows has such a product; with
    /// soft pins, because it has no springs.
    pub fn drop_matrix(&mut self) -> Result<(), SetupError> {
        let cloth = &mut self.cloth;
        if !matches!(self.executor, Executor::Cpu(_)) || cloth.solver.spmv.mode() != ExchangeMode::Halo {
            return Err(SetupError::MatrixFree);
        }
        if cloth.springs {
            return Err(SetupError::Pins(
                "products without a stored matrix know no soft pins (pin.stiffness_n_m)".into(),
            ));
        }
        let own = cloth.solver.spmv.halo().plan().own.clone();
        let lists = ElasticLists::new(&self.executor, own, &cloth.elements);
        cloth.matrix = Box::new(Unassembled { lists, kernel: MatrixFree::default() });
        cloth.solver.keep_jacobi();
        Ok(())
    }

    /// As [`Simulation::time_products`], with products that receive all sub-vectors before they multiply
    /// [Cevahir et al. 2009]. Whole sub-vectors and a stored matrix only.
    pub fn time_gather_first(
        &mut self,
        transport: &mut dyn Transport,
        repeat: u32,
    ) -> Result<Vec<(Instant, Instant)>, TransportError> {
        let cloth = &mut self.cloth;
        let elastic = cloth.matrix.stored().expect("products that gather first multiply a stored matrix");
        let mut rank = RankContext { executor: &self.executor, transport, recorder: &mut self.recorder };
        let LinearSolver { spmv, vectors, .. } = &mut cloth.solver;
        let mut y = DeviceVec::zeros(rank.executor, cloth.rows.len() * 3);
        let mut operator = GatherFirst::new(spmv, cloth.system.contacts.system(elastic));
        time_operator(&mut rank, &mut operator, &mut vectors.u, &mut y, repeat)
    }
}
