//! Numbers of accessors [Khronos 2021, Sec. 3.6.2], checked against the bytes that are there.

use ::gltf::json::accessor::{Accessor, ComponentType, Type};
use ::gltf::json::validation::Checked;
use ::gltf::json::{Index, buffer::View};

use super::{Document, compression, entry};

/// What an accessor must hold.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Numbers {
    /// Floating-point numbers, or integers that are taken as they are or as fractions.
    Real,
    /// Integers.
    Whole,
}

impl Document {
    /// The numbers of an accessor whose elements have `width` of them, element by element.
    ///
    /// # Errors
    /// Half a sentence that names the accessor.
    pub(super) fn numbers(
        &self,
        index: &Index<Accessor>,
        width: usize,
        numbers: Numbers,
        of: &str,
    ) -> Result<Vec<f64>, String> {
        let accessor = entry(&self.root.accessors, index, "accessor", of)?;
        let named = |what: String| format!("accessor {index} ({of}) {what}");
        let (Checked::Valid(component), Checked::Valid(form)) = (&accessor.component_type, &accessor.type_) else {
            return Err(named("has a type that glTF does not know".into()));
        };
        let component = component.0;
        if numbers == Numbers::Whole && matches!(component, ComponentType::F32 | ComponentType::I8 | ComponentType::I16)
        {
            return Err(named("must hold whole numbers of at least 0".into()));
        }
        if width_of(*form) != width {
            return Err(named(format!("has {} numbers per element, not {width}", width_of(*form))));
        }
        let count = usize::try_from(accessor.count.0).map_err(|_| named("is too long".into()))?;
        let decode = Decode { component, fraction: accessor.normalized && numbers == Numbers::Real };
        let mut out = match &accessor.buffer_view {
            Some(view) => {
                let start = accessor.byte_offset.map_or(0, |offset| offset.0);
                self.elements(view, start, count, width, decode).map_err(named)?
            }
            None if accessor.sparse.is_some() => vec![0.0; self.bounded(count, width).map_err(named)?],
            None => return Err(named(format!("has no data{}", compression(&self.root)))),
        };
        if let Some(sparse) = &accessor.sparse {
            let changed = usize::try_from(sparse.count.0).map_err(|_| named("is too long".into()))?;
            let Checked::Valid(index_type) = &sparse.indices.component_type else {
                return Err(named("has sparse indices of an unknown type".into()));
            };
            let whole = Decode { component: index_type.0, fraction: false };
            let (places, values) = (&sparse.indices, &sparse.values);
            let places = self.elements(&places.buffer_view, places.byte_offset.0, changed, 1, whole).map_err(named)?;
            let values =
                self.elements(&values.buffer_view, values.byte_offset.0, changed, width, decode).map_err(named)?;
            for (&place, value) in places.iter().zip(values.chunks_exact(width)) {
                let at = place as usize * width;
                let element = out.get_mut(at..at + width);
                element.ok_or_else(|| named(format!("has no element {place}")))?.copy_from_slice(value);
            }
        }
        match out.iter().position(|x| !x.is_finite()) {
            Some(at) => Err(named(format!("is not a finite number at element {} (from 0)", at / width))),
            None => Ok(out),
        }
    }

    /// The length of a list that has no bytes of its own. The vertices of a mesh have bytes somewhere, so a list that
    /// is longer than all bytes is a mistake.
    fn bounded(&self, count: usize, width: usize) -> Result<usize, String> {
        let bytes: usize = self.buffers.iter().map(Vec::len).sum();
        if count > bytes {
            Err(format!("has {count} elements, more than the file has bytes"))
        } else {
            Ok(count * width)
        }
    }

