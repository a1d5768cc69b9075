//! Triangle hash table on the device: the layers that a rank counts, of the triangles that it needs for them. Passes: residents
//! per bucket, visitors per bucket, loads of chunks of buckets (which the host reads), and per batch of chunks loads of
//! buckets, scans, entries. Arrays hold what those layers and triangles take, so they shrink with the number of ranks.
//!
//! The grids are nested: cells are whole numbers of the finest grid, computed once per triangle, and coarser ones are shifts
//! of them, so every pass sees the same cells however a driver compiles it. A triangle *resides* in the finest grid where
//! it covers at most two cells per axis and *visits* the coarser ones that have residents near it. In every layer the finest
//! grid has buckets of its own, the coarser ones share the rest.
//!
//! Entries of a bucket are in order of their class (resident cloth, resident obstacles, visiting cloth, visiting obstacles)
//! and in no order within; counts are the same every time.

use std::ops::Range;

use super::hash_cpu;
use crate::gpu::primitives::exclusive_scan;
use crate::gpu::{DeviceVec, Executor, KernelSource, gpu_struct};

const TEXT: &str = include_str!("hash.wgsl");
const LIBRARIES: &[&str] = &[include_str!("boxes.wgsl")];
const fn kernel(entry: &'static str) -> KernelSource {
    KernelSource::new::<HashParams>("collision/broad/device/hash.wgsl", TEXT, entry).with_libraries(LIBRARIES)
}
static COUNT_RESIDENTS: KernelSource = kernel("count_residents");
static COUNT_VISITORS: KernelSource = kernel("count_visitors");
static CHUNK_LOADS: KernelSource = kernel("chunk_loads");
static BUCKET_LOADS: KernelSource = kernel("bucket_loads");
static FILL: KernelSource = kernel("fill");

/// Values per grid: see the shader.
const LEVEL: usize = 8;
/// Most buckets per chunk.
pub(super) const CHUNK: usize = 256;

gpu_struct! {
    pub(super) struct HashParams {
        pub origin: [f32; 4],
        pub cloth_lo: [f32; 4],
        pub cloth_hi: [f32; 4],
        pub triangles: u32,
        pub cloth_triangles: u32,
        pub axis: u32,
        pub first_block: u32,
        pub last_layer: u32,
        pub first_layer: u32,
        pub layers: u32,
        pub chunks: u32,
        pub first_bucket: u32,
        pub buckets: u32,
        pub padding0: u32,
        pub padding1: u32,
    }
}

/// Input of passes over triangles: positions of all vertices at both ends of the step, and corners, owned features and
/// piece per triangle that takes part. Kernels number triangles by their places in that list, which is in the order of
/// the mesh.
pub(super) struct Shapes {
    pub x_t0: DeviceVec<f32>,
    /// None: nothing moves, the end is the start.
    pub x_t1: Option<DeviceVec<f32>>,
    pub faces: DeviceVec<[u32; 4]>,
}

impl Shapes {
    pub(super) fn end(&self) -> &DeviceVec<f32> {
        self.x_t1.as_ref().unwrap_or(&self.x_t0)
    }
}

/// Parameters and tables with which kernels count a range of layers.
pub(super) struct Window {
    pub layers: Range<usize>,
    pub params: HashParams,
    /// Per layer: its first bucket, counted from the first of the window; log2 of the numbers of blocks of 8 buckets:
    /// finest grid, coarser grids times 256.
    pub table: Vec<[u32; 2]>,
    /// Per grid lowest cell, highest cell, 1 if it may have residents, 0.
    pub levels: Vec<[u32; 8]>,
    /// First bucket and end of every chunk. A chunk lies in one layer.
    pub chunks: Vec<[u32; 2]>,
}

impl Window {
    /// Bytes of what the host holds.
    pub(super) fn bytes(&self) -> u64 {
        (size_of_val(&self.chunks[..]) + size_of_val(&self.table[..])) as u64
    }
}

/// The table of a window of layers.
pub(super) struct DeviceTable {
    /// Per triangle lower and upper corner, bits; behind them owned features and piece, grid + 1 (0: takes no part).
    pub boxes: DeviceVec<[u32; 4]>,
    /// Per triangle lowest and highest cell of the finest grid.
    cells: DeviceVec<[u32; 4]>,
    /// Per bucket resident cloth, resident obstacles, visiting cloth, visiting obstacles.
    pub counts: DeviceVec<[u32; 4]>,
    layers: DeviceVec<[u32; 2]>,
    levels: DeviceVec<[u32; LEVEL]>,
    /// Buckets of every chunk.
    spans: DeviceVec<[u32; 2]>,
    chunks: DeviceVec<[u32; 4]>,
}

