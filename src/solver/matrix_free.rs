//! Matrix-vector product without a stored matrix, from element records: the alternative that [Li et al. 2020, Fig. 18] compares
//! with. Native only: it is there to be measured against the stored product, not to be used.
//!
//! Two passes. First every element turns the values at its corners into what all of them share: a triangle into the vectors
//! A, B, C of u_a A + v_a B + C, a hinge into h k sum(g_b x_b), a contact into the vector that its weights scale. Then every
//! row gathers, in ascending element order, triangles before hinges before contacts: no atomics, and the same bits on any
//! number of ranks and threads. The stored product adds in another order, so the two agree to rounding only.

use super::matrix_free_cpu::{self, ContactInputs, ElementInputs};
use crate::assembly::ElementMatrix;
use crate::assembly::element_matrix::{KEPT_CONTACT, KEPT_TRIANGLE};
use crate::gpu::{DeviceVec, Executor};

/// The product on one executor, with what its first pass keeps for the second one.
#[derive(Default)]
pub struct MatrixFree {
    triangles: Vec<f32>,
    hinges: Vec<f32>,
    contacts: Vec<f32>,
}

impl MatrixFree {
    /// y = A x for all own rows, or y += A x with `accumulate`. `x`: xyz of all local rows, the first of the own ones being
    /// `own_start` of `local_rows`; `y`: xyz per own row.
    pub fn apply(
        &mut self,
        executor: &Executor,
        matrix: &ElementMatrix<'_>,
        accumulate: bool,
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
        let (lists, x) = (matrix.lists, &x.as_slice()[..local_rows * 3]);
        self.triangles.resize(matrix.triangles.len() * KEPT_TRIANGLE, 0.0);
        self.hinges.resize(matrix.hinges.len(), 0.0);
        let elements = ElementInputs {
            triangle_offsets: lists.triangle_offsets.as_slice(),
            triangle_entries: lists.triangle_entries.as_slice(),
            hinge_offsets: lists.hinge_offsets.as_slice(),
            hinge_entries: lists.hinge_entries.as_slice(),
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
            offsets: contacts.offsets.as_slice(),
            entries: contacts.entries.as_slice(),
            records: contacts.records.as_slice(),
            elements: contacts.elements.as_slice(),
        });
        if let Some(contacts) = &contacts {
            self.contacts.resize(contacts.elements.len() * KEPT_CONTACT, 0.0);
            matrix_free_cpu::contact_terms(cpu, contacts.elements, contacts.records, x, &mut self.contacts);
        }
        let own = &x[own_start * 3..][..y.len()];
        let (terms, y) = ((&self.triangles[..], &self.hinges[..], &self.contacts[..]), y.as_mut_slice());
        matrix_free_cpu::gather(cpu, &elements, contacts.as_ref(), terms, accumulate, own, y);
    }

    /// Bytes kept between the passes.
    pub fn bytes(&self) -> u64 {
        ((self.triangles.capacity() + self.hinges.capacity() + self.contacts.capacity()) * size_of::<f32>()) as u64
    }
}
