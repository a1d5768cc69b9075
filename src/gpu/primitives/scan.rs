//! Exclusive scan (prefix sum) of `u32`: from counts per row to where each row starts. Sums wrap at 2^32.
//!
//! Reduce-then-scan [Blelloch 1990]: blocks of 2048 are scanned, their totals are scanned in the same way, and each
//! block adds what came before it. Reads and writes each item twice.

use super::scan_cpu;
use crate::gpu::{DeviceVec, Executor, GpuExecutor, KernelSource, gpu_struct};

const TEXT: &str = include_str!("scan.wgsl");
static SCAN_BLOCKS: KernelSource = KernelSource::new::<ScanParams>("gpu/primitives/scan.wgsl", TEXT, "scan_blocks");
static ADD_OFFSETS: KernelSource = KernelSource::new::<ScanParams>("gpu/primitives/scan.wgsl", TEXT, "add_offsets");

/// Items that a workgroup scans: SCAN_THREADS * PER_THREAD of the shader.
const BLOCK: usize = 2048;
/// SCAN_THREADS of the shader.
const THREADS: usize = 256;

gpu_struct! {
    struct ScanParams { count_in: u32, count_out: u32, first_block: u32 }
}

/// `sums[i]` becomes the sum of `values[..i]`. `sums` may have one item more than `values`, which takes the sum of all.
pub fn exclusive_scan(executor: &Executor, values: &DeviceVec<u32>, sums: &mut DeviceVec<u32>) {
    let (count_in, count_out) = (values.len(), sums.len());
    assert!(count_out == count_in || count_out == count_in + 1, "{count_out} sums of {count_in} values");
    match executor {
        Executor::Cpu(_) => scan_cpu::exclusive_scan(values.as_slice(), sums.as_mut_slice()),
        Executor::Gpu(gpu) => scan_level(executor, gpu, values, sums),
    }
}

fn scan_level(executor: &Executor, gpu: &GpuExecutor, values: &DeviceVec<u32>, sums: &mut DeviceVec<u32>) {
    let blocks = sums.len().div_ceil(BLOCK);
    let mut totals = DeviceVec::zeros(executor, blocks);
    for (first, params) in windows(gpu, values.len(), sums.len()) {
        let (reads, writes) = (params.count_in as usize, params.count_out as usize);
        // A window without values binds the start of the array, of which the kernel then reads nothing.
        let values = values.window(if reads == 0 { 0 } else { first }, reads);
        let bindings = [values, sums.window_mut(first, writes), totals.binding_mut()];
        gpu.run(&SCAN_BLOCKS, &bindings, &params, (writes.div_ceil(BLOCK) * THREADS) as u64);
    }
    if blocks <= 1 {
        return;
    }
    let mut offsets = DeviceVec::zeros(executor, blocks);
    scan_level(executor, gpu, &totals, &mut offsets);
    for (first, params) in windows(gpu, values.len(), sums.len()) {
        let writes = params.count_out as usize;
        let bindings = [sums.window_mut(first, writes), offsets.binding()];
        gpu.run(&ADD_OFFSETS, &bindings, &params, (writes.div_ceil(BLOCK) * THREADS) as u64);
    }
}

/// Parts of the arrays that can be bound: first item, and what the kernel has to know of the part.
fn windows(gpu: &GpuExecutor, count_in: usize, count_out: usize) -> impl Iterator<Item = (usize, ScanParams)> {
    // Whole blocks; their 8 KiB are a multiple of every adapter's alignment.
    let most = (gpu.window_items(size_of::<u32>()) / BLOCK * BLOCK).max(BLOCK);
    (0..count_out).step_by(most).map(move |first| {
        let part = |count: usize| count.saturating_sub(first).min(most) as u32;
        (
            first,
            ScanParams { count_in: part(count_in), count_out: part(count_out), first_block: (first / BLOCK) as u32 },
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::device;
    use crate::test_support::seeded::Seeded;

    #[test]
    fn shader_and_wrapper_agree() {
        SCAN_BLOCKS.check().unwrap();
        assert_eq!(ADD_OFFSETS.check().unwrap().workgroup as usize, THREADS);
    }

    #[test]
    fn device_equals_the_reference_at_odd_lengths() {
        let Some(executor) = device::executor() else { return };
        let mut seeded = Seeded::new(1);
        // Around a block, around two levels, and one that needs three.
        for len in [0, 1, 2, 255, 2047, 2048, 2049, 4095, 100_003, 2048 * 2048 - 1, 2048 * 2048 + 5] {
            let values: Vec<u32> = (0..len).map(|_| seeded.below(9)).collect();
            for extra in [0, 1] {
                let mut expected = vec![0; len + extra];
                scan_cpu::exclusive_scan(&values, &mut expected);
                let device_values = DeviceVec::upload(&executor, &values);
                let mut sums = DeviceVec::zeros(&executor, len + extra);
                exclusive_scan(&executor, &device_values, &mut sums);
                let found = sums.read(&executor);
                assert_eq!(executor.take_fault(), None);
                assert!(found == expected, "length {len}, extra {extra}");
            }
        }
    }

    #[test]
    fn arrays_larger_than_a_binding_are_scanned_in_windows() {
        let Some(executor) = device::executor() else { return };
        // Two windows on adapters that bind 128 MiB.
        let len = (1 << 25) + 5;
        let values: Vec<u32> = (0..len as u32).map(|i| i % 3).collect();
        let device_values = DeviceVec::upload(&executor, &values);
        let mut sums = DeviceVec::zeros(&executor, len + 1);
        exclusive_scan(&executor, &device_values, &mut sums);
        let found = sums.read(&executor);
        assert_eq!(executor.take_fault(), None);
        // 0 + 1 + 2 per three items.
        assert!((0..=len).all(|i| found[i] == (i / 3 * 3 + usize::from(i % 3 == 2)) as u32));
    }
}
