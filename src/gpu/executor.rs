//! The choice between native code and a device, and the requests that both understand. Running a kernel is not among
//! them: its wrapper does that.

use super::adapter::any_hardware;
use super::cpu::CpuExecutor;
use super::device::GpuExecutor;
use super::error::GpuError;
use crate::telemetry::DeviceClock;

/// Runs kernels: native twins on threads, or shaders on a device.
pub enum Executor {
    /// Native code on the threads of this process.
    Cpu(CpuExecutor),
    /// A device reached through wgpu.
    Gpu(Box<GpuExecutor>),
}

impl Executor {
    /// A native executor with `threads` threads (at least 1).
    pub fn cpu(threads: usize) -> Executor {
        Executor::Cpu(CpuExecutor::new(threads))
    }

    /// A device. `adapter` is a number from `adapters`; by default ranks take turns among the best ones, software
    /// only where there is nothing else ([`Executor::device_name`] says so).
    pub fn gpu(adapter: Option<usize>, rank: usize) -> Result<Executor, GpuError> {
        Executor::gpu_binding(adapter, rank, u64::MAX)
    }

    /// As [`Executor::gpu`], on a device that binds at most `binding_bytes` bytes of an array, fewer if that is the
    /// adapter's limit. For tests: small arrays are split as large ones are.
    pub fn gpu_binding(adapter: Option<usize>, rank: usize, binding_bytes: u64) -> Result<Executor, GpuError> {
        let gpu = GpuExecutor::open(adapter, rank, binding_bytes)?;
        gpu.self_test()?;
        Ok(Executor::Gpu(Box::new(gpu)))
    }

    /// A device if one is named or there is a hardware one, otherwise a native executor with `threads` threads.
    pub fn auto(adapter: Option<usize>, rank: usize, threads: usize) -> Result<Executor, GpuError> {
        if adapter.is_some() || any_hardware() { Executor::gpu(adapter, rank) } else { Ok(Executor::cpu(threads)) }
    }

    /// `cpu` or `gpu`, as reports and options name it.
    pub fn name(&self) -> &'static str {
        match self {
            Executor::Cpu(_) => "cpu",
            Executor::Gpu(_) => "gpu",
        }
    }

    /// Name with the number of threads or the adapter, for people.
    pub fn device_name(&self) -> String {
        match self {
            Executor::Cpu(cpu) => format!("cpu, {} thread{}", cpu.threads(), if cpu.threads() == 1 { "" } else { "s" }),
            Executor::Gpu(gpu) => format!("gpu, {}", gpu.adapter().describe()),
        }
    }

    /// The native executor, for host code that runs on its threads; none for a device.
    pub fn native(&self) -> Option<&CpuExecutor> {
        match self {
            Executor::Cpu(cpu) => Some(cpu),
            Executor::Gpu(_) => None,
        }
    }

    /// Items of `item_bytes` bytes that one binding of a kernel can show; none if there is no bound.
    pub fn window_items(&self, item_bytes: usize) -> Option<usize> {
        match self {
            Executor::Cpu(_) => None,
            Executor::Gpu(gpu) => Some(gpu.window_items(item_bytes)),
        }
    }

    /// Hands everything asked so far to the device, without waiting for it.
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

    /// The clock of a device that runs kernels while the host goes on; none for native code, whose kernels are done
    /// when the call returns.
    pub fn clock(&self) -> Option<Box<dyn DeviceClock>> {
        match self {
            Executor::Cpu(_) => None,
            Executor::Gpu(gpu) => Some(Box::new(gpu.clock())),
        }
    }

    /// The first fault of the device, if it had one. Ask after reads whose values count, because a faulted device reads
    /// as zeros. The executor stays unusable: every later call gives the same error.
    pub fn take_fault(&self) -> Option<GpuError> {
        match self {
            Executor::Cpu(_) => None,
            Executor::Gpu(gpu) => gpu.fault(),
        }
    }
}
