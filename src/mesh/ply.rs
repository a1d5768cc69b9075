//! PLY reader: vertices and faces of ascii, little-endian and big-endian files. Other elements and properties are
//! skipped.
//!
//! The header's counts are checked against the size of the file before memory is reserved. `ply-rs-bw` reads the header
//! and binary records. Ascii bodies are read here, because that crate refuses `.5` and `1.`.

use std::io::{BufRead, Read};

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};

use crate::math::{DVec3, Vec2};

use super::polygon::Faces;
use super::{ParseFault, Surface, VertexProperty, rounded};

/// Longest header that is accepted, bytes. Real headers have some hundred bytes.
const LONGEST_HEADER: u64 = 1 << 16;

/// Scalar properties of a vertex that have a meaning of their own.
const KNOWN: [&str; 9] = ["x", "y", "z", "u", "v", "s", "t", "texture_u", "texture_v"];

/// Reads a PLY file of `bytes` bytes. Texture coordinates come from the corners (face property `texcoord`) or from the
/// vertices (`u`/`v`, `s`/`t` or `texture_u`/`texture_v`), if present.
pub fn parse_ply(reader: impl BufRead, bytes: u64) -> Result<Surface, ParseFault> {
    parse_ply_far(reader, bytes, f64::INFINITY)
}

/// Like [`parse_ply`]. The surface of a file with coordinates beyond `far` is relative to a base.
pub(crate) fn parse_ply_far(mut reader: impl BufRead, bytes: u64, far: f64) -> Result<Surface, ParseFault> {
    let header_bytes = read_header_bytes(&mut reader)?;
    let header = read_header(&header_bytes)?;
    check_counts(&header, bytes.saturating_sub(header_bytes.len() as u64))?;
    let line = header_bytes.iter().filter(|&&c| c == b'\n').count() as u64;
    let mut body = Body { reader, line, words: Vec::new() };

    let mut surface = Surface::default();
    let mut positions = Vec::new();
    let (mut faces, mut corner_uv, mut strips) = (Faces::default(), Vec::new(), Vec::new());
    let (mut vertex_uv, mut corners_mapped) = (Vec::new(), true);
    for (name, element) in &header.elements {
        // An element without properties takes no bytes for any count.
        if element.properties.is_empty() {
            continue;
        }
        if name == "vertex" {
            surface.properties.clear();
            for (name, property) in &element.properties {
                if matches!(property.data_type, PropertyType::Scalar(_)) && !KNOWN.contains(&name.as_str()) {
                    surface.properties.push(VertexProperty { name: name.clone(), values: Vec::new() });
                }
            }
        }
        for i in 0..element.count {
            let record = body.record(header.encoding, element).map_err(|what| ParseFault {
                line: (header.encoding == Encoding::Ascii).then_some(body.line),
                what: format!("{name} {} of {}: {what}", i + 1, element.count),
            })?;
            match name.as_str() {
                "vertex" => {
                    let position =
                        record.position().map_err(|what| ParseFault::whole(format!("vertex {} {what}", i + 1)))?;
                    positions.push(position);
                    vertex_uv.extend(record.uv());
                    let others = surface.properties.iter_mut().zip(&record.others);
                    others.for_each(|(property, &value)| property.values.push(value as f32));
                }
                "face" => {
                    let fault = |what: String| ParseFault::whole(format!("face {} {what}", i + 1));
                    faces.corners.extend(record.corners().map_err(fault)?);
                    faces.close(0).map_err(ParseFault::whole)?;
                    corners_mapped &= record.texcoord.len() == 2 * record.indices.len();
                    if corners_mapped {
                        let pairs = record.texcoord.as_chunks::<2>().0;
                        corner_uv.extend(pairs.iter().map(|&[u, v]| Vec2::new(u as f32, v as f32)));
                    }
                }
                "tristrips" => add_strips(&record.indices, &mut strips)
                    .map_err(|what| ParseFault::whole(format!("triangle strip {} {what}", i + 1)))?,
                _ => {}
            }
        }
    }
    (surface.base, surface.positions) = rounded(&positions, far);
    if faces.len() == 0 && strips.is_empty() {
        return Err(ParseFault::whole("no face in it (a PLY mesh has the elements `vertex` and `face`)"));
    }
    if faces.len() == 0 {
        // Files of 3D scanners hold strips. In files with both, the strips repeat the faces.
        if let Some(index) = strips.iter().flatten().find(|&&v| v as usize >= surface.positions.len()) {
            let count = surface.positions.len();
            return Err(ParseFault::whole(format!(
                "a triangle strip has vertex index {index}, but the file has only {count}"
            )));
        }
        surface.triangles = strips;
    } else {
        let cut = faces.cut(&surface.positions)?;
        surface.triangles = cut.triangles.iter().map(|t| t.map(|corner| faces.corners[corner as usize])).collect();
        if corners_mapped {
            surface.texture_uv = cut.triangles.iter().map(|t| t.map(|corner| corner_uv[corner as usize])).collect();
        }
    }
    if surface.texture_uv.is_empty() && vertex_uv.len() == surface.positions.len() {
        surface.texture_uv = surface.triangles.iter().map(|t| t.map(|v| vertex_uv[v as usize])).collect();
    }
    Ok(surface)
}

