//! Kernels: WGSL text, and what naga finds in it. Bindings, workgroup size and struct layouts are
//! read from the shader, never repeated in Rust.

use wgpu::naga;
use wgpu::naga::valid::{Capabilities, ValidationFlags, Validator};

use super::layout::{self, GpuStruct, StructLayout};

/// Text in front of every kernel.
pub(super) const PRELUDE: &str = include_str!("prelude.wgsl");
/// One entry point of a WGSL file. Make it a `static`: an executor compiles each one once.
pub struct KernelSource {
    pub(super) name: &'static str,
    text: &'static str,
    pub(super) entry: &'static str,
    libraries: &'static [&'static str],
    pub(super) params: &'static StructLayout,
    structs: &'static [StructLayout],
}

impl KernelSource {
    /// The kernel `entry` of the file `name` with contents `text`, which takes parameters `P` (`()` for none).
    pub const fn new<P: GpuStruct>(name: &'static str, text: &'static str, entry: &'static str) -> KernelSource {
        KernelSource { name, text, entry, libraries: &[], params: const { &P::LAYOUT }, structs: &[] }
    }

    /// With the contents of further files in front, in this order. The kernel's file names each one in a line
    /// `// needs FILE` (path from its own folder), so that it can be checked by itself.
    pub const fn with_libraries(self, libraries: &'static [&'static str]) -> KernelSource {
        KernelSource { libraries, ..self }
    }

    /// With structs, other than the parameters, whose layout must be the same in Rust and WGSL.
    pub const fn with_structs(self, structs: &'static [StructLayout]) -> KernelSource {
        KernelSource { structs, ..self }
    }

    /// All text of the kernel.
    pub(super) fn assembled(&self) -> String {
        let parts: Vec<&str> = [PRELUDE].into_iter().chain(self.libraries.iter().copied()).chain([self.text]).collect();
        parts.join("\n")
    }

    /// Parses, validates and reflects the kernel; needs no adapter.
    pub fn check(&self) -> Result<Reflection, KernelError> {
        let fail = |reason| KernelError { kernel: format!("{}:{}", self.name, self.entry), reason };
        let (module, info) = validate(&self.assembled(), self.text).map_err(fail)?;
        let reflection = reflect(&module, &info, self.entry).map_err(fail)?;
        let uniform_bytes = reflection.uniform.as_ref().map_or(0, |u| u.size);
        if self.params.size as u64 != uniform_bytes {
            return Err(fail(format!("takes {uniform_bytes} bytes of parameters, Rust passes {}", self.params.size)));
        }
        let params = (self.params.size > 0).then_some(self.params);
        for layout in params.into_iter().chain(self.structs) {
            layout::check(&module, layout).map_err(fail)?;
        }
        Ok(reflection)
    }
}

/// A kernel that cannot be used, and why.
#[derive(Debug, thiserror::Error)]
#[error("kernel {kernel} is invalid: {reason}")]
pub struct KernelError {
    /// File and entry point.
    pub(super) kernel: String,
    pub(super) reason: String,
}

/// An array that a kernel sees.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ArraySlot {
    /// Name in the shader.
    pub name: String,
    /// Binding number in group 0.
    pub binding: u32,
    /// True if the shader may write it.
    pub writable: bool,
    /// Bytes from one item to the next.
    pub stride: u64,
}

/// The parameters that a kernel takes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UniformSlot {
    /// Binding number in group 0.
    pub binding: u32,
    /// Size of the struct, bytes.
    pub size: u64,
}

/// Bindings and workgroup size of a kernel, read from its text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reflection {
    /// Arrays by ascending binding number.
    pub arrays: Vec<ArraySlot>,
    /// Parameters, if there are any.
    pub uniform: Option<UniformSlot>,
    /// Invocations per workgroup, from the shader's `@workgroup_size`.
    pub workgroup: u32,
}

/// Parses and validates WGSL that uses nothing beyond the portable language. `own` is the last part of `all`; the error
/// counts lines from its start.
pub(super) fn validate(all: &str, own: &str) -> Result<(naga::Module, naga::valid::ModuleInfo), String> {
    let front = all.lines().count() - own.lines().count();
    let at = |location: Option<naga::SourceLocation>| match location.map(|l| l.line_number as usize) {
        Some(line) if line > front => format!("line {}: ", line - front),
        Some(line) => format!("line {line} of the text in front of it: "),
        None => String::new(),
    };
    let module = naga::front::wgsl::parse_str(all).map_err(|e| format!("{}{}", at(e.location(all)), e.message()))?;
    let checked = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module);
    let info = checked.map_err(|e| {
        // The outer error only names the function; what is wrong with it is the innermost one.
        let mut inner: &dyn std::error::Error = e.as_inner();
        let mut text = inner.to_string();
        while let Some(source) = inner.source() {
            inner = source;
            text = format!("{text}: {inner}");
        }
        format!("{}{text}", at(e.location(all)))
    })?;
    Ok((module, info))
}

