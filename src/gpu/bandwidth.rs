//! Measures the memory bandwidth of an executor, to compare memory-bound kernels with. The result holds for this
//! machine at this moment; other processes lower it.

use std::hint::black_box;
use std::time::Instant;

use super::kernel::KernelSource;
use super::layout::gpu_struct;
use super::{CpuExecutor, DeviceVec, Executor, GpuError, GpuExecutor};

static COPY: KernelSource =
    KernelSource::new::<BandwidthParams>("gpu/bandwidth.wgsl", include_str!("bandwidth.wgsl"), "copy_words");
static READ: KernelSource =
    KernelSource::new::<BandwidthParams>("gpu/bandwidth.wgsl", include_str!("bandwidth.wgsl"), "read_words");

/// Times that each measurement is taken; the median counts.
const REPEATS: usize = 7;
/// Items that an invocation of the reading kernel reads.
const READ_TURNS: u32 = 32;

gpu_struct! {
    struct BandwidthParams { count: u32, threads: u32, turns: u32 }
}

/// Bandwidth in GB/s (1e9 bytes per second).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bandwidth {
    /// Copying one array to another; bytes read and bytes written both count.
    pub copy_gb_s: f64,
    /// Reading one array and writing nothing.
    pub read_gb_s: f64,
}

/// Measures the bandwidth with arrays of `bytes` bytes (less where the adapter cannot bind as much at once). Take arrays
/// many times larger than the last cache.
pub fn bandwidth_gb_s(executor: &Executor, bytes: usize) -> Result<Bandwidth, GpuError> {
    match executor {
        Executor::Cpu(cpu) => Ok(on_cpu(cpu, (bytes / 8).max(1))),
        Executor::Gpu(gpu) => {
            let most = gpu.window_items(16);
            on_gpu(executor, gpu, (bytes / 16).clamp(1, most))
        }
    }
}

/// `REPEATS` timings of `work` after one that warms up, as GB/s of the median for `bytes` bytes.
fn median_gb_s(bytes: f64, mut work: impl FnMut()) -> f64 {
    work();
    let mut seconds: Vec<f64> = (0..REPEATS)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64()
        })
        .collect();
    seconds.sort_by(f64::total_cmp);
    bytes / seconds[REPEATS / 2].max(1e-9) * 1e-9
}

fn on_cpu(cpu: &CpuExecutor, words: usize) -> Bandwidth {
    let mut from = vec![0u64; words];
    let mut to = vec![0u64; words];
    // First touched by the threads that use it, and not all zero pages.
    cpu.for_ranges_mut(&mut from, 1, 4096, |range, part| {
        part.iter_mut().zip(range).for_each(|(word, i)| *word = i as u64)
    });
    let bytes = (words * 8) as f64;
    let copy_gb_s = median_gb_s(2.0 * bytes, || {
        cpu.for_ranges_mut(&mut to, 1, 4096, |range, part| part.copy_from_slice(&from[range]));
        black_box(&mut to);
    });
    let read_gb_s = median_gb_s(bytes, || {
        cpu.for_ranges(words, 4096, |range| {
            black_box(from[range].iter().fold(0, |sum: u64, word| sum ^ word));
        });
    });
    Bandwidth { copy_gb_s, read_gb_s }
}

fn on_gpu(executor: &Executor, gpu: &GpuExecutor, items: usize) -> Result<Bandwidth, GpuError> {
    let from = DeviceVec::<[u32; 4]>::zeros(executor, items);
    let mut to = DeviceVec::<[u32; 4]>::zeros(executor, items);
    let count = items as u32;
    let threads = count.div_ceil(READ_TURNS);
    let params = BandwidthParams { count, threads, turns: READ_TURNS };
    let mut time = |source: &'static KernelSource, bytes: f64, invocations: u32| {
        let mut run = |dispatches: u32| {
            for _ in 0..dispatches {
                gpu.run(source, &[from.binding(), to.binding_mut()], &params, u64::from(invocations));
            }
            gpu.finish();
        };
        // Enough dispatches per timing that submitting and waiting do not count. The first one compiles the kernel.
        run(1);
        let start = Instant::now();
        run(1);
        let dispatches = (10e-3 / start.elapsed().as_secs_f64().max(1e-9)).clamp(1.0, 64.0) as u32;
        median_gb_s(f64::from(dispatches) * bytes, || run(dispatches))
    };
    let bytes = (items * 16) as f64;
    let copy_gb_s = time(&COPY, 2.0 * bytes, count);
    let read_gb_s = time(&READ, bytes, threads);
    match gpu.fault() {
        Some(fault) => Err(fault),
        None => Ok(Bandwidth { copy_gb_s, read_gb_s }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_executors_move_bytes() {
        COPY.check().unwrap();
        READ.check().unwrap();
        let mut executors = vec![Executor::cpu(1), Executor::cpu(2)];
        executors.extend(crate::test_support::device::executor());
        for executor in &executors {
            let found = bandwidth_gb_s(executor, 1 << 20).unwrap();
            assert!(found.copy_gb_s > 0.0 && found.read_gb_s > 0.0, "{}: {found:?}", executor.device_name());
        }
    }
}