/// Adds the triangles of strips, which end with the index -1. Every second triangle of a strip has the opposite
/// winding. Triangles with a repeated corner only connect parts of the strip and are skipped.
fn add_strips(indices: &[i64], triangles: &mut Vec<[u32; 3]>) -> Result<(), String> {
    for strip in indices.split(|&index| index == -1) {
        for (i, corners) in strip.windows(3).enumerate() {
            if let Some(index) = corners.iter().find(|&&index| index < 0 || index > i64::from(i32::MAX)) {
                return Err(format!("has the vertex index {index}"));
            }
            let [a, b, c] = [0, 1, 2].map(|corner| corners[corner] as u32);
            if a != b && b != c && c != a {
                triangles.push(if i % 2 == 0 { [a, b, c] } else { [b, a, c] });
            }
        }
    }
    Ok(())
}

/// The bytes up to and including the line `end_header`.
fn read_header_bytes(reader: &mut impl BufRead) -> Result<Vec<u8>, ParseFault> {
    let mut bytes = Vec::new();
    loop {
        let line_start = bytes.len();
        let room = LONGEST_HEADER.saturating_sub(line_start as u64);
        let read = reader.by_ref().take(room).read_until(b'\n', &mut bytes);
        let read = read.map_err(|e| ParseFault::whole(format!("cannot be read: {e}")))?;
        let line = bytes[line_start..].trim_ascii();
        if line_start == 0 && line != b"ply" {
            return Err(ParseFault::whole("a PLY file begins with the line `ply`"));
        }
        if line == b"end_header" {
            return Ok(bytes);
        }
        if read == 0 || bytes.last() != Some(&b'\n') {
            return Err(ParseFault::whole("the header has no line `end_header`; is the file cut off?"));
        }
    }
}

fn read_header(bytes: &[u8]) -> Result<Header, ParseFault> {
    // Comments can be in any encoding (author names in Latin-1), but the crate requires UTF-8.
    let is_comment =
        |line: &&[u8]| [&b"comment"[..], b"obj_info"].iter().any(|word| line.trim_ascii_start().starts_with(word));
    let kept: Vec<u8> =
        bytes.split_inclusive(|&c| c == b'\n').filter(|line| !is_comment(line)).flatten().copied().collect();
    Parser::<Record>::new().read_header(&mut Reader::new(&kept[..])).map_err(|error| {
        // The crate's message has several lines. The first names the line that it did not understand.
        let text = error.to_string();
        let number = text.strip_prefix("Line ").and_then(|rest| rest.split(':').next()?.parse::<usize>().ok());
        let line = number.and_then(|number| kept.split(|&c| c == b'\n').nth(number.checked_sub(1)?));
        match line.map(|line| String::from_utf8_lossy(line).trim().chars().take(60).collect::<String>()) {
            Some(line) => ParseFault::whole(format!("the header is not understood at its line `{line}`")),
            None => {
                ParseFault::whole(format!("the header is not understood: {}", text.lines().next().unwrap_or_default()))
            }
        }
    })
}

