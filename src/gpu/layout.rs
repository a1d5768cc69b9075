//! Structs that Rust and WGSL share, and the check that both lay them out alike. The check compares names, offsets and
//! sizes, not field types.

use bytemuck::Pod;
use wgpu::naga;

/// Size of a struct and the offsets of its fields, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StructLayout {
    /// Name of the struct, the same in Rust and WGSL.
    pub name: &'static str,
    /// Size in bytes, padding included.
    pub size: usize,
    /// Name and offset of every field, in order.
    pub fields: &'static [(&'static str, usize)],
}

/// Plain data with the same layout in Rust and WGSL; made by `gpu_struct!`.
pub trait GpuStruct: Pod {
    /// The layout on the Rust side.
    const LAYOUT: StructLayout;
}

/// The parameters of a kernel that has none.
impl GpuStruct for () {
    const LAYOUT: StructLayout = StructLayout { name: "()", size: 0, fields: &[] };
}

/// Declares a plain-data struct that kernels share with Rust. WGSL declares it under the same name, with the same fields.
macro_rules! gpu_struct {
    ($(#[$meta:meta])* $vis:vis struct $name:ident { $($(#[$field_meta:meta])* $field_vis:vis $field:ident : $ty:ty),* $(,)? }) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, ::bytemuck::Pod, ::bytemuck::Zeroable)]
        #[repr(C)]
        $vis struct $name { $($(#[$field_meta])* $field_vis $field: $ty),* }

        impl $crate::gpu::GpuStruct for $name {
            const LAYOUT: $crate::gpu::StructLayout = $crate::gpu::StructLayout {
                name: stringify!($name),
                size: size_of::<$name>(),
                fields: &[$((stringify!($field), ::std::mem::offset_of!($name, $field))),*],
            };
        }
    };
}
pub(crate) use gpu_struct;

/// Compares `layout` with the struct of the same name in `module`. The error is a sentence without a full stop.
pub(super) fn check(module: &naga::Module, layout: &StructLayout) -> Result<(), String> {
    let found = module.types.iter().find_map(|(_, ty)| match &ty.inner {
        naga::TypeInner::Struct { members, span } if ty.name.as_deref() == Some(layout.name) => Some((members, *span)),
        _ => None,
    });
    let Some((members, span)) = found else {
        return Err(format!("struct {} is not declared in WGSL", layout.name));
    };
    let device: Vec<(&str, usize)> =
        members.iter().map(|m| (m.name.as_deref().unwrap_or("?"), m.offset as usize)).collect();
    if device != layout.fields {
        return Err(format!("struct {} has fields {:?} in Rust and {device:?} in WGSL", layout.name, layout.fields));
    }
    if span as usize != layout.size {
        return Err(format!("struct {} has {} bytes in Rust and {span} in WGSL", layout.name, layout.size));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    gpu_struct! {
        /// Three scalars and a vector.
        struct Shared { count: u32, first: u32, scale: f32, pad: u32, axis: [f32; 4] }
    }

    fn module(fields: &str) -> naga::Module {
        naga::front::wgsl::parse_str(&format!("struct Shared {{ {fields} }}")).unwrap()
    }

    #[test]
    fn equal_layouts_pass_and_others_are_named() {
        let good = module("count: u32, first: u32, scale: f32, pad: u32, axis: vec4<f32>");
        assert_eq!(check(&good, &Shared::LAYOUT), Ok(()));
        let swapped = module("first: u32, count: u32, scale: f32, pad: u32, axis: vec4<f32>");
        assert!(check(&swapped, &Shared::LAYOUT).unwrap_err().contains("has fields"));
        let moved = module("count: u32, first: u32, scale: f32, axis: vec4<f32>, pad: u32");
        assert!(check(&moved, &Shared::LAYOUT).is_err());
        assert!(check(&naga::Module::default(), &Shared::LAYOUT).unwrap_err().contains("not declared"));
    }
}
