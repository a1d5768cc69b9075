//! The matrix of a step as the records that its blocks are made of, for products that need no stored matrix. Borrowed views;
//! `solver::matrix_free` multiplies.

use crate::forces::{ContactElement, HingeElement, TriangleElement};
use crate::gpu::DeviceVec;

/// Row lists of the elastic elements: contributions of own row r are `entries[offsets[r]..offsets[r + 1]]`, each
/// `element << 2 | corner`, ascending.
#[derive(Clone, Copy)]
pub struct ElementLists<'a> {
    /// Of triangles.
    pub triangle_offsets: &'a DeviceVec<u32>,
    /// Of triangles.
    pub triangle_entries: &'a DeviceVec<u32>,
    /// Of hinges.
    pub hinge_offsets: &'a DeviceVec<u32>,
    /// Of hinges.
    pub hinge_entries: &'a DeviceVec<u32>,
}

/// The contacts of a step; lists as [`ElementLists`], but of touched rows only.
#[derive(Clone, Copy)]
pub struct ContactRecords<'a> {
    /// Local vertices; those past the cloth's rows are obstacles.
    pub elements: &'a DeviceVec<ContactElement>,
    /// As `forces::contact` lays them out.
    pub records: &'a DeviceVec<f32>,
    /// Number of every own row among the touched ones, or [`super::contact_system::NO_SLOT`].
    pub slots: &'a DeviceVec<u32>,
    /// Of touched rows.
    pub offsets: &'a DeviceVec<u32>,
    /// Of touched rows.
    pub entries: &'a DeviceVec<u32>,
}

/// M - dt D - dt^2 K of a rank's rows, unassembled.
#[derive(Clone, Copy)]
pub struct ElementMatrix<'a> {
    /// Which elements a row gathers.
    pub lists: ElementLists<'a>,
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
pub const KEPT_TRIANGLE: usize = 9;
/// See [`KEPT_TRIANGLE`].
pub const KEPT_CONTACT: usize = 3;

impl ElementMatrix<'_> {
    /// Bytes that a product moves if whatever rows share stays in cache: elements and records read twice (for what a corner
    /// makes of them, and for what a row gathers), row lists, what is kept in between written and read, result and masses.
    pub fn product_bytes(&self) -> u64 {
        let lists = self.lists;
        let kept = (self.triangles.len() * KEPT_TRIANGLE + self.hinges.len()) as u64 * 4;
        let elastic = self.triangles.bytes() * 2
            + self.triangle_records.bytes()
            + self.hinges.bytes()
            + self.hinge_records.bytes() * 2
            + lists.triangle_offsets.bytes()
            + lists.triangle_entries.bytes()
            + lists.hinge_offsets.bytes()
            + lists.hinge_entries.bytes();
        let contacts = self.contacts.map_or(0, |contacts| {
            contacts.elements.bytes()
                + contacts.records.bytes() * 2
                + contacts.entries.bytes()
                + (contacts.elements.len() * KEPT_CONTACT) as u64 * 8
        });
        elastic + 2 * kept + self.masses.bytes() * 4 + contacts
    }

    /// Operations of a product, about: 150 per triangle and 20 per corner that gathers it, 30 and 6 of a hinge, 30 and 6 of a
    /// contact.
    pub fn product_flops(&self) -> u64 {
        let lists = self.lists;
        let contacts = self.contacts.map_or(0, |contacts| contacts.elements.len() * 30 + contacts.entries.len() * 6);
        (self.triangles.len() * 150
            + lists.triangle_entries.len() * 20
            + self.hinges.len() * 30
            + lists.hinge_entries.len() * 6
            + contacts) as u64
    }
}
