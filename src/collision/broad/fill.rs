//! Triangle hash table, second half: the entries of one batch of buckets (scan and fill passes). Only what the batch
//! needs is in memory.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use bytemuck::Zeroable;

use super::grid::Entry;
use super::input::Input;
use super::patches::Patches;
use super::table::{HashTable, Load, bump};
use super::workload::BucketBatch;
use crate::gpu::CpuExecutor;

/// Cursor of a bucket without tests.
const NONE: u32 = u32::MAX;

/// The entries being written; a cursor hands every slot out once.
struct Slots(*mut Entry, usize);
// SAFETY: shared only within `BucketEntries::fill`, where no two threads touch the same slot.
unsafe impl Sync for Slots {}

/// Entries of a batch, bucket by bucket: residents (cloth, obstacles), then visitors (cloth, obstacles).
#[derive(Default)]
pub(super) struct BucketEntries {
    entries: Vec<Entry>,
    /// Per bucket of the batch: the next free slot of a resident; after the pass the end of the residents.
    resident: Vec<AtomicU32>,
    /// The same for visitors, for the buckets of coarser grids.
    visiting: Vec<AtomicU32>,
    first: usize,
    first_visited: usize,
}

impl BucketEntries {
    /// Scans the counts of the batch and writes its entries.
    pub(super) fn fill(
        &mut self,
        cpu: &CpuExecutor,
        input: &Input,
        patches: &Patches,
        table: &HashTable,
        batch: &BucketBatch,
    ) {
        self.scan(table, batch);
        let shared = cpu.threads() > 1;
        let slots = Slots(self.entries.as_mut_ptr(), self.entries.len());
        let slots = &slots;
        let (resident, visiting) = (&self.resident, &self.visiting);
        let (first, first_visited) = (self.first, self.first_visited);
        let write = |cursors: &[AtomicU32], at: usize, entry: Entry| {
            let Some(cursor) = cursors.get(at).filter(|cursor| cursor.load(Relaxed) != NONE) else { return };
            let slot = bump(cursor, shared) as usize;
            assert!(slot < slots.1, "entries were counted by the same code");
            // SAFETY: within the vector, and this slot is handed out only here and now.
            unsafe { slots.0.add(slot).write(entry) };
        };
        let (fine, coarse) = table.reach(&batch.buckets);
        table.for_each_patch(cpu, patches, &fine, coarse, |triangles| {
            for triangle in triangles {
                let Some(aabb) = input.aabb(triangle) else { continue };
                let wanted = input.tag(triangle);
                let put = |cursors: &[AtomicU32], first: usize, bucket: u32, tag: u32| {
                    let at = (bucket as usize).wrapping_sub(first);
                    write(cursors, at, Entry::new(&aabb, tag | wanted, triangle as u32));
                };
                table.for_each_bucket(
                    input,
                    triangle,
                    &aabb,
                    (&fine, coarse),
                    |bucket, tag| put(resident, first, bucket, tag),
                    |bucket, tag| put(visiting, first_visited, bucket, tag),
                );
            }
        });
        if shared {
            self.order(cpu, table, batch);
        }
    }

    /// Sorts the entries of every bucket into the order in which one thread writes them, so that the tests of a bucket
    /// have the same numbers on every rank.
    fn order(&mut self, cpu: &CpuExecutor, table: &HashTable, batch: &BucketBatch) {
        let slots = Slots(self.entries.as_mut_ptr(), self.entries.len());
        let slots = &slots;
        let this = (&self.resident, self.first);
        cpu.for_ranges(batch.buckets.len(), 256, |range| {
            for bucket in range.start + this.1..range.end + this.1 {
                let load = table.load(bucket);
                if load.tests() == 0 {
                    continue;
                }
                let end = this.0[bucket - this.1].load(Relaxed) as usize;
                let (start, all) = (end - load.residents(), load.entries());
                assert!(start + all <= slots.1, "entries were counted by the same code");
                // SAFETY: within the vector; the slots of a bucket belong to no other bucket, a bucket to one thread.
                let own = unsafe { std::slice::from_raw_parts_mut(slots.0.add(start), all) };
                let (residents, visitors) = own.split_at_mut(load.residents());
                residents.sort_unstable_by_key(|entry| entry.triangle);
                visitors.sort_unstable_by_key(|entry| entry.triangle);
            }
        });
    }

    fn scan(&mut self, table: &HashTable, batch: &BucketBatch) {
        self.resident.clear();
        self.visiting.clear();
        self.resident.reserve_exact(batch.buckets.len());
        self.first = batch.buckets.start;
        self.first_visited = batch.buckets.end;
        let mut slot = 0;
        for bucket in batch.buckets.clone() {
            let load = table.load(bucket);
            let busy = load.tests() > 0;
            self.resident.push(AtomicU32::new(if busy { slot } else { NONE }));
            if table.is_coarse(bucket) {
                self.first_visited = self.first_visited.min(bucket);
                self.visiting.push(AtomicU32::new(if busy { slot + load.residents() as u32 } else { NONE }));
            }
            if busy {
                slot += load.entries() as u32;
            }
        }
        // Old contents may stay because every slot is written.
        self.entries.truncate(slot as usize);
        if self.entries.capacity() < slot as usize {
            self.entries = Vec::new();
            self.entries.reserve_exact(slot as usize);
        }
        self.entries.resize(slot as usize, Entry::zeroed());
    }

    /// Entries of a bucket of the batch that has tests.
    pub(super) fn of_bucket(&self, bucket: usize, load: &Load) -> &[Entry] {
        let end = self.resident[bucket - self.first].load(Relaxed) as usize;
        let start = end - load.residents();
        &self.entries[start..start + load.entries()]
    }

    /// Bytes of entries and cursors, unused capacity included.
    pub(super) fn bytes(&self) -> u64 {
        (self.entries.capacity() * size_of::<Entry>() + 4 * (self.resident.capacity() + self.visiting.capacity()))
            as u64
    }

    /// A number of bytes within which [`BucketEntries::fit`] allows `entries` entries.
    pub(super) fn bytes_for(entries: usize) -> u64 {
        (entries * size_of::<Entry>()) as u64 * 4 / 3 + 64
    }

    /// Largest number of (entries, buckets) that fit `bytes`: a quarter is for the cursors.
    pub(super) fn fit(bytes: u64) -> (usize, usize) {
        let buckets = bytes / 4 / (2 * size_of::<AtomicU32>() as u64);
        let entries = bytes * 3 / 4 / size_of::<Entry>() as u64;
        // Slots are numbered with 32 bits, of which one value is taken.
        (entries.min(u64::from(NONE) - 1) as usize, buckets.min(u64::from(NONE)) as usize)
    }
}

/// Rows of tests of a bucket: `row` against the entries `partners`.
pub(super) fn rows(load: &Load) -> impl Iterator<Item = (usize, Range<usize>)> {
    let (cloth, residents, all) = (load.resident_cloth as usize, load.residents(), load.entries());
    let visiting = residents..residents + load.visiting_cloth as usize;
    (0..residents).map(move |row| (row, if row < cloth { row + 1..all } else { visiting.clone() }))
}
