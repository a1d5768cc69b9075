//! Arrays on a device, the parts of them that kernels see, and the bind groups that go with them.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use super::commands::ReadPart;
use super::fault::locked;

/// Least bytes of a buffer. No struct of a kernel is larger, so an empty array can be bound as an array of any of them.
pub(super) const LEAST_BYTES: u64 = 256;

/// Bind groups by kernel and windows. An array removes its own when it is dropped.
#[derive(Default)]
pub(super) struct BindGroups(pub(super) Mutex<HashMap<BindKey, wgpu::BindGroup>>);

/// Kernel and (array, offset, size) of every binding.
pub(super) type BindKey = (u64, Vec<(u64, u64, u64)>);

/// A buffer of the device.
pub(super) struct GpuArray {
    pub(super) buffer: wgpu::Buffer,
    pub(super) id: u64,
    pub(super) owner: Arc<BindGroups>,
}

impl Drop for GpuArray {
    fn drop(&mut self) {
        locked(&self.owner.0).retain(|(_, windows), _| windows.iter().all(|window| window.0 != self.id));
    }
}

/// A part of an array, as a kernel sees it.
#[derive(Clone, Copy)]
pub struct Binding<'a> {
    pub(super) array: &'a GpuArray,
    pub(super) offset: u64,
    pub(super) size: u64,
    pub(super) writable: bool,
}

impl GpuArray {
    /// Bytes from `offset` on, to be read into `out`.
    pub(super) fn read_part<'a>(&'a self, offset: u64, out: &'a mut [u8]) -> ReadPart<'a> {
        ReadPart { buffer: &self.buffer, offset, out }
    }
}
