//! The matrix of a step as borrowed element records, for products without a stored matrix (`matrix_free`).

use crate::assembly::{ContactRecords, RowLists};
use crate::forces::{HingeElement, TriangleElement};
use crate::gpu::DeviceVec;

/// M - dt D - dt^2 K of a rank's rows, unassembled.
#[derive(Clone, Copy)]
pub struct ElementMatrix<'a> {
    /// Which triangles an own row gathers.
    pub triangle_lists: RowLists<'a>,
    /// Which hinges an own row gathers.
    pub hinge_lists: RowLists<'a>,
    /// Stretch elements, local vertices.
    pub triangles: &'a DeviceVec<TriangleElement>,
    /// Bending elements, local vertices.
    pub hinges: &'a DeviceVec<HingeElement>,
    /// As `forces::stretch` lays them out.
    pub triangle_records: &'a DeviceVec<f32>,
    /// As `forces::bend` lays them out.
    pub hinge_records: &'a DeviceVec<f32>,
    /// Own rows, kg.
    pub masses: &'a DeviceVec<f32>,
    /// None without contacts.
    pub contacts: Option<ContactRecords<'a>>,
}

/// Floats that the first pass of a product stores per triangle (9), per hinge (1) and per contact (3).
pub(super) const KEPT_TRIANGLE: usize = 9;
/// See [`KEPT_TRIANGLE`].
pub(super) const KEPT_CONTACT: usize = 3;

impl ElementMatrix<'_> {
    /// Bytes that a product moves if data that rows share stays in cache. Elements and records are read twice: once for
    /// the terms of the corners, once for the gather of a row. Row lists, stored terms (written and read), the result
    /// and masses are added.
    pub fn product_bytes(&self) -> u64 {
        let kept = (self.triangles.len() * KEPT_TRIANGLE + self.hinges.len()) as u64 * 4;
        let elastic = self.triangles.bytes() * 2
            + self.triangle_records.bytes()
            + self.hinges.bytes()
            + self.hinge_records.bytes() * 2
            + self.triangle_lists.offsets.bytes()
            + self.triangle_lists.entries.bytes()
            + self.hinge_lists.offsets.bytes()
            + self.hinge_lists.entries.bytes();
        let contacts = self.contacts.map_or(0, |contacts| {
            contacts.elements.bytes()
                + contacts.records.bytes() * 2
                + contacts.lists.entries.bytes()
                + (contacts.elements.len() * KEPT_CONTACT) as u64 * 8
        });
        elastic + 2 * kept + self.masses.bytes() * 4 + contacts
    }

    /// Approximate operations of a product: per triangle 150 and 20 for each corner that a row gathers; per hinge and
    /// per contact 30 and 6.
    pub fn product_flops(&self) -> u64 {
        let contacts =
            self.contacts.map_or(0, |contacts| contacts.elements.len() * 30 + contacts.lists.entries.len() * 6);
        (self.triangles.len() * 150
            + self.triangle_lists.entries.len() * 20
            + self.hinges.len() * 30
            + self.hinge_lists.entries.len() * 6
            + contacts) as u64
    }
}
