//! OBJ reader: `v`, `vt` and `f` lines; everything else (normals, groups, materials, ARCSim's `e`, `nv`, ..) is skipped.
//!
//! Written here and not taken from `tobj`: that crate renumbers vertices by first use (pins and results name vertices by
//! their number in the file), fills a missing texture index with the previous one, and reports no line.

use std::io::BufRead;

use crate::math::{Vec2, Vec3};

use super::{ParseFault, Surface};

/// Indices are kept in 31 bits, see `validate`.
const MOST_VERTICES: usize = i32::MAX as usize;

/// Reads the text of an OBJ file. Polygons become fans; texture coordinates are kept if every corner has one.
///
/// Index ranges and numbers are checked line by line; whether the result is a cloth is for `Surface::into_mesh`.
pub fn parse_obj(mut reader: impl BufRead) -> Result<Surface, ParseFault> {
    let mut obj = Obj { every_corner_has_texture: true, ..Obj::default() };
    let mut line = Vec::new();
    let mut number = 0;
    loop {
        let first = number + 1;
        line.clear();
        loop {
            let read = reader
                .read_until(b'\n', &mut line)
                .map_err(|e| ParseFault::at(first, format!("cannot be read: {e}")))?;
            number += u64::from(read > 0);
            while line.last().is_some_and(|c| matches!(c, b'\n' | b'\r')) {
                line.pop();
            }
            // A backslash joins the next line.
            if read == 0 || line.last() != Some(&b'\\') {
                break;
            }
            line.pop();
            line.push(b' ');
        }
        if number < first {
            break;
        }
        let text = if first == 1 { line.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&line) } else { &line };
        obj.line(text).map_err(|what| ParseFault::at(first, what))?;
    }
    obj.finish()
}

/// A corner of the face being read: vertex and texture index, counting from 0.
type Corner = (u32, Option<u32>);

#[derive(Default)]
struct Obj {
    positions: Vec<Vec3>,
    texture: Vec<Vec2>,
    triangles: Vec<[u32; 3]>,
    /// Texture index of every corner; given up with the first corner that has none.
    texture_triangles: Vec<[u32; 3]>,
    every_corner_has_texture: bool,
    face: Vec<Corner>,
}

impl Obj {
    fn line(&mut self, line: &[u8]) -> Result<(), String> {
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        match words.next() {
            Some(b"v") => {
                let [x, y, z] = numbers(&mut words, "a vertex line has three coordinates (`v x y z`)")?;
                if self.positions.len() >= MOST_VERTICES {
                    return Err(format!("more than {MOST_VERTICES} vertices"));
                }
                self.positions.push(Vec3::new(x, y, z));
            }
            Some(b"vt") => {
                let [u, v] = numbers(&mut words, "a texture line has two coordinates (`vt u v`)")?;
                self.texture.push(Vec2::new(u, v));
            }
            Some(b"f") => self.face(words)?,
            _ => {}
        }
        Ok(())
    }

    fn face<'a>(&mut self, words: impl Iterator<Item = &'a [u8]>) -> Result<(), String> {
        self.face.clear();
        for word in words {
            if word[0] == b'#' {
                break;
            }
            let mut parts = word.split(|&c| c == b'/');
            let vertex = index(parts.next().unwrap_or_default(), self.positions.len(), "vertex")?;
            let texture = match parts.next() {
                None | Some(b"") => None,
                Some(part) => Some(index(part, self.texture.len(), "texture coordinate")?),
            };
            self.face.push((vertex, texture));
        }
        if self.face.len() < 3 {
            return Err(format!(
                "the face has {} corners where at least 3 are needed; is the file cut off?",
                self.face.len()
            ));
        }
        self.every_corner_has_texture &= self.face.iter().all(|corner| corner.1.is_some());
        for i in 1..self.face.len() - 1 {
            let fan = [self.face[0], self.face[i], self.face[i + 1]];
            self.triangles.push(fan.map(|corner| corner.0));
            if self.every_corner_has_texture {
                self.texture_triangles.push(fan.map(|corner| corner.1.unwrap_or_default()));
            }
        }
        Ok(())
    }

    fn finish(self) -> Result<Surface, ParseFault> {
        if self.triangles.is_empty() {
            return Err(ParseFault::whole("no face in it (an OBJ mesh has `v x y z` and `f a b c` lines)"));
        }
        let texture_uv = if self.every_corner_has_texture {
            self.texture_triangles.iter().map(|t| t.map(|i| self.texture[i as usize])).collect()
        } else {
            Vec::new()
        };
        Ok(Surface { positions: self.positions, triangles: self.triangles, texture_uv })
    }
}

