//! Executors and device memory: what runs kernels, and the arrays they run on.
//!
//! A kernel wrapper (`x.rs`) is the only place that matches on [`Executor`]; everything else hands [`DeviceVec`]s around.
//! Two executors do not promise the same bits; one executor gives the same bits every time on the same adapter.

mod adapter;
mod bandwidth;
mod clock;
mod commands;
mod cpu;
mod device;
mod fault;
mod host_memory;
mod kernel;
mod layout;
mod offscreen;
pub mod primitives;
mod self_test;
mod vec;

pub use adapter::{AdapterKind, AdapterSummary, adapters};
pub use bandwidth::{Bandwidth, bandwidth_gb_s};
pub use cpu::CpuExecutor;
pub use device::{Binding, GpuExecutor, WINDOW_STEP};
pub use kernel::{ArraySlot, KernelError, KernelSource, Reflection, UniformSlot};
pub(crate) use layout::gpu_struct;
pub use layout::{GpuStruct, StructLayout};
pub use offscreen::{DrawLook, DrawVertex, Offscreen, SWATCHES};
pub use self_test::SelfTest;
pub use vec::{DeviceVec, ReadBatch};

use crate::telemetry::DeviceClock;

/// What runs kernels.
pub enum Executor {
    /// Native code on the threads of this process.
    Cpu(CpuExecutor),
    /// A device reached through wgpu.
    Gpu(Box<GpuExecutor>),
}

/// Why a device cannot be used, or can no longer be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// No driver offers an adapter.
    #[error("no graphics adapter found: install a Vulkan, Metal or DirectX 12 driver, or use the cpu executor")]
    NoAdapter,
    /// The number asked for is too large.
    #[error("adapter {index} does not exist: this machine has {count}, counted from 0")]
    NoSuchAdapter {
        /// Number asked for.
        index: usize,
        /// Adapters of this machine.
        count: usize,
    },
    /// The driver refused a device.
    #[error("adapter {adapter} gives no device: {reason}")]
    Request {
        /// Adapter and its interface.
        adapter: String,
        /// What the driver said.
        reason: String,
    },
    /// The adapter computes something else than WGSL says.
    #[error("adapter {adapter} fails the start-up test: {reason}")]
    SelfTest {
        /// Adapter and its interface.
        adapter: String,
        /// What it got wrong.
        reason: String,
    },
    /// Something went wrong while running; the executor does nothing any more.
    #[error("the gpu executor stopped: {0}")]
    Fault(String),
}

impl Executor {
    /// A native executor with `threads` threads (at least 1).
    pub fn cpu(threads: usize) -> Executor {
        Executor::Cpu(CpuExecutor::new(threads))
    }

    /// A device. `adapter` is a number from [`adapters`]; by default ranks take turns among the best ones, software only
    /// where there is nothing else ([`Executor::device_name`] says so).
    pub fn gpu(adapter: Option<usize>, rank: usize) -> Result<Executor, GpuError> {
        GpuExecutor::open(adapter, rank, u64::MAX).map(|gpu| Executor::Gpu(Box::new(gpu)))
    }

    /// A device if one is named or there is a hardware one, otherwise a native executor with `threads` threads.
    pub fn auto(adapter: Option<usize>, rank: usize, threads: usize) -> Result<Executor, GpuError> {
        if adapter.is_some() || adapter::any_hardware() {
            Executor::gpu(adapter, rank)
        } else {
            Ok(Executor::cpu(threads))
        }
    }

    /// Name for reports.
    pub fn name(&self) -> &'static str {
        match self {
            Executor::Cpu(_) => "cpu",
            Executor::Gpu(_) => "gpu",
        }
    }

    /// Name with threads or adapter, for people.
    pub fn device_name(&self) -> String {
        match self {
            Executor::Cpu(cpu) => format!("cpu, {} thread{}", cpu.threads(), if cpu.threads() == 1 { "" } else { "s" }),
            Executor::Gpu(gpu) => format!("gpu, {}", gpu.adapter().describe()),
        }
    }

    /// Starts what was asked so far, without waiting for it.
    pub fn flush(&self) {
        if let Executor::Gpu(gpu) = self {
            gpu.flush();
        }
    }

    /// Waits until everything asked so far has been done.
    pub fn finish(&self) {
        if let Executor::Gpu(gpu) = self {
            gpu.finish();
        }
    }

    /// The clock of what runs behind the host's back; none where kernels are done when asked for.
    pub fn clock(&self) -> Option<Box<dyn DeviceClock>> {
        match self {
            Executor::Cpu(_) => None,
            Executor::Gpu(gpu) => Some(Box::new(gpu.clock())),
        }
    }

    /// What went wrong on the device, if anything did. Ask after reads whose values count: a faulted device reads as
    /// zeros. The executor stays unusable, so every later call gives the same error.
    pub fn take_fault(&self) -> Option<GpuError> {
        match self {
            Executor::Cpu(_) => None,
            Executor::Gpu(gpu) => gpu.fault(),
        }
    }
}
