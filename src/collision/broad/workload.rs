//! Workload table [Li et al. 2020, Sec. 4.4]: tests per bucket, and the even split of the *tests* over the ranks. A bucket
//! may be split; the tests of a bucket have a fixed order, so the parts fit.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};

use super::table::HashTable;

/// Buckets per stored partial sum; sums within are formed again when needed.
const CHUNK: usize = 1024;

/// Tests, busy buckets (those with tests) and their entries in a layer. Ranks exchange these.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct LayerLoad {
    /// Lower and upper half.
    tests: [u32; 2],
    busy: u32,
    entries: u32,
}

impl LayerLoad {
    /// The load of a counted layer.
    pub(super) fn new(table: &HashTable, layer: usize) -> LayerLoad {
        let (mut tests, mut busy, mut entries) = (0, 0, 0);
        for bucket in table.buckets_of(layer) {
            let load = table.load(bucket);
            let own = load.tests();
            tests += own;
            if own > 0 {
                busy += 1;
                entries += load.entries() as u32;
            }
        }
        LayerLoad::of(tests, busy, entries)
    }

    /// The load of a layer from its numbers of tests, busy buckets and entries in these.
    pub(super) fn of(tests: u64, busy: u32, entries: u32) -> LayerLoad {
        LayerLoad { tests: [tests as u32, (tests >> 32) as u32], busy, entries }
    }

    /// Tests of the layer.
    pub(super) fn tests(&self) -> u64 {
        u64::from(self.tests[0]) | u64::from(self.tests[1]) << 32
    }
}

/// The layers that hold the tests `share`; none if it is empty.
pub(super) fn layers_of(loads: &[LayerLoad], share: &Range<u64>) -> Range<usize> {
    let mut before = 0;
    let mut held = 0..0;
    for (layer, load) in loads.iter().enumerate() {
        let own = before.max(share.start)..(before + load.tests()).min(share.end);
        before += load.tests();
        if !own.is_empty() {
            held = if held.is_empty() { layer..layer + 1 } else { held.start..layer + 1 };
        }
    }
    held
}

/// Tests before each chunk of counted buckets, and in total.
#[derive(Default)]
pub(super) struct Workload {
    before: Vec<u64>,
    /// Tests of all ranks.
    pub tests: u64,
    /// Buckets with a test.
    pub busy: u64,
    /// Entries of the buckets with a test.
    pub entries: u64,
}

/// Consecutive buckets whose entries are in memory together.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct BucketBatch {
    pub buckets: Range<usize>,
    pub entries: usize,
    /// Tests of the first bucket that belong to the rank before.
    pub skip: u64,
    /// Tests of the last bucket, counted from its first, that do not belong to the rank after.
    pub stop: u64,
}

impl Workload {
    /// Totals of all layers.
    pub(super) fn add_up(&mut self, loads: &[LayerLoad]) {
        self.tests = loads.iter().map(LayerLoad::tests).sum();
        self.busy = loads.iter().map(|load| u64::from(load.busy)).sum();
        self.entries = loads.iter().map(|load| u64::from(load.entries)).sum();
    }

    /// The scan pass, over the buckets that are counted.
    pub(super) fn scan(&mut self, table: &HashTable, loads: &[LayerLoad]) {
        self.before.clear();
        let mut before = loads[..table.window().start].iter().map(LayerLoad::tests).sum();
        for start in table.buckets().step_by(CHUNK) {
            self.before.push(before);
            for bucket in start..(start + CHUNK).min(table.buckets().end) {
                before += table.load(bucket).tests();
            }
        }
    }

    /// Tests (numbered over all buckets) of a rank: sizes differ by at most one.
    pub(super) fn share(&self, rank: usize, ranks: usize) -> Range<u64> {
        let cut = |rank: usize| (u128::from(self.tests) * rank as u128 / ranks as u128) as u64;
        cut(rank)..cut(rank + 1)
    }

    /// Consecutive batches that hold the buckets of the tests `share`, each of at most `most_entries` entries (but at
    /// least one bucket) and `most_buckets` buckets.
    pub(super) fn batches(
        &self,
        table: &HashTable,
        share: &Range<u64>,
        most_entries: usize,
        most_buckets: usize,
    ) -> Vec<BucketBatch> {
        let mut batches: Vec<BucketBatch> = Vec::new();
        if share.is_empty() {
            return batches;
        }
        let chunk = self.before.partition_point(|&before| before <= share.start) - 1;
        let mut test = self.before[chunk];
        for bucket in table.buckets().start + chunk * CHUNK..table.buckets().end {
            if test >= share.end {
                break;
            }
            let load = table.load(bucket);
            let (first, entries) = (test, load.entries());
            test += load.tests();
            if first == test || test <= share.start {
                continue;
            }
            let stop = test.min(share.end) - first;
            match batches.last_mut() {
                Some(last) if last.entries + entries <= most_entries && bucket - last.buckets.start < most_buckets => {
                    last.entries += entries;
                    last.buckets.end = bucket + 1;
                    last.stop = stop;
                }
                _ => batches.push(BucketBatch {
                    buckets: bucket..bucket + 1,
                    entries,
                    skip: share.start.saturating_sub(first),
                    stop,
                }),
            }
        }
        batches
    }

    /// Bytes of the sums.
    pub(super) fn bytes(&self) -> u64 {
        size_of_val(&self.before[..]) as u64
    }
}