fn numbers<'a, const N: usize>(words: &mut impl Iterator<Item = &'a [u8]>, form: &str) -> Result<[f32; N], String> {
    let mut values = [0.0f32; N];
    for (i, value) in values.iter_mut().enumerate() {
        let word = words.next().ok_or_else(|| format!("{form}, this one has {i}; is the file cut off?"))?;
        let text = shown(word);
        *value = text.parse().map_err(|_| format!("`{text}` is not a number; {form}"))?;
        if !value.is_finite() {
            return Err(format!("`{text}` is not a finite number; {form}"));
        }
    }
    Ok(values)
}

/// An OBJ index (from 1, or negative = back from the last one so far) as index from 0.
fn index(word: &[u8], count: usize, noun: &str) -> Result<u32, String> {
    let text = shown(word);
    let number: i64 = text.parse().map_err(|_| format!("`{text}` is not a {noun} index"))?;
    let zero_based = if number > 0 { number - 1 } else { number.saturating_add(count as i64) };
    match number {
        0 => Err(format!("{noun} index 0, but OBJ counts from 1")),
        _ if zero_based < 0 || zero_based >= count as i64 => {
            Err(format!("{noun} index {number}, but only {count} are defined up to this line"))
        }
        _ => Ok(zero_based as u32),
    }
}

/// A word for a message, at most 40 bytes of it.
fn shown(word: &[u8]) -> std::borrow::Cow<'_, str> {
    String::from_utf8_lossy(&word[..word.len().min(40)])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(text: &str) -> String {
        let fault = parse_obj(text.as_bytes()).unwrap_err();
        format!("{}: {}", fault.line.unwrap_or(0), fault.what)
    }

    #[test]
    fn quads_negative_indices_bom_tabs_and_continued_lines() {
        let text = "\u{feff}v 0 0 0\r\n\tv\t1e0 0 0\nv 1 1 0\nv 0 1 0 # here\nny 3\nf -4 -3 \\\n -2 -1";
        let surface = parse_obj(text.as_bytes()).unwrap();
        assert_eq!(surface.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(surface.positions[2], Vec3::new(1.0, 1.0, 0.0));
        assert!(surface.texture_uv.is_empty());
    }

    #[test]
    fn texture_coordinates_stay_apart_from_vertices() {
        let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 2 0 0\nvt 0 3\nf 1/2 2/3/1 3/1\n";
        let surface = parse_obj(text.as_bytes()).unwrap();
        assert_eq!(surface.texture_uv, [[Vec2::new(2.0, 0.0), Vec2::new(0.0, 3.0), Vec2::ZERO]]);
        assert!(parse_obj(text.replace("3/1\n", "3\n").as_bytes()).unwrap().texture_uv.is_empty());
    }

    #[test]
    fn faults_name_their_line() {
        let vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
        let with = |line: &str| fault(&format!("{vertices}{line}"));
        assert_eq!(with("f 0 1 2"), "4: vertex index 0, but OBJ counts from 1");
        assert_eq!(with("f 1 2 4"), "4: vertex index 4, but only 3 are defined up to this line");
        assert_eq!(with("f 1 2 -4"), "4: vertex index -4, but only 3 are defined up to this line");
        assert_eq!(with("f 1 2"), "4: the face has 2 corners where at least 3 are needed; is the file cut off?");
        assert_eq!(with("f 1 2 x"), "4: `x` is not a vertex index");
        assert_eq!(with("f 1/1 2/1 3/1"), "4: texture coordinate index 1, but only 0 are defined up to this line");
        assert_eq!(
            with("v 1 nan 2"),
            "4: `nan` is not a finite number; a vertex line has three coordinates (`v x y z`)"
        );
        assert_eq!(
            with("v 1 2"),
            "4: a vertex line has three coordinates (`v x y z`), this one has 2; is the file cut off?"
        );
        assert_eq!(fault(""), "0: no face in it (an OBJ mesh has `v x y z` and `f a b c` lines)");
    }
}
