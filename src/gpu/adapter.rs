//! Adapters of this machine, and which one a rank takes. Listing adapters creates no device.

use super::error::GpuError;

/// Kind of hardware behind an adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AdapterKind {
    /// A card with its own memory.
    Discrete,
    /// A GPU that shares the memory of the processor.
    Integrated,
    /// A GPU handed through to a virtual machine.
    Virtual,
    /// The driver does not say.
    Unknown,
    /// A driver that computes on the processor; for testing shaders, much slower than the native executor.
    Software,
}

/// An adapter, for people and for reports.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterSummary {
    /// Number to name it by; hardware comes before software.
    pub index: usize,
    /// Name given by the driver.
    pub name: String,
    /// Graphics interface it is reached through (`vulkan`, `metal`, `dx12`).
    pub backend: String,
    /// Driver and its version.
    pub driver: String,
    /// True if the adapter is hardware, and of which kind.
    pub kind: AdapterKind,
    /// Largest array, in bytes.
    pub max_buffer_bytes: u64,
    /// Largest part of an array that one kernel can see at once, in bytes.
    pub max_binding_bytes: u64,
    /// Arrays that one kernel can see.
    pub max_storage_buffers: u32,
    /// Invocations in one workgroup.
    pub max_workgroup_invocations: u32,
    /// Memory shared by a workgroup, in bytes.
    pub max_workgroup_bytes: u32,
}

impl AdapterSummary {
    /// Text for reports: name, interface and a word if it is software.
    pub fn describe(&self) -> String {
        let software = if self.kind == AdapterKind::Software { ", a software adapter" } else { "" };
        format!("{} ({}{software})", self.name, self.backend)
    }
}

/// The adapters of this machine, hardware first; the place in the list is the number that selects one.
pub fn adapters() -> Vec<AdapterSummary> {
    enumerate().into_iter().map(|(_, summary)| summary).collect()
}

/// True if there is an adapter that is not software.
pub(super) fn any_hardware() -> bool {
    adapters().iter().any(|a| a.kind != AdapterKind::Software)
}

/// The adapter with number `wanted`, or the default one of `rank`.
pub(super) fn select(wanted: Option<usize>, rank: usize) -> Result<(wgpu::Adapter, AdapterSummary), GpuError> {
    let mut found = enumerate();
    let summaries: Vec<AdapterSummary> = found.iter().map(|(_, summary)| summary.clone()).collect();
    let index = choose(&summaries, wanted, rank)?;
    Ok(found.swap_remove(index))
}

/// `wanted`, or by default the `rank`-th, in turn, of those of the best kind that share the first one's interface (one
/// card can be reachable through two).
fn choose(found: &[AdapterSummary], wanted: Option<usize>, rank: usize) -> Result<usize, GpuError> {
    let Some(first) = found.first() else {
        return Err(GpuError::NoAdapter);
    };
    match wanted {
        Some(index) if index < found.len() => Ok(index),
        Some(index) => Err(GpuError::NoSuchAdapter { index, count: found.len() }),
        None => {
            let alike = found.iter().take_while(|a| a.kind == first.kind && a.backend == first.backend).count();
            Ok(rank % alike)
        }
    }
}

fn enumerate() -> Vec<(wgpu::Adapter, AdapterSummary)> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    let mut found: Vec<(wgpu::Adapter, AdapterSummary)> =
        pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()))
            .into_iter()
            .map(|adapter| {
                let summary = summarize(&adapter);
                (adapter, summary)
            })
            .collect();
    // Stable: adapters of one kind keep the driver's order, which is the same for every process of a machine.
    found.sort_by(|(_, a), (_, b)| (a.kind, &a.backend).cmp(&(b.kind, &b.backend)));
    for (index, (_, summary)) in found.iter_mut().enumerate() {
        summary.index = index;
    }
    found
}

fn summarize(adapter: &wgpu::Adapter) -> AdapterSummary {
    let info = adapter.get_info();
    let limits = adapter.limits();
    AdapterSummary {
        index: 0,
        name: info.name,
        backend: info.backend.to_str().to_string(),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_string(),
        kind: match info.device_type {
            wgpu::DeviceType::DiscreteGpu => AdapterKind::Discrete,
            wgpu::DeviceType::IntegratedGpu => AdapterKind::Integrated,
            wgpu::DeviceType::VirtualGpu => AdapterKind::Virtual,
            wgpu::DeviceType::Other => AdapterKind::Unknown,
            wgpu::DeviceType::Cpu => AdapterKind::Software,
        },
        max_buffer_bytes: limits.max_buffer_size,
        max_binding_bytes: limits.max_storage_buffer_binding_size,
        max_storage_buffers: limits.max_storage_buffers_per_shader_stage,
        max_workgroup_invocations: limits.max_compute_invocations_per_workgroup,
        max_workgroup_bytes: limits.max_compute_workgroup_storage_size,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(kinds: &[(AdapterKind, &str)]) -> Vec<AdapterSummary> {
        let summary = |(index, &(kind, backend)): (usize, &(AdapterKind, &str))| AdapterSummary {
            index,
            name: String::new(),
            backend: backend.to_string(),
            driver: String::new(),
            kind,
            max_buffer_bytes: 0,
            max_binding_bytes: 0,
            max_storage_buffers: 0,
            max_workgroup_invocations: 0,
            max_workgroup_bytes: 0,
        };
        kinds.iter().enumerate().map(summary).collect()
    }

    #[test]
    fn ranks_take_turns_among_the_best_adapters() {
        use AdapterKind::*;
        let found = list(&[(Discrete, "vulkan"), (Discrete, "vulkan"), (Integrated, "vulkan"), (Software, "vulkan")]);
        let taken: Vec<usize> = (0..5).map(|rank| choose(&found, None, rank).unwrap()).collect();
        assert_eq!(taken, [0, 1, 0, 1, 0]);
        assert_eq!(choose(&found, Some(3), 1).unwrap(), 3);
        let twice = list(&[(Discrete, "dx12"), (Discrete, "vulkan")]);
        assert_eq!(choose(&twice, None, 1).unwrap(), 0);
    }

    #[test]
    fn a_missing_adapter_is_named() {
        let found = list(&[(AdapterKind::Software, "vulkan")]);
        let text = choose(&found, Some(4), 0).unwrap_err().to_string();
        assert!(text.contains('4') && text.contains('1'), "{text}");
        assert!(matches!(choose(&[], None, 0), Err(GpuError::NoAdapter)));
    }
}