/// Refuses counts that do not fit in the `bytes` after the header.
fn check_counts(header: &Header, bytes: u64) -> Result<(), ParseFault> {
    for (name, element) in &header.elements {
        let least: u64 = element.properties.iter().map(|(_, p)| least_bytes(header.encoding, &p.data_type)).sum();
        if (element.count as u64).saturating_mul(least) > bytes.saturating_add(1) {
            return Err(ParseFault::whole(format!(
                "the header announces {} of element `{name}`, which need at least {} bytes, but only {bytes} follow it; is the file cut off?",
                element.count,
                (element.count as u64).saturating_mul(least)
            )));
        }
    }
    Ok(())
}

fn least_bytes(encoding: Encoding, kind: &PropertyType) -> u64 {
    let scalar = match kind {
        PropertyType::Scalar(scalar) => scalar,
        PropertyType::List(count, _) => count,
    };
    match (encoding, scalar) {
        (Encoding::Ascii, _) => 2, // a digit and a separator; the last one may lack the separator
        (_, ScalarType::Char | ScalarType::UChar) => 1,
        (_, ScalarType::Short | ScalarType::UShort) => 2,
        (_, ScalarType::Int | ScalarType::UInt | ScalarType::Float) => 4,
        (_, ScalarType::Double) => 8,
    }
}

/// One vertex or face.
#[derive(Default)]
struct Record {
    xyz: [Option<f64>; 3],
    uv: [Option<f64>; 2],
    /// Other numbers, in the order of the header.
    others: Vec<f64>,
    indices: Vec<i64>,
    texcoord: Vec<f64>,
}

impl Record {
    fn set(&mut self, name: &str, value: f64) {
        match name {
            "x" => self.xyz[0] = Some(value),
            "y" => self.xyz[1] = Some(value),
            "z" => self.xyz[2] = Some(value),
            "u" | "s" | "texture_u" => self.uv[0] = Some(value),
            "v" | "t" | "texture_v" => self.uv[1] = Some(value),
            _ => self.others.push(value),
        }
    }

    fn set_list(&mut self, name: &str, values: impl Iterator<Item = f64>) {
        match name {
            "vertex_indices" | "vertex_index" => self.indices = values.map(|v| v as i64).collect(),
            "texcoord" => self.texcoord = values.collect(),
            _ => {}
        }
    }

    fn position(&self) -> Result<DVec3, String> {
        let [Some(x), Some(y), Some(z)] = self.xyz else {
            return Err("has no x, y and z".into());
        };
        let position = DVec3::new(x, y, z);
        if position.as_vec3().is_finite() {
            Ok(position)
        } else {
            Err("has a coordinate that is not a finite number".into())
        }
    }

    fn uv(&self) -> Option<Vec2> {
        let [Some(u), Some(v)] = self.uv else { return None };
        Some(Vec2::new(u as f32, v as f32))
    }

    /// The vertices of the polygon.
    fn corners(&self) -> Result<impl Iterator<Item = u32> + use<'_>, String> {
        if self.indices.len() < 3 {
            return Err(format!("has {} corners where at least 3 are needed", self.indices.len()));
        }
        match self.indices.iter().find(|&&i| i < 0 || i > i64::from(i32::MAX)) {
            Some(index) => Err(format!("has the vertex index {index}")),
            None => Ok(self.indices.iter().map(|&index| index as u32)),
        }
    }
}

