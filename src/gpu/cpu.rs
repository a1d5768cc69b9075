//! The native executor: a fixed number of threads and loops over contiguous ranges. Results never depend on the number
//! of threads, because a range only says who computes an item, not how items are combined.

use std::ops::Range;

/// Runs CPU twins. With one thread nothing but the caller's thread is used.
pub struct CpuExecutor {
    pool: Option<rayon::ThreadPool>,
    threads: usize,
}

/// A mutable slice that several threads write at disjoint places.
struct SharedMut<T>(*mut T);
// SAFETY: only used inside `for_ranges_mut` and `for_range_pairs_mut`, which hand every thread a disjoint part.
unsafe impl<T: Send> Send for SharedMut<T> {}
unsafe impl<T: Send> Sync for SharedMut<T> {}

impl CpuExecutor {
    /// An executor with `threads` threads (at least 1).
    pub fn new(threads: usize) -> CpuExecutor {
        let threads = threads.max(1);
        let pool = (threads > 1).then(|| rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok()).flatten();
        CpuExecutor { threads: if pool.is_some() { threads } else { 1 }, pool }
    }

    /// Threads that work on a call, at least 1.
    pub fn threads(&self) -> usize {
        self.threads
    }

    /// Splits `0..items` into contiguous ranges and calls `f` on each, on all threads. Ranges start at multiples of `grain`.
    pub fn for_ranges(&self, items: usize, grain: usize, f: impl Fn(Range<usize>) + Sync) {
        let Some(pool) = self.pool.as_ref().filter(|_| items > grain) else {
            if items > 0 {
                f(0..items);
            }
            return;
        };
        // A few ranges per thread balance items of uneven cost.
        let grains = items.div_ceil(grain.max(1));
        let parts = (self.threads * 4).min(grains).max(1);
        pool.scope(|scope| {
            for part in 0..parts {
                let range = (grains * part / parts * grain)..(grains * (part + 1) / parts * grain).min(items);
                let f = &f;
                if !range.is_empty() {
                    scope.spawn(move |_| f(range));
                }
            }
        });
    }

    /// As [`CpuExecutor::for_ranges`] over `out.len() / width` items of `width` values each; every call gets its range of
    /// items and the matching part of `out`.
    pub fn for_ranges_mut<T: Send>(
        &self,
        out: &mut [T],
        width: usize,
        grain: usize,
        f: impl Fn(Range<usize>, &mut [T]) + Sync,
    ) {
        assert_eq!(out.len() % width, 0, "output is not a whole number of items");
        let items = out.len() / width;
        let base = SharedMut(out.as_mut_ptr());
        let base = &base;
        self.for_ranges(items, grain, |range| {
            // SAFETY: `for_ranges` hands out disjoint ranges within 0..items, and items * width = out.len().
            let part = unsafe { std::slice::from_raw_parts_mut(base.0.add(range.start * width), range.len() * width) };
            f(range, part);
        });
    }

    /// As [`CpuExecutor::for_ranges_mut`] over two outputs with as many items.
    pub fn for_range_pairs_mut<T: Send>(
        &self,
        [first, second]: [&mut [T]; 2],
        widths: [usize; 2],
        grain: usize,
        f: impl Fn(Range<usize>, [&mut [T]; 2]) + Sync,
    ) {
        let items = first.len() / widths[0];
        assert!(
            items * widths[0] == first.len() && items * widths[1] == second.len(),
            "outputs of as many whole items"
        );
        let bases = [SharedMut(first.as_mut_ptr()), SharedMut(second.as_mut_ptr())];
        let bases = &bases;
        self.for_ranges(items, grain, |range| {
            let part = |i: usize| {
                let (start, len) = (range.start * widths[i], range.len() * widths[i]);
                // SAFETY: `for_ranges` hands out disjoint ranges within 0..items, and both outputs have items * width.
                unsafe { std::slice::from_raw_parts_mut(bases[i].0.add(start), len) }
            };
            f(range.clone(), [part(0), part(1)]);
        });
    }
}
