//! Binary PLY frames: a writer, and a reader for files with the writer's layout.

use std::io::{self, Write};

use super::frame_mesh::{FrameMesh, ReadError};
use crate::math::Vec3;

/// Bytes of a face: one byte (3) and three 32-bit indices.
const FACE_BYTES: usize = 13;
/// Faces that are packed before a write.
const FACES_PER_CHUNK: usize = 1 << 14;

/// Writes a mesh: float x, y, z; uchar count + int indices, little-endian. `buffer` is scratch memory.
pub fn write(out: &mut dyn Write, buffer: &mut Vec<u8>, positions: &[Vec3], triangles: &[[u32; 3]]) -> io::Result<()> {
    let too_many = |_| io::Error::new(io::ErrorKind::InvalidInput, "PLY indices end at 2147483647 vertices");
    i32::try_from(positions.len()).map_err(too_many)?;
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\ncomment loomtree, metres\nelement vertex {}\nproperty float x\n\
         property float y\nproperty float z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n",
        positions.len(),
        triangles.len()
    )?;
    write_words(out, buffer, bytemuck::cast_slice(positions))?;
    for chunk in triangles.chunks(FACES_PER_CHUNK) {
        buffer.clear();
        buffer.resize(chunk.len() * FACE_BYTES, 3);
        for (face, triangle) in buffer.chunks_exact_mut(FACE_BYTES).zip(chunk) {
            for corner in 0..3 {
                face[1 + 4 * corner..5 + 4 * corner].copy_from_slice(&triangle[corner].to_le_bytes());
            }
        }
        out.write_all(buffer)?;
    }
    Ok(())
}

/// Writes f32 values as little-endian bytes.
pub(super) fn write_words(out: &mut dyn Write, buffer: &mut Vec<u8>, values: &[f32]) -> io::Result<()> {
    if cfg!(target_endian = "little") {
        return out.write_all(bytemuck::cast_slice(values));
    }
    for chunk in values.chunks(1 << 14) {
        buffer.clear();
        chunk.iter().for_each(|x| buffer.extend_from_slice(&x.to_le_bytes()));
        out.write_all(buffer)?;
    }
    Ok(())
}

/// Decodes positions from little-endian bytes; the length must be a multiple of 12.
pub(super) fn positions_from_bytes(bytes: &[u8]) -> Vec<Vec3> {
    let word = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    bytes.chunks_exact(12).map(|p| Vec3::new(word(&p[0..4]), word(&p[4..8]), word(&p[8..12]))).collect()
}

const PROPERTIES: &str = "float x,float y,float z;list uchar int vertex_indices";

/// Reads a mesh written by [`write()`].
pub fn read(bytes: &[u8]) -> Result<FrameMesh, ReadError> {
    const END: &[u8] = b"end_header\n";
    // The header is short. The limit saves time on files of another kind.
    let limit = bytes.len().min(4096);
    let end = bytes[..limit]
        .windows(END.len())
        .position(|w| w == END)
        .ok_or(ReadError::Header("it has no PLY header that ends within 4096 bytes"))?;
    let header = std::str::from_utf8(&bytes[..end]).map_err(|_| ReadError::Header("its header is not text"))?;
    let body = &bytes[end + END.len()..];
    let mut lines = header.lines();
    if lines.next() != Some("ply") || lines.next() != Some("format binary_little_endian 1.0") {
        return Err(ReadError::Header("it does not begin with `ply` and `format binary_little_endian 1.0`"));
    }
    let (mut counts, mut properties) = (Vec::new(), String::new());
    for line in lines {
        if let Some(element) = line.strip_prefix("element ") {
            let name = if counts.is_empty() { "vertex " } else { "face " };
            let count = element.strip_prefix(name).and_then(|n| n.trim().parse::<usize>().ok());
            counts.push(count.ok_or(ReadError::Header("its elements are not `vertex N` and `face N`"))?);
            properties.push(';');
        } else if let Some(property) = line.strip_prefix("property ") {
            properties.push_str(property.trim());
            properties.push(',');
        }
    }
    let layout = properties.replace(",;", ";");
    let (&[vertices, faces], PROPERTIES) = (&counts[..], layout.trim_matches([';', ','])) else {
        return Err(ReadError::Header("its properties are not float x, y, z and list uchar int vertex_indices"));
    };
    let truncated = ReadError::Truncated { vertices, triangles: faces };
    let split = vertices.checked_mul(12).filter(|bytes| *bytes <= body.len());
    let needed = split.and_then(|v| faces.checked_mul(FACE_BYTES)?.checked_add(v));
    let (Some(split), Some(needed)) = (split, needed) else { return Err(truncated) };
    if needed > body.len() {
        return Err(truncated);
    }
    let positions = positions_from_bytes(&body[..split]);
    let mut triangles = Vec::with_capacity(faces);
    for face in body[split..needed].chunks_exact(FACE_BYTES) {
        if face[0] != 3 {
            return Err(ReadError::Header("it has a face that is no triangle"));
        }
        triangles.push(std::array::from_fn(|c| {
            u32::from_le_bytes([face[1 + 4 * c], face[2 + 4 * c], face[3 + 4 * c], face[4 + 4 * c]])
        }));
    }
    FrameMesh { positions, triangles }.checked()
}
