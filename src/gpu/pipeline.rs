//! A kernel as the driver has it: pipeline and bind group layout, compiled once per device.

use super::kernel::{ArraySlot, KernelError, KernelSource, Reflection, UniformSlot};
use super::layout::StructLayout;

/// Workgroups that a dispatch may have in one direction, on every adapter.
const MAX_GROUPS: u64 = 65_535;

/// A kernel compiled for one device.
pub(super) struct Kernel {
    pub(super) name: &'static str,
    pub(super) id: u64,
    pub(super) pipeline: wgpu::ComputePipeline,
    pub(super) layout: wgpu::BindGroupLayout,
    pub(super) arrays: Vec<ArraySlot>,
    pub(super) uniform: Option<UniformSlot>,
    pub(super) params: &'static StructLayout,
    /// Invocations per workgroup, to convert invocations to workgroups.
    pub(super) workgroup: u32,
}

impl Kernel {
    /// Compiles `source`; `id` is a number that no other array or kernel of the device has. What the driver refuses
    /// becomes a fault of the device instead.
    ///
    /// # Errors
    /// The text is not a valid kernel, or needs more than the adapter has.
    pub(super) fn new(
        device: &wgpu::Device,
        limits: &wgpu::Limits,
        id: u64,
        source: &'static KernelSource,
    ) -> Result<Kernel, KernelError> {
        let Reflection { arrays, uniform, workgroup } = source.check()?;
        if arrays.len() > limits.max_storage_buffers_per_shader_stage as usize
            || workgroup > limits.max_compute_invocations_per_workgroup
        {
            let reason =
                format!("needs {} arrays and workgroups of {workgroup}, more than the adapter has", arrays.len());
            return Err(KernelError { kernel: format!("{}:{}", source.name, source.entry), reason });
        }
        let entry = |binding, ty, has_dynamic_offset| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset, min_binding_size: None },
            count: None,
        };
        let mut entries: Vec<wgpu::BindGroupLayoutEntry> = arrays
            .iter()
            .map(|slot| entry(slot.binding, wgpu::BufferBindingType::Storage { read_only: !slot.writable }, false))
            .collect();
        entries.extend(uniform.iter().map(|slot| entry(slot.binding, wgpu::BufferBindingType::Uniform, true)));
        let label = Some(source.entry);
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label, entries: &entries });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label,
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label,
            source: wgpu::ShaderSource::Wgsl(source.assembled().into()),
        });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label,
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some(source.entry),
            // Every kernel writes its workgroup memory before it reads it.
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        Ok(Kernel { name: source.entry, id, pipeline, layout, arrays, uniform, params: source.params, workgroup })
    }
}

/// `groups` workgroups as x * y, each at most 65,535, with few left over.
pub(super) fn spread(groups: u64) -> [u32; 2] {
    let y = groups.div_ceil(MAX_GROUPS);
    assert!(y <= MAX_GROUPS, "{groups} workgroups in one dispatch");
    [groups.div_ceil(y) as u32, y as u32]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dispatches_spread_over_two_directions() {
        assert_eq!(spread(1), [1, 1]);
        assert_eq!(spread(65_535), [65_535, 1]);
        assert_eq!(spread(65_536), [32_768, 2]);
        let [x, y] = spread(1 << 26);
        assert!(u64::from(x) * u64::from(y) >= 1 << 26 && u64::from(x) <= MAX_GROUPS);
    }
}