/// Chunks whose entries are in memory together.
pub(super) struct DeviceEntries {
    tests: DeviceVec<u32>,
    sizes: DeviceVec<u32>,
    /// Tests before every bucket of the batch, and all.
    pub test_starts: DeviceVec<u32>,
    /// Entries before every bucket of the batch, and all.
    pub starts: DeviceVec<u32>,
    cursors: DeviceVec<[u32; 4]>,
    /// Per entry: number of the triangle, tag of the cell.
    pub entries: DeviceVec<[u32; 2]>,
}

impl DeviceTable {
    pub(super) fn new(executor: &Executor) -> DeviceTable {
        DeviceTable {
            boxes: DeviceVec::zeros(executor, 0),
            cells: DeviceVec::zeros(executor, 0),
            counts: DeviceVec::zeros(executor, 0),
            layers: DeviceVec::zeros(executor, 0),
            levels: DeviceVec::zeros(executor, 0),
            spans: DeviceVec::zeros(executor, 0),
            chunks: DeviceVec::zeros(executor, 0),
        }
    }

    /// Counts who is in which bucket of a window; `shapes` has the faces of its members. Loads of its chunks: tests (low,
    /// high word), entries and buckets with tests.
    pub(super) fn count(&mut self, executor: &Executor, window: &Window, shapes: &Shapes) -> Vec<[u32; 4]> {
        let params = &window.params;
        self.boxes.resize(executor, 2 * params.triangles as usize);
        self.cells.resize(executor, params.triangles as usize);
        self.counts.resize(executor, params.buckets as usize);
        self.counts.fill_zero(executor);
        self.layers.assign(executor, &window.table);
        self.levels.assign(executor, &window.levels);
        match executor {
            Executor::Cpu(_) => hash_cpu::count_residents(
                params,
                shapes.x_t0.as_slice(),
                shapes.end().as_slice(),
                shapes.faces.as_slice(),
                self.boxes.as_mut_slice(),
                self.cells.as_mut_slice(),
                self.counts.as_mut_slice(),
                self.layers.as_slice(),
            ),
            Executor::Gpu(gpu) => {
                let bindings = [
                    shapes.x_t0.binding(),
                    shapes.end().binding(),
                    shapes.faces.binding(),
                    self.boxes.binding_mut(),
                    self.cells.binding_mut(),
                    self.counts.binding_mut(),
                    self.layers.binding(),
                ];
                gpu.run(&COUNT_RESIDENTS, &bindings, params, u64::from(params.triangles));
            }
        }
        if window.levels.iter().any(|level| level[6] != 0) {
            self.count_visitors(executor, params);
        }
        self.loads(executor, params, &window.chunks)
    }

    fn count_visitors(&mut self, executor: &Executor, params: &HashParams) {
        match executor {
            Executor::Cpu(_) => hash_cpu::count_visitors(
                params,
                self.boxes.as_slice(),
                self.cells.as_slice(),
                self.counts.as_mut_slice(),
                self.layers.as_slice(),
                self.levels.as_slice(),
            ),
            Executor::Gpu(gpu) => {
                let bindings = [
                    self.boxes.binding_mut(),
                    self.cells.binding_mut(),
                    self.counts.binding_mut(),
                    self.layers.binding(),
                    self.levels.binding(),
                ];
                gpu.run(&COUNT_VISITORS, &bindings, params, u64::from(params.triangles));
            }
        }
    }

    /// Loads of the chunks `spans`: tests (low, high word), entries and buckets with tests.
    pub(super) fn loads(&mut self, executor: &Executor, params: &HashParams, spans: &[[u32; 2]]) -> Vec<[u32; 4]> {
        self.spans.assign(executor, spans);
        self.chunks.resize(executor, spans.len());
        match executor {
            Executor::Cpu(_) => {
                let (counts, spans) = (self.counts.as_slice(), self.spans.as_slice());
                hash_cpu::chunk_loads(params, counts, spans, self.chunks.as_mut_slice());
            }
            Executor::Gpu(gpu) => {
                let bindings = [self.counts.binding_mut(), self.spans.binding(), self.chunks.binding_mut()];
                gpu.run(&CHUNK_LOADS, &bindings, params, u64::from(params.chunks));
            }
        }
        self.chunks.read(executor)
    }

