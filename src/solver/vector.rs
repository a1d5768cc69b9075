//! The vectors of PCG and their kernels: start, dot product, fused update. Sums per chunk stay on the executor until
//! [`VectorOps::sums`] fetches them in one read; `reduction` adds them.

use std::ops::Range;

use super::vector_cpu;
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor, KernelSource, gpu_struct};
use crate::telemetry::{Activity, EventName};

const TEXT: &str = include_str!("vector.wgsl");
pub(super) const LIBRARIES: &[&str] = &[include_str!("chunk.wgsl")];
static START: KernelSource =
    KernelSource::new::<VectorParams>("solver/vector.wgsl", TEXT, "start").with_libraries(LIBRARIES);
static DOT: KernelSource =
    KernelSource::new::<VectorParams>("solver/vector.wgsl", TEXT, "dot_product").with_libraries(LIBRARIES);
static UPDATE: KernelSource =
    KernelSource::new::<VectorParams>("solver/vector.wgsl", TEXT, "update").with_libraries(LIBRARIES);
/// CHUNK_THREADS of the shader.
pub(super) const CHUNK_THREADS: u64 = 128;

gpu_struct! {
    struct VectorParams { rows: u32, chunk_rows: u32, u_first: u32, alpha: f32, beta: f32 }
}

/// Sums of a chunk: r . u, r . r, w . u.
pub type ChunkSums = [f64; 3];

/// Step length and conjugation factor of an iteration.
#[derive(Clone, Copy, Debug)]
pub struct Scalars {
    /// gamma / p'Ap.
    pub alpha: f64,
    /// gamma divided by that of the iteration before; 0 in the first one.
    pub beta: f64,
}

/// Vectors of a solve on the own rows (xyz per row); `u` also holds halo rows.
pub struct PcgVectors {
    /// First own value of `u`.
    pub(super) own_start: usize,
    /// Preconditioned residual, local rows.
    pub u: DeviceVec<f32>,
    /// Start value on entry, solution on return.
    pub x: DeviceVec<f32>,
    pub(super) r: DeviceVec<f32>,
    /// A u.
    pub(super) w: DeviceVec<f32>,
    pub(super) p: DeviceVec<f32>,
    /// A p.
    pub(super) s: DeviceVec<f32>,
}

impl PcgVectors {
    /// Zero vectors for the own rows `own` of a local vector of `local_rows` rows.
    pub fn new(executor: &Executor, own: Range<usize>, local_rows: usize) -> PcgVectors {
        let of_own = || DeviceVec::zeros(executor, own.len() * 3);
        PcgVectors {
            own_start: own.start * 3,
            u: DeviceVec::zeros(executor, local_rows * 3),
            x: of_own(),
            r: of_own(),
            w: of_own(),
            p: of_own(),
            s: of_own(),
        }
    }

    /// Makes room for local vectors of `local_rows` rows. Never shrinks. The halo rows of `u` are not preserved,
    /// because every product receives them anew.
    pub fn grow(&mut self, executor: &Executor, local_rows: usize) {
        if local_rows * 3 > self.u.len() {
            self.u.resize(executor, local_rows * 3);
        }
    }

    /// Device bytes.
    pub fn bytes(&self) -> u64 {
        self.u.held_bytes() + 5 * self.x.bytes()
    }

    /// [`VectorOps::update`] of these vectors, recorded. Bytes per row: 156.
    pub(super) fn update(
        &mut self,
        rank: &mut RankContext<'_>,
        ops: &mut VectorOps,
        Scalars { alpha, beta }: Scalars,
        inverse_diagonal: &DeviceVec<f32>,
    ) {
        let start = rank.recorder.before_kernels();
        let PcgVectors { own_start, u, x, r, w, p, s } = self;
        let (alpha, beta) = (alpha as f32, beta as f32);
        ops.update(rank.executor, alpha, beta, w, inverse_diagonal, u, *own_start, p, s, x, r);
        let (bytes, flops) = (w.bytes() * 13, w.len() as u64 * 18);
        rank.recorder.end(EventName::VectorUpdate, Activity::Compute, start, bytes, flops);
    }
}

/// The vector kernels on one executor, for a fixed number of own rows.
pub struct VectorOps {
    rows: usize,
    chunk_rows: usize,
    /// Sums (r . u, r . r) and (w . u) of the cpu executor.
    residual_sums: Vec<[f64; 2]>,
    dot_sums: Vec<f64>,
    /// The three sums of every chunk on a device.
    device_sums: DeviceVec<f32>,
}

impl VectorOps {
    /// Kernels for `rows` own rows in chunks of `chunk_rows`.
    pub fn new(executor: &Executor, rows: usize, chunk_rows: usize) -> VectorOps {
        let chunks = rows.div_ceil(chunk_rows);
        VectorOps {
            rows,
            chunk_rows,
            residual_sums: vec![[0.0; 2]; chunks],
            dot_sums: vec![0.0; chunks],
            device_sums: DeviceVec::zeros(executor, chunks * 3),
        }
    }