impl PropertyAccess for Record {
    fn new() -> Record {
        Record::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        match property {
            Property::Char(v) => self.set(name, v.into()),
            Property::UChar(v) => self.set(name, v.into()),
            Property::Short(v) => self.set(name, v.into()),
            Property::UShort(v) => self.set(name, v.into()),
            Property::Int(v) => self.set(name, v.into()),
            Property::UInt(v) => self.set(name, v.into()),
            Property::Float(v) => self.set(name, v.into()),
            Property::Double(v) => self.set(name, v),
            Property::ListChar(v) => self.set_list(name, v.into_iter().map(f64::from)),
            Property::ListUChar(v) => self.set_list(name, v.into_iter().map(f64::from)),
            Property::ListShort(v) => self.set_list(name, v.into_iter().map(f64::from)),
            Property::ListUShort(v) => self.set_list(name, v.into_iter().map(f64::from)),
            Property::ListInt(v) => self.set_list(name, v.into_iter().map(f64::from)),
            Property::ListUInt(v) => self.set_list(name, v.into_iter().map(f64::from)),
            Property::ListFloat(v) => self.set_list(name, v.into_iter().map(f64::from)),
            Property::ListDouble(v) => self.set_list(name, v.into_iter()),
        }
        PropertyAccessResult::Set
    }
}

/// Reads the records after the header.
struct Body<R> {
    reader: R,
    /// Number of the last line read, for ascii.
    line: u64,
    words: Vec<u8>,
}

impl<R: BufRead> Body<R> {
    fn record(&mut self, encoding: Encoding, element: &ElementDef) -> Result<Record, String> {
        let parser = Parser::<Record>::new();
        let result = match encoding {
            Encoding::Ascii => return self.ascii_record(element),
            Encoding::BinaryLittleEndian => parser.read_little_endian_element(&mut self.reader, element),
            Encoding::BinaryBigEndian => parser.read_big_endian_element(&mut self.reader, element),
        };
        result.map_err(|error| match error.kind() {
            std::io::ErrorKind::UnexpectedEof => "the file ends here; is it cut off?".into(),
            _ => error.to_string().lines().next().unwrap_or_default().to_owned(),
        })
    }

