//! The wgpu executor: one device, its compiled kernels and bind groups.
//!
//! Commands run in the order of the calls, whichever thread makes them; none need start before [`GpuExecutor::flush`]
//! or a read. After a fault (lost device, out of memory, a kernel that the driver refuses) nothing is executed any more
//! and reads give zeros; [`super::Executor::take_fault`] returns the fault.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use super::adapter::{self, AdapterSummary};
use super::array::{BindGroups, Binding, GpuArray, LEAST_BYTES};
use super::clock;
use super::commands::{Commands, Dispatch};
use super::error::GpuError;
use super::fault::{Fault, locked};
use super::kernel::KernelSource;
use super::layout::GpuStruct;
use super::pipeline::{Kernel, spread};

/// Windows of an array begin at multiples of this many items: 64 words are 256 bytes, the largest alignment that WebGPU
/// lets an adapter ask for.
pub const WINDOW_STEP: usize = 64;

/// Bind groups that are kept; making one anew costs microseconds.
const BIND_GROUPS_MAX: usize = 4096;

/// Runs kernels through wgpu.
pub struct GpuExecutor {
    device: wgpu::Device,
    limits: wgpu::Limits,
    summary: AdapterSummary,
    commands: Arc<Commands>,
    fault: Arc<Fault>,
    next_id: AtomicU64,
    /// Compiled kernels by the address of their source.
    kernels: Mutex<HashMap<usize, Arc<Kernel>>>,
    bind_groups: Arc<BindGroups>,
}