    /// Makes the entries of `params.buckets` buckets of the window from `params.first_bucket` on; there are `size` of them.
    pub(super) fn fill(&mut self, executor: &Executor, params: &HashParams, size: usize, out: &mut DeviceEntries) {
        let buckets = params.buckets as usize;
        out.tests.resize(executor, buckets);
        out.sizes.resize(executor, buckets);
        out.cursors.resize(executor, buckets);
        out.cursors.fill_zero(executor);
        out.test_starts.resize(executor, buckets + 1);
        out.starts.resize(executor, buckets + 1);
        out.entries.resize(executor, size);
        match executor {
            Executor::Cpu(_) => {
                let (tests, sizes) = (out.tests.as_mut_slice(), out.sizes.as_mut_slice());
                hash_cpu::bucket_loads(params, self.counts.as_slice(), tests, sizes);
            }
            Executor::Gpu(gpu) => {
                let bindings = [self.counts.binding_mut(), out.tests.binding_mut(), out.sizes.binding_mut()];
                gpu.run(&BUCKET_LOADS, &bindings, params, buckets as u64);
            }
        }
        exclusive_scan(executor, &out.tests, &mut out.test_starts);
        exclusive_scan(executor, &out.sizes, &mut out.starts);
        match executor {
            Executor::Cpu(_) => hash_cpu::fill(
                params,
                self.boxes.as_slice(),
                self.cells.as_slice(),
                self.counts.as_slice(),
                self.layers.as_slice(),
                self.levels.as_slice(),
                out.starts.as_slice(),
                out.cursors.as_mut_slice(),
                out.entries.as_mut_slice(),
            ),
            Executor::Gpu(gpu) => {
                let bindings = [
                    self.boxes.binding_mut(),
                    self.cells.binding_mut(),
                    self.counts.binding_mut(),
                    self.layers.binding(),
                    self.levels.binding(),
                    out.starts.binding(),
                    out.cursors.binding_mut(),
                    out.entries.binding_mut(),
                ];
                gpu.run(&FILL, &bindings, params, u64::from(params.triangles));
            }
        }
    }

    /// Bytes on the device, unused capacity included.
    pub(super) fn bytes(&self) -> u64 {
        let of_triangles = self.boxes.held_bytes() + self.cells.held_bytes();
        let of_layers = self.layers.held_bytes() + self.levels.held_bytes();
        of_triangles + of_layers + self.counts.held_bytes() + self.spans.held_bytes() + self.chunks.held_bytes()
    }
}

impl DeviceEntries {
    pub(super) fn new(executor: &Executor) -> DeviceEntries {
        DeviceEntries {
            tests: DeviceVec::zeros(executor, 0),
            sizes: DeviceVec::zeros(executor, 0),
            test_starts: DeviceVec::zeros(executor, 0),
            starts: DeviceVec::zeros(executor, 0),
            cursors: DeviceVec::zeros(executor, 0),
            entries: DeviceVec::zeros(executor, 0),
        }
    }

    /// Bytes of a batch with `buckets` buckets (tests, sizes, both starts, cursors) and `entries` entries.
    pub(super) fn bytes_for(buckets: u64, entries: u64) -> u64 {
        32 * buckets + 8 * entries
    }

    /// Bytes on the device, unused capacity included.
    pub(super) fn bytes(&self) -> u64 {
        let per_bucket = self.tests.held_bytes() + self.sizes.held_bytes() + self.cursors.held_bytes();
        per_bucket + self.test_starts.held_bytes() + self.starts.held_bytes() + self.entries.held_bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::super::levels::LEVELS;
    use super::*;

    #[test]
    fn shader_and_wrapper_agree() {
        for kernel in [&COUNT_RESIDENTS, &COUNT_VISITORS, &CHUNK_LOADS, &BUCKET_LOADS, &FILL] {
            // Every adapter binds eight arrays.
            assert!(kernel.check().unwrap().arrays.len() <= 8);
        }
        for (name, value) in [("LEVELS", LEVELS), ("LEVEL", LEVEL)] {
            assert!(TEXT.contains(&format!("const {name}: u32 = {value}u;")), "{name}");
        }
    }
}