    /// Reads the next line that is not empty.
    fn ascii_record(&mut self, element: &ElementDef) -> Result<Record, String> {
        loop {
            self.words.clear();
            let read = self.reader.read_until(b'\n', &mut self.words).map_err(|e| format!("cannot be read: {e}"))?;
            if read == 0 {
                return Err("the file ends here; is it cut off?".into());
            }
            self.line += 1;
            if !self.words.trim_ascii().is_empty() {
                break;
            }
        }
        let mut words = self.words.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty()).map(|word| {
            let number = std::str::from_utf8(word).ok().and_then(|text| text.parse::<f64>().ok());
            number.ok_or_else(|| format!("`{}` is not a number", String::from_utf8_lossy(&word[..word.len().min(40)])))
        });
        let mut next = || words.next().unwrap_or_else(|| Err("the line has too few values".into()));
        let mut record = Record::new();
        for (name, property) in &element.properties {
            match property.data_type {
                PropertyType::Scalar(_) => record.set(name, next()?),
                PropertyType::List(..) => {
                    let count = next()?;
                    let mut values = Vec::new();
                    for _ in 0..count as u64 {
                        values.push(next()?);
                    }
                    record.set_list(name, values.into_iter());
                }
            }
        }
        Ok(record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n\
                          property list uchar int vertex_indices\nend_header\n";

    fn ascii(body: &str) -> Result<Surface, ParseFault> {
        let text = format!("ply\nformat ascii 1.0\n{HEADER}{body}");
        parse_ply(text.as_bytes(), text.len() as u64)
    }

    fn binary(format: &str, bytes_of: impl Fn(u32) -> [u8; 4], cut: usize) -> Result<Surface, ParseFault> {
        let mut bytes = format!("ply\r\nformat {format} 1.0\r\n{}", HEADER.replace('\n', "\r\n")).into_bytes();
        for value in [0.0f32, 0., 0., 1., 0., 0., 1., 1., 0., 0., 1., 0.] {
            bytes.extend(bytes_of(value.to_bits()));
        }
        bytes.push(4);
        (0..4).for_each(|i| bytes.extend(bytes_of(i)));
        bytes.truncate(bytes.len() - cut);
        parse_ply(bytes.as_slice(), bytes.len() as u64)
    }

    #[test]
    fn the_three_encodings_agree() {
        let expected = ascii("0 0 0\n1. 0 0\n1 1 0\n\n0 1e0 .0\n4 0 1 2 3").unwrap();
        assert_eq!(expected.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(binary("binary_little_endian", u32::to_le_bytes, 0).unwrap(), expected);
        assert_eq!(binary("binary_big_endian", u32::to_be_bytes, 0).unwrap(), expected);
    }

    #[test]
    fn faults_are_sentences() {
        let fault = |body: &str| ascii(body).unwrap_err();
        let vertices = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n";
        let short = fault("0 0 0\n1 0\n0 0 0\n0 0 0\n3 0 1 2");
        assert_eq!((short.line, short.what.as_str()), (Some(11), "vertex 2 of 4: the line has too few values"));
        assert_eq!(fault(&format!("{vertices}3 0 1 4")).what, "face 1: vertex index 4, but the file has only 4");
        assert_eq!(fault(&format!("{vertices}2 0 1")).what, "face 1 has 2 corners where at least 3 are needed");
        assert_eq!(fault(&format!("{vertices}3 0 1 -1")).what, "face 1 has the vertex index -1");
        assert_eq!(
            fault(&format!("0 0 nan\n{}3 0 1 2", &vertices[6..])).what,
            "vertex 1 has a coordinate that is not a finite number"
        );
        let cut = binary("binary_little_endian", u32::to_le_bytes, 3).unwrap_err();
        assert_eq!(cut.what, "face 1 of 1: the file ends here; is it cut off?");
        assert_eq!(parse_ply(&b"plx"[..], 3).unwrap_err().what, "a PLY file begins with the line `ply`");
    }

    #[test]
    fn a_header_without_an_end_is_refused_wherever_it_ends() {
        let text = format!("ply\nformat ascii 1.0\n{HEADER}");
        let end = text.find("end_header").unwrap();
        for length in 0..end + "end_header".len() {
            // The file is cut at every byte, with and without a line break added.
            for text in [text[..length].to_owned(), format!("{}\n", &text[..length])] {
                if length < end + "end_header".len() || text.ends_with('\n') {
                    assert!(parse_ply(text.as_bytes(), text.len() as u64).is_err(), "{text:?}");
                }
            }
        }
        let long = format!("ply\n{}", "comment no end\n".repeat(6_000));
        assert!(parse_ply(long.as_bytes(), long.len() as u64).unwrap_err().what.contains("end_header"));
    }

    #[test]
    fn comments_in_latin_1_faces_first_and_strips() {
        let bytes = b"ply\nformat ascii 1.0\ncomment Cr\xe9\xe9\nelement face 1\nproperty list uchar int vertex_index\nelement vertex 4\n\
            property float x\nproperty float y\nproperty float z\nobj_info \xff\nend_header\n4 0 1 2 3\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n";
        assert_eq!(parse_ply(&bytes[..], bytes.len() as u64).unwrap().triangles, [[0, 1, 2], [0, 2, 3]]);
        let strip = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement tristrips 1\n\
            property list int int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n8 0 1 2 3 -1 1 3 2\n";
        assert_eq!(
            parse_ply(strip.as_bytes(), strip.len() as u64).unwrap().triangles,
            [[0, 1, 2], [2, 1, 3], [1, 3, 2]]
        );
        let beyond = strip.replace("1 3 2\n", "1 3 4\n");
        assert!(
            parse_ply(beyond.as_bytes(), beyond.len() as u64)
                .unwrap_err()
                .what
                .ends_with("index 4, but the file has only 4")
        );
    }

    #[test]
    fn a_count_beyond_the_file_is_refused_before_reading() {
        let text = format!("ply\nformat ascii 1.0\n{}", HEADER.replace("vertex 4", "vertex 4000000000"));
        let fault = parse_ply(text.as_bytes(), text.len() as u64).unwrap_err();
        assert!(fault.what.starts_with("the header announces 4000000000 of element `vertex`"), "{fault}");
    }
}
