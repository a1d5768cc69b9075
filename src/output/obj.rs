//! OBJ frames: a fast writer and a reader for its files. `mesh` reads OBJ files from other programs.

use std::io::{self, Write};

use super::frame_mesh::{FrameMesh, ReadError};
use crate::math::{DVec3, Vec2, Vec3};
use crate::mesh::Part;

/// Size at which the buffer is written out, bytes.
const CHUNK: usize = 1 << 16;

/// The `vt` lines of a mesh. Each distinct coordinate of a vertex occurs once.
pub struct TextureCoordinates {
    coordinates: Vec<Vec2>,
    /// Index into `coordinates` of every triangle corner.
    corners: Vec<[u32; 3]>,
}

const NONE: u32 = u32::MAX;

impl TextureCoordinates {
    /// Merges per-corner coordinates. A vertex on a seam keeps several. An empty `uv` gives no coordinates.
    pub fn new(vertices: usize, triangles: &[[u32; 3]], uv: &[[Vec2; 3]]) -> TextureCoordinates {
        let mut coordinates: Vec<Vec2> = Vec::new();
        // The coordinates of a vertex form a linked list: first[vertex], then next[coordinate].
        let (mut first, mut next) = (vec![NONE; vertices], Vec::new());
        let mut index_of = |vertex: u32, uv: Vec2| {
            let mut candidate = first[vertex as usize];
            while candidate != NONE {
                if coordinates[candidate as usize] == uv {
                    return candidate;
                }
                candidate = next[candidate as usize];
            }
            let index = coordinates.len() as u32;
            coordinates.push(uv);
            next.push(std::mem::replace(&mut first[vertex as usize], index));
            index
        };
        let corners = triangles
            .iter()
            .zip(uv)
            .map(|(triangle, uv)| std::array::from_fn(|c| index_of(triangle[c], uv[c])))
            .collect();
        TextureCoordinates { coordinates, corners }
    }
}

/// Writes a mesh; `parts` ascend by their triangles. Positions are relative to `origin_m`. Numbers have the fewest
/// digits that read back to the same f32, or to the same f64 if `origin_m` is not zero. `buffer` is scratch memory that
/// the caller reuses.
pub fn write(
    out: &mut dyn Write,
    buffer: &mut Vec<u8>,
    origin_m: DVec3,
    positions: &[Vec3],
    triangles: &[[u32; 3]],
    texture: Option<&TextureCoordinates>,
    parts: &[Part],
) -> io::Result<()> {
    buffer.clear();
    for p in positions {
        buffer.push(b'v');
        match origin_m == DVec3::ZERO {
            true => p.to_array().into_iter().for_each(|x| push_number(buffer, &x)),
            false => (p.as_dvec3() + origin_m).to_array().into_iter().for_each(|x| push_number(buffer, &x)),
        }
        buffer.push(b'\n');
        flush_full(out, buffer)?;
    }
    let texture = texture.filter(|t| t.corners.len() == triangles.len() && !t.coordinates.is_empty());
    for uv in texture.iter().flat_map(|t| &t.coordinates) {
        buffer.extend_from_slice(b"vt");
        uv.to_array().into_iter().for_each(|x| push_number(buffer, &x));
        buffer.push(b'\n');
        flush_full(out, buffer)?;
    }
    let mut parts = parts.iter().peekable();
    let (mut object, mut group) = ("", "");
    for (t, triangle) in triangles.iter().enumerate() {
        while parts.next_if(|part| part.triangles.end as usize <= t).is_some() {}
        // Triangles outside all parts are put in an object and a group without a name.
        let here = parts.peek().filter(|part| part.triangles.start as usize <= t);
        let wanted = here.map_or(("", ""), |part| (&part.object[..], &part.group[..]));
        if wanted.0 != object {
            (object, group) = (wanted.0, "");
            push_name(buffer, b"o", object);
        }
        if wanted.1 != group {
            group = wanted.1;
            push_name(buffer, b"g", group);
        }
        buffer.push(b'f');
        for corner in 0..3 {
            buffer.push(b' ');
            push_index(buffer, triangle[corner]);
            if let Some(texture) = texture {
                buffer.push(b'/');
                push_index(buffer, texture.corners[t][corner]);
            }
        }
        buffer.push(b'\n');
        flush_full(out, buffer)?;
    }
    out.write_all(buffer)?;
    buffer.clear();
    Ok(())
}

/// Appends a line `o name` or `g name`.
fn push_name(buffer: &mut Vec<u8>, word: &[u8], name: &str) {
    buffer.extend_from_slice(word);
    if !name.is_empty() {
        buffer.push(b' ');
        buffer.extend_from_slice(name.as_bytes());
    }
    buffer.push(b'\n');
}

fn flush_full(out: &mut dyn Write, buffer: &mut Vec<u8>) -> io::Result<()> {
    if buffer.len() >= CHUNK {
        out.write_all(buffer)?;
        buffer.clear();
    }
    Ok(())
}

/// Appends a space and the number. OBJ accepts JSON's notation of numbers, and serde_json writes it faster than std.
fn push_number(buffer: &mut Vec<u8>, x: &impl serde::Serialize) {
    buffer.push(b' ');
    // Writing to a Vec cannot fail.
    let _ = serde_json::to_writer(&mut *buffer, x);
    if buffer.ends_with(b".0") {
        buffer.truncate(buffer.len() - 2);
    }
}

/// Appends the index, counted from 1, in decimal. std's formatting takes three times as long, and frames have millions
/// of indices.
fn push_index(buffer: &mut Vec<u8>, index: u32) {
    let mut number = u64::from(index) + 1;
    let mut digits = [0u8; 10];
    let mut start = digits.len();
    loop {
        start -= 1;
        digits[start] = b'0' + (number % 10) as u8;
        number /= 10;
        if number == 0 {
            break;
        }
    }
    buffer.extend_from_slice(&digits[start..]);
}

/// Reads a triangle mesh written by [`write()`], relative to `origin_m`. Texture coordinates are skipped.
pub fn read(bytes: &[u8], origin_m: DVec3) -> Result<FrameMesh, ReadError> {
    let mut mesh = FrameMesh::default();
    for (number, line) in bytes.split(|b| *b == b'\n').enumerate() {
        let at = |problem: &'static str| ReadError::Line { line: number + 1, problem };
        let Ok(line) = std::str::from_utf8(line) else { return Err(at("is not text")) };
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("v") => {
                let mut p = [0.0f64; 3];
                for x in &mut p {
                    let word = words.next().ok_or(at("has fewer than 3 coordinates"))?;
                    *x = word.parse().map_err(|_| at("has a coordinate that is no number"))?;
                }
                mesh.positions.push((DVec3::from_array(p) - origin_m).as_vec3());
            }
            Some("f") => {
                let mut triangle = [0u32; 3];
                for index in &mut triangle {
                    let word = words.next().ok_or(at("has fewer than 3 corners"))?;
                    let digits = word.split('/').next().unwrap_or(word);
                    let number: u32 = digits.parse().map_err(|_| at("has a corner that is no vertex number"))?;
                    *index = number.checked_sub(1).ok_or(at("has vertex number 0 (they count from 1)"))?;
                }
                if words.next().is_some() {
                    return Err(at("has more than 3 corners"));
                }
                mesh.triangles.push(triangle);
            }
            _ => {}
        }
    }
    mesh.checked()
}
