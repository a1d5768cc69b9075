//! Executors and device memory: what runs kernels, and the arrays they run on.
//!
//! A kernel wrapper (`x.rs`) is the only place that matches on [`Executor`]; everything else hands [`DeviceVec`]s around.

mod cpu;
mod vec;

pub use cpu::CpuExecutor;
pub use vec::DeviceVec;

/// What runs kernels.
pub enum Executor {
    /// Native code on the threads of this process.
    Cpu(CpuExecutor),
}

impl Executor {
    /// A native executor with `threads` threads (at least 1).
    pub fn cpu(threads: usize) -> Executor {
        Executor::Cpu(CpuExecutor::new(threads))
    }

    pub fn gpu(_adapter: Option<usize>, _rank: usize) -> Result<Executor, String> {
        Err("no GPU executor yet".into())
    }
    pub fn auto(_adapter: Option<usize>, _rank: usize, threads: usize) -> Result<Executor, String> {
        Ok(Executor::cpu(threads))
    }
    pub fn device_name(&self) -> String {
        "cpu".into()
    }

    /// Name for reports.
    pub fn name(&self) -> &'static str {
        match self {
            Executor::Cpu(_) => "cpu",
        }
    }
}
