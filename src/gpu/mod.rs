//! Executors and device memory: what runs kernels, and the arrays they run on.
//!
//! A kernel wrapper (`x.rs`) is the only place that chooses between a shader and its native twin; everything else hands
//! [`DeviceVec`]s around and asks the executor (`Executor::native`, `Executor::window_items`) where host code must
//! know. Two executors do not promise the same bits; one executor gives the same bits every time on the same adapter.

mod adapter;
mod array;
mod bandwidth;
mod clock;
mod commands;
mod cpu;
mod device;
mod error;
mod executor;
mod fault;
mod host_memory;
mod kernel;
mod layout;
mod offscreen;
mod pipeline;
pub mod primitives;
mod self_test;
mod vec;

pub use adapter::{AdapterKind, AdapterSummary, adapters};
pub use array::Binding;
pub use bandwidth::{Bandwidth, bandwidth_gb_s};
pub use cpu::CpuExecutor;
pub use device::{GpuExecutor, WINDOW_STEP};
pub use error::GpuError;
pub use executor::Executor;
pub use kernel::{ArraySlot, KernelError, KernelSource, Reflection, UniformSlot};
pub(crate) use layout::gpu_struct;
pub use layout::{GpuStruct, StructLayout};
pub use offscreen::{DrawLook, DrawVertex, LIGHT_SIDE, LIGHTS, LIGHTS_OF_KEY, Offscreen};
pub use self_test::SelfTest;
pub use vec::{DeviceVec, ReadBatch};