    fn elements(
        &self,
        view: &Index<View>,
        start: u64,
        count: usize,
        width: usize,
        decode: Decode,
    ) -> Result<Vec<f64>, String> {
        let views = &self.root.buffer_views;
        let found = views.get(view.value());
        let bounds = found.ok_or_else(|| format!("names bufferView {view}, but there are only {}", views.len()))?;
        let buffer = self.buffers.get(bounds.buffer.value());
        let buffer = buffer.ok_or_else(|| format!("lies in buffer {}, which is not there", bounds.buffer))?;
        let (first, length) = (bounds.byte_offset.map_or(0, |offset| offset.0), bounds.byte_length.0);
        let end = first.checked_add(length).filter(|&end| end <= buffer.len() as u64);
        let end = end.ok_or_else(|| {
            format!("lies in bufferView {view}, which ends beyond the {} bytes of its buffer", buffer.len())
        })?;
        let bytes = &buffer[first as usize..end as usize];
        let size = decode.bytes() * width;
        let stride = bounds.byte_stride.map_or(size, |stride| stride.0);
        let last = (count as u64).checked_sub(1).map(|last| last.checked_mul(stride as u64));
        let needed = match last {
            None => Some(0),
            Some(last) => last.and_then(|last| last.checked_add(start)?.checked_add(size as u64)),
        };
        if needed.is_none_or(|needed| needed > length) {
            return Err(format!("ends beyond its bufferView {view}, which has {length} bytes"));
        }
        let mut out = Vec::with_capacity(count * width);
        for element in 0..count {
            let at = start as usize + element * stride;
            out.extend(bytes[at..at + size].chunks_exact(decode.bytes()).map(|one| decode.number(one)));
        }
        Ok(out)
    }
}

fn width_of(form: Type) -> usize {
    match form {
        Type::Scalar => 1,
        Type::Vec2 => 2,
        Type::Vec3 => 3,
        Type::Vec4 | Type::Mat2 => 4,
        Type::Mat3 => 9,
        Type::Mat4 => 16,
    }
}

/// How bytes become numbers.
#[derive(Clone, Copy)]
struct Decode {
    component: ComponentType,
    /// Integers are fractions of their largest value.
    fraction: bool,
}

impl Decode {
    fn bytes(self) -> usize {
        match self.component {
            ComponentType::I8 | ComponentType::U8 => 1,
            ComponentType::I16 | ComponentType::U16 => 2,
            ComponentType::U32 | ComponentType::F32 => 4,
        }
    }

    fn number(self, bytes: &[u8]) -> f64 {
        let mut word = [0; 4];
        word[..bytes.len()].copy_from_slice(bytes);
        let [a, b, ..] = word;
        let (value, largest) = match self.component {
            ComponentType::I8 => (f64::from(a as i8), f64::from(i8::MAX)),
            ComponentType::U8 => (f64::from(a), f64::from(u8::MAX)),
            ComponentType::I16 => (f64::from(i16::from_le_bytes([a, b])), f64::from(i16::MAX)),
            ComponentType::U16 => (f64::from(u16::from_le_bytes([a, b])), f64::from(u16::MAX)),
            ComponentType::U32 => (f64::from(u32::from_le_bytes(word)), f64::from(u32::MAX)),
            ComponentType::F32 => return f64::from(f32::from_le_bytes(word)),
        };
        if self.fraction { (value / largest).max(-1.0) } else { value }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_are_fractions_of_their_largest_value() {
        let number = |component, fraction, bytes: &[u8]| Decode { component, fraction }.number(bytes);
        assert_eq!(number(ComponentType::I8, true, &[0x80]), -1.0);
        assert_eq!(number(ComponentType::I8, false, &[0x80]), -128.0);
        assert_eq!(number(ComponentType::U8, true, &[51]), 0.2);
        assert_eq!(number(ComponentType::I16, true, &i16::MAX.to_le_bytes()), 1.0);
        assert_eq!(number(ComponentType::U16, true, &u16::MAX.to_le_bytes()), 1.0);
        assert_eq!(number(ComponentType::U32, false, &7_000_000u32.to_le_bytes()), 7e6);
        assert_eq!(number(ComponentType::F32, true, &0.25f32.to_le_bytes()), 0.25);
    }
}