impl GpuExecutor {
    /// Opens adapter number `adapter`, or the default one of `rank`, untested: see [`GpuExecutor::self_test`].
    /// Kernels see at most `binding_bytes` bytes of an array at once, fewer if that is the adapter's limit.
    pub(super) fn open(adapter: Option<usize>, rank: usize, binding_bytes: u64) -> Result<GpuExecutor, GpuError> {
        let (adapter, summary) = adapter::select(adapter, rank)?;
        let mut limits = adapter.limits();
        limits.max_storage_buffer_binding_size = limits.max_storage_buffer_binding_size.min(binding_bytes);
        let request = wgpu::DeviceDescriptor {
            label: Some("loomtree"),
            required_limits: limits.clone(),
            required_features: adapter.features() & clock::FEATURES,
            memory_hints: wgpu::MemoryHints::Performance,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&request))
            .map_err(|e| GpuError::Request { adapter: summary.describe(), reason: e.to_string() })?;
        let fault = Arc::new(Fault::default());
        let (on_error, on_lost, name) = (fault.clone(), fault.clone(), summary.describe());
        device.on_uncaptured_error(Arc::new(move |error| on_error.raise(one_line(&error))));
        device.set_device_lost_callback(move |reason, text| {
            on_lost.raise(format!("device {name} was lost ({reason:?}: {text})"));
        });
        let commands = Arc::new(Commands::new(device.clone(), queue, fault.clone()));
        Ok(GpuExecutor {
            device,
            limits,
            summary,
            commands,
            fault,
            next_id: AtomicU64::new(1),
            kernels: Mutex::default(),
            bind_groups: Arc::default(),
        })
    }

    /// The adapter in use.
    pub fn adapter(&self) -> &AdapterSummary {
        &self.summary
    }

    pub(super) fn limits(&self) -> &wgpu::Limits {
        &self.limits
    }

    pub(super) fn device(&self) -> &wgpu::Device {
        &self.device
    }

    pub(super) fn commands(&self) -> &Commands {
        &self.commands
    }

    pub(super) fn clock(&self) -> clock::StampClock {
        clock::StampClock::new(self.device.clone(), self.commands.clone())
    }

    /// Most items of `item_bytes` bytes (whole words) that one binding can show, rounded down to a multiple of
    /// [`WINDOW_STEP`].
    pub fn window_items(&self, item_bytes: usize) -> usize {
        (self.limits.max_storage_buffer_binding_size as usize / item_bytes / WINDOW_STEP * WINDOW_STEP).max(WINDOW_STEP)
    }

    /// `0..len` as parts that can be bound, for arrays whose items have up to `item_bytes` bytes. Parts begin at multiples
    /// of [`WINDOW_STEP`]. One empty part for an empty array.
    pub fn windows(&self, len: usize, item_bytes: usize) -> impl Iterator<Item = Range<usize>> + use<> {
        let most = self.window_items(item_bytes);
        (0..len.div_ceil(most).max(1)).map(move |i| i * most..((i + 1) * most).min(len))
    }

    /// Stops the executor: from now on it does nothing. `reason` is half a sentence for the user; the first one counts.
    pub fn stop(&self, reason: String) {
        self.fault.raise(reason);
    }

    /// The first fault, if there was one.
    pub(super) fn fault(&self) -> Option<GpuError> {
        self.fault.text().map(GpuError::Fault)
    }

    /// A buffer of at least `bytes` bytes, zeroed. Never empty, so that it can be bound.
    pub(super) fn allocate(&self, bytes: u64) -> GpuArray {
        let mut size = bytes.max(LEAST_BYTES).next_multiple_of(16);
        if bytes > self.limits.max_buffer_size {
            self.stop(format!(
                "an array of {bytes} bytes does not fit on {}, whose largest is {} bytes: use more workers",
                self.summary.describe(),
                self.limits.max_buffer_size
            ));
            size = LEAST_BYTES;
        }
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
        let descriptor = wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false };
        GpuArray { buffer: self.device.create_buffer(&descriptor), id: self.new_id(), owner: self.bind_groups.clone() }
    }

    /// Runs kernel `source` on `bindings` (in the order of their numbers, parameters left out), with at least
    /// `invocations` invocations; nothing for 0. Panics if bindings or parameters do not match the shader.
    pub fn run<P: GpuStruct>(
        &self,
        source: &'static KernelSource,
        bindings: &[Binding<'_>],
        params: &P,
        invocations: u64,
    ) {
        let Some(kernel) = self.kernel(source) else { return };
        assert_eq!(*kernel.params, P::LAYOUT, "{}: parameters of another kernel", kernel.name);
        self.check_bindings(&kernel, bindings);
        let groups = invocations.div_ceil(u64::from(kernel.workgroup));
        if groups > 0 {
            self.dispatch(&kernel, bindings, bytemuck::bytes_of(params), spread(groups));
        }
    }

    /// Panics if the bindings are not those of the shader: a mistake in the wrapper, whatever the scene. Stops the
    /// executor if one is larger than the adapter binds.
    fn check_bindings(&self, kernel: &Kernel, bindings: &[Binding<'_>]) {
        assert_eq!(bindings.len(), kernel.arrays.len(), "{}: number of arrays", kernel.name);
        let (alignment, most) =
            (self.limits.min_storage_buffer_offset_alignment, self.limits.max_storage_buffer_binding_size);
        for (binding, slot) in bindings.iter().zip(&kernel.arrays) {
            assert!(binding.writable || !slot.writable, "{}: {} must be bound as writable", kernel.name, slot.name);
            assert_eq!(
                binding.offset % u64::from(alignment),
                0,
                "{}: offset of {} cannot be bound",
                kernel.name,
                slot.name
            );
            if binding.size > most {
                self.stop(format!(
                    "array {} of kernel {} has {} bytes, {} binds at most {most}: use more workers",
                    slot.name,
                    kernel.name,
                    binding.size,
                    self.summary.describe(),
                ));
            }
        }
    }

    /// The compiled kernel, made on first use; None (and a fault) if that fails.
    fn kernel(&self, source: &'static KernelSource) -> Option<Arc<Kernel>> {
        if self.fault.raised() {
            return None;
        }
        let mut kernels = locked(&self.kernels);
        let key = std::ptr::from_ref(source) as usize;
        if let Some(kernel) = kernels.get(&key) {
            return Some(kernel.clone());
        }
        match Kernel::new(&self.device, &self.limits, self.new_id(), source) {
            Ok(kernel) => Some(kernels.entry(key).or_insert(Arc::new(kernel)).clone()),
            Err(error) => {
                self.stop(error.to_string());
                None
            }
        }
    }

    /// A number that no other array or kernel of this executor has.
    pub(super) fn new_id(&self) -> u64 {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    /// Adds a dispatch of `groups` workgroups to the commands.
    pub(super) fn dispatch(&self, kernel: &Kernel, bindings: &[Binding<'_>], params: &[u8], groups: [u32; 2]) {
        if self.fault.raised() {
            return;
        }
        let bind_group = self.bind_group(kernel, bindings);
        let params = kernel.uniform.as_ref().map(|uniform| (params, uniform.size));
        self.commands.dispatch(&Dispatch { pipeline: &kernel.pipeline, bind_group: &bind_group, params, groups });
    }

    /// The bind group of `kernel` for these windows.
    fn bind_group(&self, kernel: &Kernel, bindings: &[Binding<'_>]) -> wgpu::BindGroup {
        let entry = |binding, buffer, offset, size| {
            let window = wgpu::BufferBinding { buffer, offset, size: wgpu::BufferSize::new(size) };
            wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::Buffer(window) }
        };
        let make = || {
            let mut entries: Vec<wgpu::BindGroupEntry<'_>> = kernel
                .arrays
                .iter()
                .zip(bindings)
                .map(|(slot, b)| entry(slot.binding, &b.array.buffer, b.offset, b.size))
                .collect();
            entries.extend(kernel.uniform.iter().map(|u| entry(u.binding, self.commands.arena(), 0, u.size)));
            let label = Some(kernel.name);
            self.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label,
                layout: &kernel.layout,
                entries: &entries,
            })
        };
        let key = (kernel.id, bindings.iter().map(|b| (b.array.id, b.offset, b.size)).collect());
        let mut groups = locked(&self.bind_groups.0);
        // Arrays whose length changes from step to step leave groups behind that are never used again.
        if groups.len() >= BIND_GROUPS_MAX {
            groups.clear();
        }
        groups.entry(key).or_insert_with(make).clone()
    }

    /// Hands the commands so far to the device, without waiting for them.
    pub fn flush(&self) {
        self.commands.flush();
    }

    /// Waits until everything asked so far has been done.
    pub fn finish(&self) {
        self.commands.finish();
    }
}

/// The first line of an error, with what caused it.
fn one_line(error: &wgpu::Error) -> String {
    let text = match error {
        wgpu::Error::OutOfMemory { .. } => {
            "the device is out of memory: use more workers or a smaller scene".to_string()
        }
        other => other.to_string(),
    };
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use crate::gpu::{DeviceVec, Executor};
    use crate::test_support::device;

    fn device(executor: &Executor) -> &super::GpuExecutor {
        let Executor::Gpu(gpu) = executor else { panic!("not a device") };
        gpu
    }

    #[test]
    fn a_lost_device_is_reported_and_nothing_hangs() {
        let Some(executor) = device::executor() else { return };
        let mut values = DeviceVec::upload(&executor, &[1u32, 2, 3]);
        assert_eq!(values.read(&executor), [1, 2, 3]);
        device(&executor).device.destroy();
        assert_eq!(values.read(&executor), [0, 0, 0]);
        let text = executor.take_fault().expect("a fault").to_string();
        assert!(text.starts_with("the gpu executor stopped: "), "{text}");
        // Whatever is asked now does nothing.
        values.write_range(&executor, 0, &[5]);
        let more = DeviceVec::<u32>::zeros(&executor, 10);
        assert_eq!(more.read(&executor), [0; 10]);
        executor.finish();
        assert!(executor.take_fault().is_some());
    }

    #[test]
    fn an_array_too_large_is_a_sentence() {
        let Some(executor) = device::executor() else { return };
        let most = device(&executor).limits.max_buffer_size;
        let huge = DeviceVec::<[u32; 4]>::zeros(&executor, (most / 16 + 1) as usize);
        let mut first = [[1u32; 4]];
        huge.read_range(&executor, 0, &mut first);
        assert_eq!(first, [[0; 4]]);
        let text = executor.take_fault().expect("a fault").to_string();
        assert!(text.contains(&most.to_string()) && text.contains("use more workers"), "{text}");
    }

    #[test]
    fn windows_start_where_they_can_be_bound() {
        let Some(executor) = device::executor() else { return };
        let gpu = device(&executor);
        for item_bytes in [4, 12, 16, 36, 100] {
            let items = gpu.window_items(item_bytes);
            let bytes = (items * item_bytes) as u64;
            assert!(items > 0 && bytes <= gpu.limits.max_storage_buffer_binding_size);
            assert_eq!(bytes % u64::from(gpu.limits.min_storage_buffer_offset_alignment), 0, "{item_bytes}");
            let windows: Vec<_> = gpu.windows(items + 1, item_bytes).collect();
            assert_eq!(windows, [0..items, items..items + 1]);
            assert!(gpu.windows(0, item_bytes).eq(std::iter::once(0..0)));
        }
    }

    #[test]
    fn arrays_that_are_gone_leave_nothing_behind() {
        let Some(executor) = device::executor() else { return };
        let values = DeviceVec::upload(&executor, &[1u32, 2, 3]);
        let before = super::locked(&device(&executor).bind_groups.0).len();
        let mut sums = DeviceVec::zeros(&executor, 3);
        crate::gpu::primitives::exclusive_scan(&executor, &values, &mut sums);
        assert_eq!(sums.read(&executor), [0, 1, 3]);
        drop((values, sums));
        assert_eq!(super::locked(&device(&executor).bind_groups.0).len(), before);
    }
}
