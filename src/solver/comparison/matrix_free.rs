//! Matrix-vector product from element records, without a stored matrix: the alternative in [Li et al. 2020, Fig. 18].
//! Native only, because it serves measurements and no run uses it.
//!
//! Two passes. The first pass turns the values at the corners of every element into terms that its corners share: a
//! triangle into the vectors A, B, C of u_a A + v_a B + C, a hinge into h k sum(g_b x_b), a contact into the vector
//! that its weights scale. In the second pass every row gathers in ascending element order, triangles before hinges
//! before contacts. So the product needs no atomics and gives the same bits on any number of ranks and threads. The
//! stored product adds in another order, so the two agree only up to rounding.

use super::element_matrix::{ElementMatrix, KEPT_CONTACT, KEPT_TRIANGLE};
use super::matrix_free_cpu::{self, ContactInputs, ElementInputs};
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor};
use crate::solver::operator::Operator;
use crate::solver::pipelined::PipelinedSpmv;
use crate::telemetry::{Activity, EventName};
use crate::transport::TransportError;

/// The product on one executor, with the terms that its first pass stores for the second one.
#[derive(Default)]
pub struct MatrixFree {
    triangles: Vec<f32>,
    hinges: Vec<f32>,
    contacts: Vec<f32>,
}

impl MatrixFree {
    /// y = A x for all own rows. `x`: xyz of all local rows, the first of the own ones being `own_start` of
    /// `local_rows`; `y`: xyz per own row.
    pub fn apply(
        &mut self,
        executor: &Executor,
        matrix: &ElementMatrix<'_>,
        own_start: usize,
        local_rows: usize,
        x: &DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) {
        let cpu = match executor {
            Executor::Cpu(cpu) => cpu,
            Executor::Gpu(gpu) => {
                gpu.stop("products without a stored matrix need the cpu executor".to_string());
                return;
            }
        };
        assert!(x.len() >= local_rows * 3 && y.len() == matrix.masses.len() * 3);
        let x = &x.as_slice()[..local_rows * 3];
        self.triangles.resize(matrix.triangles.len() * KEPT_TRIANGLE, 0.0);
        self.hinges.resize(matrix.hinges.len(), 0.0);
        let elements = ElementInputs {
            triangle_offsets: matrix.triangle_lists.offsets.as_slice(),
            triangle_entries: matrix.triangle_lists.entries.as_slice(),
            hinge_offsets: matrix.hinge_lists.offsets.as_slice(),
            hinge_entries: matrix.hinge_lists.entries.as_slice(),
            triangles: matrix.triangles.as_slice(),
            hinges: matrix.hinges.as_slice(),
            triangle_records: matrix.triangle_records.as_slice(),
            hinge_records: matrix.hinge_records.as_slice(),
            masses: matrix.masses.as_slice(),
        };
        matrix_free_cpu::triangle_terms(cpu, elements.triangles, elements.triangle_records, x, &mut self.triangles);
        matrix_free_cpu::hinge_terms(cpu, elements.hinges, elements.hinge_records, x, &mut self.hinges);
        let contacts = matrix.contacts.map(|contacts| ContactInputs {
            slots: contacts.slots.as_slice(),
            offsets: contacts.lists.offsets.as_slice(),
            entries: contacts.lists.entries.as_slice(),
            records: contacts.records.as_slice(),
            elements: contacts.elements.as_slice(),
        });
        if let Some(contacts) = &contacts {
            self.contacts.resize(contacts.elements.len() * KEPT_CONTACT, 0.0);
            matrix_free_cpu::contact_terms(cpu, contacts.elements, contacts.records, x, &mut self.contacts);
        }
        let own = &x[own_start * 3..][..y.len()];
        let (terms, y) = ((&self.triangles[..], &self.hinges[..], &self.contacts[..]), y.as_mut_slice());
        matrix_free_cpu::gather(cpu, &elements, contacts.as_ref(), terms, own, y);
    }

    /// Bytes of the terms that the first pass stores.
    pub fn bytes(&self) -> u64 {
        ((self.triangles.capacity() + self.hinges.capacity() + self.contacts.capacity()) * size_of::<f32>()) as u64
    }
}

/// The matrix of a step that is not stored.
pub struct MatrixFreeProduct<'a> {
    /// Receives the halo rows and counts their bytes.
    pub spmv: &'a mut PipelinedSpmv,
    /// Element records of the matrix.
    pub elements: ElementMatrix<'a>,
    /// Multiplies it.
    pub kernel: &'a mut MatrixFree,
}

impl Operator for MatrixFreeProduct<'_> {
    /// All elements need all halo rows, so transfers overlap no product.
    fn apply(
        &mut self,
        rank: &mut RankContext<'_>,
        u: &mut DeviceVec<f32>,
        w: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        let (own, local_rows) = self.spmv.exchange_halo(rank, u)?;
        let start = rank.recorder.now();
        self.kernel.apply(rank.executor, &self.elements, own.start, local_rows, u, w);
        let (bytes, flops) = (self.elements.product_bytes(), self.elements.product_flops());
        rank.recorder.end(EventName::SpmvRemote, Activity::Compute, start, bytes, flops);
        Ok(())
    }
}
