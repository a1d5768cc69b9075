//! Which own rows the contacts of a step touch, and which contacts a row gathers: lists as [`super::ElementRows`], but only of
//! touched rows, which are numbered in ascending order. Built on the host, where the contacts come from.

use std::ops::Range;

use crate::forces::ContactElement;
use crate::gpu::CpuExecutor;

/// Slot of a row that no contact touches.
pub const NO_SLOT: u32 = u32::MAX;

/// Contributions of contacts to a rank's own rows.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct ContactRows {
    /// Number of every own row among the touched ones, or [`NO_SLOT`].
    pub slots: Vec<u32>,
    /// Touched own rows, ascending.
    pub rows: Vec<u32>,
    /// Start of each touched row's list in `entries`; one more than touched rows.
    pub offsets: Vec<u32>,
    /// Contact and the row's corner in it, packed as `contact << 2 | corner`; ascending in a row.
    pub entries: Vec<u32>,
    /// Per own row: how many entries it has, then where its next one goes.
    next: Vec<u32>,
}

impl ContactRows {
    /// Lists of the rows `own` (local vertices). Two passes over the contacts, in which every thread serves its own rows:
    /// about 130 bytes read per contact, thread and pass.
    pub(super) fn build(&mut self, cpu: &CpuExecutor, own: Range<usize>, contacts: &[ContactElement]) {
        assert!(contacts.len() < super::ElementRows::ELEMENTS_MAX, "too many contacts on one rank");
        self.next.clear();
        self.next.resize(own.len(), 0);
        self.slots.clear();
        self.slots.resize(own.len(), NO_SLOT);
        self.rows.clear();
        self.offsets.clear();
        self.offsets.push(0);
        if contacts.is_empty() {
            self.entries.clear();
            return;
        }
        let share = own.len().div_ceil(cpu.threads());
        cpu.for_ranges_mut(&mut self.next, 1, share, |range, counts| {
            let first = own.start + range.start;
            for v in contacts.iter().flat_map(|contact| contact.vertices) {
                if let Some(count) = counts.get_mut((v as usize).wrapping_sub(first)) {
                    *count += 1;
                }
            }
        });
        let mut entries = 0u32;
        for (row, (count, slot)) in self.next.iter_mut().zip(&mut self.slots).enumerate() {
            let touching = *count;
            *count = entries;
            if touching > 0 {
                *slot = self.rows.len() as u32;
                entries = entries.checked_add(touching).expect("a contact has at most four entries, see above");
                self.rows.push(row as u32);
                self.offsets.push(entries);
            }
        }
        // Old items are all overwritten.
        self.entries.resize(entries as usize, 0);
        let entries = Entries(self.entries.as_mut_ptr(), self.entries.len());
        let entries = &entries;
        cpu.for_ranges_mut(&mut self.next, 1, share, |range, next| {
            let first = own.start + range.start;
            for (number, contact) in contacts.iter().enumerate() {
                for (corner, v) in contact.vertices.into_iter().enumerate() {
                    if let Some(next) = next.get_mut((v as usize).wrapping_sub(first)) {
                        // SAFETY: lists of different rows are disjoint, and a row belongs to one thread.
                        unsafe { entries.set(*next as usize, (number as u32) << 2 | corner as u32) };
                        *next += 1;
                    }
                }
            }
        });
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        let words = [&self.slots, &self.rows, &self.offsets, &self.entries, &self.next].map(Vec::capacity);
        words.into_iter().sum::<usize>() as u64 * 4
    }

    /// Contributions of the row that has most.
    pub(super) fn most(&self) -> usize {
        self.offsets.windows(2).map(|pair| (pair[1] - pair[0]) as usize).max().unwrap_or(0)
    }
}

/// The entries, which several threads write at disjoint places.
struct Entries(*mut u32, usize);
// SAFETY: see `build`.
unsafe impl Sync for Entries {}

impl Entries {
    /// # Safety
    /// `at` is in the list of a row of the calling thread.
    unsafe fn set(&self, at: usize, entry: u32) {
        debug_assert!(at < self.1);
        // SAFETY: the lists were counted by the same code.
        unsafe { self.0.add(at).write(entry) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::forces::NO_VERTEX;
    use bytemuck::Zeroable;

    #[test]
    fn only_touched_own_rows_are_listed_in_ascending_order() {
        let contact = |vertices| ContactElement { vertices, ..Zeroable::zeroed() };
        // Own rows are local 2..7; 9 is an obstacle vertex.
        let contacts = [
            contact([3, 9, NO_VERTEX, NO_VERTEX]),
            contact([5, 1, 3, 2]),
            contact([0, 1, 7, 8]),
            contact([6, 5, 3, 1]),
        ];
        let mut rows = ContactRows::default();
        rows.build(&CpuExecutor::new(1), 2..7, &contacts);
        assert_eq!(rows.rows, [0, 1, 3, 4]);
        assert_eq!(rows.slots, [0, 1, NO_SLOT, 2, 3]);
        assert_eq!(rows.offsets, [0, 1, 4, 6, 7]);
        assert_eq!(rows.entries, [4 | 3, 0, 4 | 2, 12 | 2, 4, 12 | 1, 12]);
        assert_eq!(rows.most(), 3);
        // Threads and what was there before change nothing.
        let mut again = ContactRows::default();
        again.build(&CpuExecutor::new(3), 0..9, &contacts);
        again.build(&CpuExecutor::new(3), 2..7, &contacts);
        assert_eq!(rows, again);
        again.build(&CpuExecutor::new(3), 2..7, &[]);
        assert!(again.rows.is_empty() && again.entries.is_empty() && again.slots == [NO_SLOT; 5]);
    }
}
