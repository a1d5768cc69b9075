//! Workload table [Li et al. 2020, Sec. 4.4]: tests per bucket, and the even split of the *tests* over the ranks. A bucket
//! may be split; the tests of a bucket have a fixed order, so the parts fit.

use std::ops::Range;

use super::table::Table;

/// Buckets per stored partial sum; sums within are formed again when needed.
const CHUNK: usize = 1024;

/// Tests before each chunk of buckets, and in total.
#[derive(Default)]
pub(super) struct Workload {
    before: Vec<u64>,
    /// Tests of all ranks.
    pub tests: u64,
    /// Buckets with a test.
    pub busy: u64,
}

/// Consecutive buckets whose entries are in memory together.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Batch {
    pub buckets: Range<usize>,
    pub entries: usize,
    /// Tests of the first bucket that belong to the rank before.
    pub skip: u64,
    /// Tests of the last bucket, counted from its first, that do not belong to the rank after.
    pub stop: u64,
}

impl Workload {
    /// The scan pass.
    pub fn scan(&mut self, table: &Table) {
        self.before.clear();
        (self.tests, self.busy) = (0, 0);
        for start in (0..table.buckets()).step_by(CHUNK) {
            self.before.push(self.tests);
            for bucket in start..(start + CHUNK).min(table.buckets()) {
                let tests = table.load(bucket).tests();
                self.tests += tests;
                self.busy += u64::from(tests > 0);
            }
        }
    }

    /// Tests (numbered over all buckets) of a rank: sizes differ by at most one.
    pub fn share(&self, rank: usize, ranks: usize) -> Range<u64> {
        let cut = |rank: usize| (u128::from(self.tests) * rank as u128 / ranks as u128) as u64;
        cut(rank)..cut(rank + 1)
    }

    /// Consecutive batches that hold the buckets of the tests `share`, each of at most `most_entries` entries (but at
    /// least one bucket) and `most_buckets` buckets.
    pub fn batches(&self, table: &Table, share: &Range<u64>, most_entries: usize, most_buckets: usize) -> Vec<Batch> {
        let mut batches: Vec<Batch> = Vec::new();
        if share.is_empty() {
            return batches;
        }
        let chunk = self.before.partition_point(|&before| before <= share.start) - 1;
        let mut test = self.before[chunk];
        for bucket in chunk * CHUNK..table.buckets() {
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
                _ => batches.push(Batch {
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
    pub fn bytes(&self) -> u64 {
        size_of_val(&self.before[..]) as u64
    }
}