fn reflect(module: &naga::Module, info: &naga::valid::ModuleInfo, entry: &str) -> Result<Reflection, String> {
    let Some(index) = module.entry_points.iter().position(|e| e.name == entry && e.stage == naga::ShaderStage::Compute)
    else {
        return Err("no compute entry point of this name".to_string());
    };
    let used = info.get_entry_point(index);
    let size = module.entry_points[index].workgroup_size;
    let mut reflection = Reflection { arrays: Vec::new(), uniform: None, workgroup: size[0] };
    if size[1] != 1 || size[2] != 1 {
        return Err(format!("workgroups must be one-dimensional, not {size:?}"));
    }
    for (handle, variable) in module.global_variables.iter() {
        let (Some(place), false) = (&variable.binding, used[handle].is_empty()) else { continue };
        let name = variable.name.clone().unwrap_or_default();
        if place.group != 0 {
            return Err(format!("{name} is in group {}, only group 0 is used", place.group));
        }
        let inner = &module.types[variable.ty].inner;
        match (variable.space, inner) {
            (naga::AddressSpace::Storage { access }, naga::TypeInner::Array { stride, .. }) => {
                let writable = access.contains(naga::StorageAccess::STORE);
                reflection.arrays.push(ArraySlot {
                    name,
                    binding: place.binding,
                    writable,
                    stride: u64::from(*stride),
                });
            }
            (naga::AddressSpace::Uniform, naga::TypeInner::Struct { span, .. }) => {
                let slot = UniformSlot { binding: place.binding, size: u64::from(*span) };
                if reflection.uniform.replace(slot).is_some() {
                    return Err("more than one uniform".to_string());
                }
            }
            _ => return Err(format!("{name} is neither a storage array nor a uniform struct")),
        }
    }
    reflection.arrays.sort_by_key(|slot| slot.binding);
    Ok(reflection)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::layout::gpu_struct;
    use std::path::{Path, PathBuf};

    gpu_struct! {
        struct Params { count: u32, factor: f32 }
    }

    const SAMPLE: &str = "
        struct Params { count: u32, factor: f32 }
        @group(0) @binding(3) var<uniform> params: Params;
        @group(0) @binding(1) var<storage, read_write> out: array<f32>;
        @group(0) @binding(0) var<storage, read> values: array<Packed3>;
        @group(0) @binding(2) var<storage, read> unused: array<u32>;
        @compute @workgroup_size(WORKGROUP)
        fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
            let i = global_index(id, groups);
            if (i < params.count) { out[i] = values[i].x * params.factor; }
        }";

    #[test]
    fn bindings_and_sizes_come_from_the_text() {
        let source = KernelSource::new::<Params>("sample.wgsl", SAMPLE, "main");
        let found = source.check().unwrap();
        let slot = |name: &str, binding, writable, stride| ArraySlot { name: name.into(), binding, writable, stride };
        assert_eq!(found.arrays, [slot("values", 0, false, 12), slot("out", 1, true, 4)]);
        assert_eq!(found.uniform, Some(UniformSlot { binding: 3, size: 8 }));
        assert_eq!(found.workgroup, 128);
    }

    #[test]
    fn mistakes_are_named() {
        let error = |source: KernelSource| source.check().unwrap_err().to_string();
        assert!(error(KernelSource::new::<Params>("s.wgsl", SAMPLE, "other")).contains("no compute entry point"));
        assert!(error(KernelSource::new::<()>("s.wgsl", SAMPLE, "main")).contains("8 bytes of parameters"));
        assert!(
            error(KernelSource::new::<()>("s.wgsl", "\nfn broken( {", "main"))
                .contains("s.wgsl:main is invalid: line 2: ")
        );
        let bad = "@compute @workgroup_size(1) fn main() {\n let x: u32 = 1.5; }";
        assert!(error(KernelSource::new::<()>("s.wgsl", bad, "main")).contains("line 2: "));
    }

    /// Files ending in `.wgsl` under `folder`.
    fn shaders(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                shaders(&path, found);
            } else if path.extension().is_some_and(|e| e == "wgsl") {
                found.push(path);
            }
        }
    }

    #[test]
    fn every_shader_of_the_package_is_valid() {
        let mut found = Vec::new();
        shaders(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut found);
        assert!(found.iter().any(|p| p.ends_with("gpu/prelude.wgsl")));
        for path in found.iter().filter(|p| !p.ends_with("gpu/prelude.wgsl")) {
            let text = std::fs::read_to_string(path).unwrap();
            let mut parts = vec![PRELUDE.to_string()];
            for needed in text.lines().filter_map(|line| line.strip_prefix("// needs ")) {
                parts.push(std::fs::read_to_string(path.with_file_name(needed.trim())).unwrap());
            }
            parts.push(text.clone());
            if let Err(reason) = validate(&parts.join("\n"), &text) {
                panic!("{}: {reason}", path.display());
            }
        }
    }
}
