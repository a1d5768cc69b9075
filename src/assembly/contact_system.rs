//! Contacts as assembly elements of the implicit system [Li et al. 2020, Secs. 3.2.2, 4.3]: every step a new Index
//! Table of the rows that contacts touch, element records, and values. The elastic tables stay as they are: blocks off
//! the diagonal go to a second matrix, diagonal blocks and right-hand side into the elastic ones.
//!
//! Does not find contacts and knows no other rank: the caller numbers the vertices and extends the halo.
//!
//! Bytes per contact: element 64, record 48, and for each of at most four own rows entry 4, positions 8, table 16;
//! blocks of 40 bytes, up to 12 where no two contacts couple the same vertices, 4 in layered cloth. In all about 450.

use std::ops::Range;

use super::contact_fill::{self, ContactLists, ContactSums, SUMS};
use super::contact_rows::ContactRows;
use super::element_rows::RowLists;
use super::index_fill::{Elements, IndexFill, IndexRows, Kind, Numbering, RowTooLong};
use super::layout::Placement;
use super::sell::{SellMatrix, SystemMatrix};
use crate::forces::contact::{Contact, ContactStep};
use crate::forces::{CONTACT_RECORD_FLOATS, ContactElement};
use crate::gpu::{CpuExecutor, DeviceVec, Executor};

pub use super::contact_rows::NO_SLOT;

/// The contacts of a step as elements.
#[derive(Clone, Copy)]
pub struct ContactRecords<'a> {
    /// Local vertices; those past the cloth's rows are obstacles.
    pub elements: &'a DeviceVec<ContactElement>,
    /// As `forces::contact` lays them out.
    pub records: &'a DeviceVec<f32>,
    /// Number of every own row among the touched ones, or [`NO_SLOT`].
    pub slots: &'a DeviceVec<u32>,
    /// Which contacts a touched row gathers.
    pub lists: RowLists<'a>,
}

/// The contacts of one step of one rank. Memory grows with the largest step and is kept.
pub struct ContactSystem {
    rows: ContactRows,
    elements: DeviceVec<ContactElement>,
    records: DeviceVec<f32>,
    slots: DeviceVec<u32>,
    offsets: DeviceVec<u32>,
    entries: DeviceVec<u32>,
    positions: DeviceVec<[u16; 4]>,
    sums: DeviceVec<f32>,
    index: IndexFill,
    matrix: SellMatrix,
    kernel: Contact,
}

impl ContactSystem {
    /// No contacts.
    pub fn new(executor: &Executor) -> ContactSystem {
        let (floats, words) = (|| DeviceVec::zeros(executor, 0), || DeviceVec::zeros(executor, 0));
        ContactSystem {
            rows: ContactRows::default(),
            elements: DeviceVec::zeros(executor, 0),
            records: floats(),
            slots: words(),
            offsets: words(),
            entries: words(),
            positions: DeviceVec::zeros(executor, 0),
            sums: floats(),
            index: IndexFill::new(executor),
            matrix: SellMatrix::empty(executor, 0),
            kernel: Contact::new(executor),
        }
    }

    /// Takes over the contacts of a step and fills their Index Table. `elements`: in ascending order of their keys in
    /// global numbers, with local vertices (`numbering`) or `NO_VERTEX`; those that touch no own row may be among them.
    /// `elastic`: the matrix that is multiplied first.
    ///
    /// # Errors
    /// A vertex is in contact with more others than a row can hold; the error names its own row.
    pub fn build(
        &mut self,
        executor: &Executor,
        elements: &[ContactElement],
        numbering: &Numbering<'_>,
        elastic: &SellMatrix,
    ) -> Result<(), RowTooLong> {
        self.take(executor, elements, numbering.own.clone());
        if elements.is_empty() {
            return Ok(());
        }
        let count = self.rows.rows.len();
        let rows = IndexRows { own: numbering.own.clone(), columns: numbering.columns, own_column: false };
        let mut kinds = [Kind {
            elements: Elements::Contacts(&self.elements),
            host_offsets: &self.rows.offsets,
            offsets: &self.offsets,
            entries: &self.entries,
            positions: &mut self.positions,
        }];
        let touched = &self.rows.rows;
        self.index
            .fill(executor, numbering, &rows, count, &mut kinds)
            .map_err(|error| RowTooLong { local: touched[error.local] as usize, ..error })?;
        // A row whose elastic part waits for the halo must not be added to before.
        let late = |row: u32| elastic.late_rows.binary_search(&row).is_ok();
        let placement = Placement::new(&self.index.segments(numbering, count, |i| touched[i], late));
        self.matrix.rows = numbering.own.len();
        self.matrix.place(executor, &placement);
        self.index.place(executor, &rows, count, &kinds, &placement, &mut self.matrix, None);
        Ok(())
    }