    /// Number of own chunks.
    pub fn chunks(&self) -> usize {
        self.dot_sums.len()
    }

    /// Sums w . u; `u_start` = first value of u that belongs to the own rows.
    pub fn dot(&mut self, executor: &Executor, w: &DeviceVec<f32>, u: &DeviceVec<f32>, u_start: usize) {
        match executor {
            Executor::Cpu(cpu) => vector_cpu::dot(
                cpu,
                self.chunk_rows,
                w.as_slice(),
                &u.as_slice()[u_start..u_start + w.len()],
                &mut self.dot_sums,
            ),
            Executor::Gpu(gpu) => {
                let (params, invocations) = self.dispatch(u_start, 0.0, 0.0);
                gpu.run(&DOT, &[w.binding(), u.binding(), self.device_sums.binding_mut()], &params, invocations);
            }
        }
    }

    /// r = b - w (0 on pinned rows), u = inverse_diagonal * r; sums r . u and r . r.
    #[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
    pub fn start(
        &mut self,
        executor: &Executor,
        b: &DeviceVec<f32>,
        w: &DeviceVec<f32>,
        inverse_diagonal: &DeviceVec<f32>,
        r: &mut DeviceVec<f32>,
        u: &mut DeviceVec<f32>,
        u_start: usize,
    ) {
        match executor {
            Executor::Cpu(cpu) => {
                let own = u_start..u_start + b.len();
                vector_cpu::start(
                    cpu,
                    self.chunk_rows,
                    b.as_slice(),
                    w.as_slice(),
                    inverse_diagonal.as_slice(),
                    r.as_mut_slice(),
                    &mut u.as_mut_slice()[own],
                    &mut self.residual_sums,
                )
            }
            Executor::Gpu(gpu) => {
                let (params, invocations) = self.dispatch(u_start, 0.0, 0.0);
                let bindings = [
                    b.binding(),
                    w.binding(),
                    inverse_diagonal.binding(),
                    u.binding_mut(),
                    r.binding_mut(),
                    self.device_sums.binding_mut(),
                ];
                gpu.run(&START, &bindings, &params, invocations);
            }
        }
    }

    /// p = u + beta p; s = w + beta s; x += alpha p; r -= alpha s; u = inverse_diagonal * r; sums r . u and r . r.
    #[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
    pub fn update(
        &mut self,
        executor: &Executor,
        alpha: f32,
        beta: f32,
        w: &DeviceVec<f32>,
        inverse_diagonal: &DeviceVec<f32>,
        u: &mut DeviceVec<f32>,
        u_start: usize,
        p: &mut DeviceVec<f32>,
        s: &mut DeviceVec<f32>,
        x: &mut DeviceVec<f32>,
        r: &mut DeviceVec<f32>,
    ) {
        match executor {
            Executor::Cpu(cpu) => {
                let own = u_start..u_start + w.len();
                vector_cpu::update(
                    cpu,
                    self.chunk_rows,
                    alpha,
                    beta,
                    w.as_slice(),
                    inverse_diagonal.as_slice(),
                    &mut u.as_mut_slice()[own],
                    p.as_mut_slice(),
                    s.as_mut_slice(),
                    x.as_mut_slice(),
                    r.as_mut_slice(),
                    &mut self.residual_sums,
                )
            }
            Executor::Gpu(gpu) => {
                let (params, invocations) = self.dispatch(u_start, alpha, beta);
                let bindings = [
                    w.binding(),
                    inverse_diagonal.binding(),
                    u.binding_mut(),
                    p.binding_mut(),
                    s.binding_mut(),
                    x.binding_mut(),
                    r.binding_mut(),
                    self.device_sums.binding_mut(),
                ];
                gpu.run(&UPDATE, &bindings, &params, invocations);
            }
        }
    }

    /// Sums of the last `start` or `update` and of the last `dot`, per own chunk. They are NaN after a fault of the
    /// device.
    pub fn sums(&self, executor: &Executor, out: &mut Vec<ChunkSums>) {
        out.clear();
        match executor {
            Executor::Cpu(_) => {
                out.extend(self.residual_sums.iter().zip(&self.dot_sums).map(|(&[ru, rr], &wu)| [ru, rr, wu]))
            }
            Executor::Gpu(_) => {
                out.extend(self.device_sums.read(executor).as_chunks::<3>().0.iter().map(|sums| sums.map(f64::from)));
                if executor.take_fault().is_some() {
                    out.fill([f64::NAN; 3]);
                }
            }
        }
    }

    /// Parameters of a dispatch with one workgroup per chunk.
    fn dispatch(&self, u_start: usize, alpha: f32, beta: f32) -> (VectorParams, u64) {
        let params = VectorParams {
            rows: self.rows as u32,
            chunk_rows: self.chunk_rows as u32,
            u_first: (u_start / 3) as u32,
            alpha,
            beta,
        };
        (params, self.chunks() as u64 * CHUNK_THREADS)
    }
}
