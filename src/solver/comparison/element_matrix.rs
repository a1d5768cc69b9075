//! The matrix of a step as the records that its blocks are made of, for products that need no stored matrix. Borrowed views;
//! `matrix_free` multiplies.

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

/// What the first pass of a product keeps of a triangle: 9 floats; of a hinge: 1; of a contact: 3.
pub(super) const KEPT_TRIANGLE: usize = 9;
/// See [`KEPT_TRIANGLE`].
pub(super) const KEPT_CONTACT: usize = 3;

impl ElementMatrix<'_> {
    /// Bytes that a product moves if whatever rows share stays in cache: elements and records read twice (for what a corner
    /// makes of them, and for what a row gathers), row lists, what is kept in between written and read, result and masses.
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

    /// Operations of a product, about: 150 per triangle and 20 per corner that gathers it, 30 and 6 of a hinge, 30 and 6 of a
    /// contact.
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