    /// As [`ContactSystem::build`] without an Index Table: only the lists of what the rows `own` gather.
    pub fn take(&mut self, executor: &Executor, elements: &[ContactElement], own: Range<usize>) {
        self.elements.assign(executor, elements);
        if elements.is_empty() {
            return;
        }
        let alone = CpuExecutor::new(1);
        let threads = match executor {
            Executor::Cpu(cpu) => cpu,
            Executor::Gpu(_) => &alone,
        };
        self.rows.build(threads, own, elements);
        self.slots.assign(executor, &self.rows.slots);
        self.offsets.assign(executor, &self.rows.offsets);
        self.entries.assign(executor, &self.rows.entries);
    }

    /// Element records from the velocities of all local vertices (xyz each); those of obstacles are the velocities of
    /// the coming step. `start_velocities`: those at the start of the step.
    pub fn records(
        &mut self,
        executor: &Executor,
        step: &ContactStep,
        velocities: &DeviceVec<f32>,
        start_velocities: &DeviceVec<f32>,
    ) {
        self.records.resize(executor, self.elements.len() * CONTACT_RECORD_FLOATS);
        self.kernel.apply(executor, step, &self.elements, velocities, start_velocities, &mut self.records);
    }

    /// Values of the contact matrix, and what [`ContactSystem::sums`] hands to the elastic fill.
    pub fn fill(&mut self, executor: &Executor) {
        self.fill_sums(executor);
        if self.elements.is_empty() {
            return;
        }
        let lists = ContactLists { offsets: &self.offsets, entries: &self.entries, most: self.rows.most() };
        let (matrix, lanes) = (&mut self.matrix, self.index.lanes());
        contact_fill::apply_blocks(executor, &lists, &self.positions, &self.records, lanes, matrix);
    }

    /// What [`ContactSystem::sums`] hands to the elastic fill, without values of a matrix.
    pub fn fill_sums(&mut self, executor: &Executor) {
        if self.elements.is_empty() {
            return;
        }
        self.sums.resize(executor, self.rows.rows.len() * SUMS);
        let lists = ContactLists { offsets: &self.offsets, entries: &self.entries, most: self.rows.most() };
        contact_fill::apply_sums(executor, &lists, &self.records, &mut self.sums);
    }

    /// What contacts add to the elastic system; None without contacts.
    pub fn sums(&self) -> Option<ContactSums<'_>> {
        (!self.elements.is_empty()).then_some(ContactSums { slots: &self.slots, sums: &self.sums })
    }

    /// Blocks off the diagonal; None without contacts.
    pub fn matrix(&self) -> Option<&SellMatrix> {
        (!self.elements.is_empty()).then_some(&self.matrix)
    }

    /// The matrix of the step.
    pub fn system<'a>(&'a self, elastic: &'a SellMatrix) -> SystemMatrix<'a> {
        SystemMatrix { elastic, contact: self.matrix() }
    }

    /// The elements and what rows gather from them; None without contacts.
    pub fn contact_records(&self) -> Option<ContactRecords<'_>> {
        (!self.elements.is_empty()).then_some(ContactRecords {
            elements: &self.elements,
            records: &self.records,
            slots: &self.slots,
            lists: RowLists { offsets: &self.offsets, entries: &self.entries },
        })
    }

    /// Contacts of this step.
    pub fn contacts(&self) -> usize {
        self.elements.len()
    }

    /// Own rows that contacts of this step touch, ascending.
    pub fn touched_rows(&self) -> &[u32] {
        if self.elements.is_empty() { &[] } else { &self.rows.rows }
    }

    /// Bytes held, on the device and on the host.
    pub fn bytes(&self) -> u64 {
        self.rows.bytes()
            + self.elements.held_bytes()
            + self.records.held_bytes()
            + self.slots.held_bytes()
            + self.offsets.held_bytes()
            + self.entries.held_bytes()
            + self.positions.held_bytes()
            + self.sums.held_bytes()
            + self.index.bytes()
            + self.matrix.bytes()
    }
}
