//! OBJ reader: `v`, `vt`, `f`, `l`, `o` and `g` lines, and the `seam` and `stitch` lines of Codim-IPC's garments.
//! A line (`l`) in a group names an edge of a panel. All others (normals, materials, ARCSim's `e`, `nv`, ..) are
//! skipped.
//!
//! The crate `tobj` is not used because it renumbers vertices by first use (pins and results name vertices by their
//! number in the file), replaces a missing texture index by the previous one, and reports no line in errors.

use std::io::BufRead;

use crate::math::{DVec3, Vec2};

use super::polygon::Faces;
use super::stitches::Stitches;
use super::words::{numbers, shown};
use super::{ParseFault, Part, Surface, rounded};

/// Indices must fit 31 bits, see `validate`.
const MOST_VERTICES: usize = i32::MAX as usize;
/// Longest stored name of an object or group, bytes.
const LONGEST_NAME: usize = 200;

/// Reads the text of an OBJ file. Polygons are triangulated. Texture coordinates are kept if every corner has one.
///
/// Numbers are checked line by line, vertices of faces at the end of the file. `Surface::into_mesh` checks whether the
/// result is valid cloth.
pub fn parse_obj(reader: impl BufRead) -> Result<Surface, ParseFault> {
    parse_obj_far(reader, f64::INFINITY)
}

/// Like [`parse_obj`]. The surface of a file with coordinates beyond `far` is relative to a base.
pub(crate) fn parse_obj_far(mut reader: impl BufRead, far: f64) -> Result<Surface, ParseFault> {
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
            // A backslash joins the next line, unless it is in a comment.
            if read == 0 || line.last() != Some(&b'\\') || comment(&line).is_some() {
                break;
            }
            line.pop();
            line.push(b' ');
        }
        if number < first {
            break;
        }
        let text = if first == 1 { line.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&line) } else { &line };
        // Classic Mac OS ends lines with a carriage return alone; the whole file is then one line here.
        for text in text.split(|&c| c == b'\r') {
            obj.line(text, first).map_err(|what| ParseFault::at(first, what))?;
        }
    }
    obj.finish(far)
}

/// Byte position of the comment in a line.
fn comment(line: &[u8]) -> Option<usize> {
    (0..line.len()).find(|&i| line[i] == b'#' && (i == 0 || line[i - 1].is_ascii_whitespace()))
}

/// Marks a missing texture coordinate in [`Obj::texture_of_corner`].
const NONE: u32 = u32::MAX;

#[derive(Default)]
struct Obj {
    positions: Vec<DVec3>,
    texture: Vec<Vec2>,
    faces: Faces,
    /// Texture index of every corner. Cleared at the first corner without one.
    texture_of_corner: Vec<u32>,
    every_corner_has_texture: bool,
    /// Vertex and texture index of each corner of the current face.
    face: Vec<(u32, u32)>,
    /// First face, object and groups of each part.
    parts: Vec<(usize, String, String)>,
    /// Lines in groups or objects, with the name.
    edges: Vec<(String, Vec<u32>)>,
    stitches: Stitches,
}

impl Obj {
    fn line(&mut self, line: &[u8], number: u64) -> Result<(), String> {
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        match words.next() {
            Some(b"v") => {
                let [x, y, z] = numbers(&mut words, "a vertex line has three coordinates (`v x y z`)")?;
                if self.positions.len() >= MOST_VERTICES {
                    return Err(format!("more than {MOST_VERTICES} vertices"));
                }
                self.positions.push(DVec3::new(x, y, z));
            }
            Some(b"vt") => {
                let [u, v] = numbers(&mut words, "a texture line has two coordinates (`vt u v`)")?;
                self.texture.push(Vec2::new(u as f32, v as f32));
            }
            Some(b"f") => self.face(words, number)?,
            Some(kind @ (b"o" | b"g")) => self.part(kind == b"o", &line[..comment(line).unwrap_or(line.len())]),
            Some(b"l") => self.polyline(words)?,
            Some(b"stitch") => self.stitches.stitch(words)?,
            Some(b"seam") => self.stitches.seam(words)?,
            _ => {}
        }
        Ok(())
    }

    /// `l a b ..` in a group or object with a name: an edge of this name. Lines without a name are skipped.
    fn polyline<'a>(&mut self, words: impl Iterator<Item = &'a [u8]>) -> Result<(), String> {
        let named = self.parts.last().map(|(_, object, group)| if group.is_empty() { object } else { group });
        let Some(name) = named.filter(|name| !name.is_empty()).cloned() else { return Ok(()) };
        let mut vertices = Vec::new();
        for word in words.take_while(|word| word[0] != b'#') {
            let vertex = word.split(|&c| c == b'/').next().unwrap_or_default();
            vertices.push(index(vertex, self.positions.len(), "vertex")?);
        }
        match self.edges.last_mut() {
            // A line may come in pieces.
            Some((last, before)) if *last == name && before.last() == vertices.first() => {
                before.extend(vertices.iter().skip(1));
            }
            _ => self.edges.push((name, vertices)),
        }
        Ok(())
    }

    fn face<'a>(&mut self, words: impl Iterator<Item = &'a [u8]>, line: u64) -> Result<(), String> {
        self.face.clear();
        for word in words {
            if word[0] == b'#' {
                break;
            }
            let mut parts = word.split(|&c| c == b'/');
            let vertex = index(parts.next().unwrap_or_default(), self.positions.len(), "vertex")?;
            let texture = match parts.next() {
                None | Some(b"") => NONE,
                Some(part) => index(part, self.texture.len(), "texture coordinate")?,
            };
            self.face.push((vertex, texture));
        }
        // Exporters pad a triangle to a quadrangle by repeating a corner.
        if self.face.len() > 3 {
            self.face.dedup_by_key(|corner| corner.0);
            let first = self.face[0].0;
            self.face.pop_if(|corner| corner.0 == first);
        }
        let count = self.face.len();
        if count < 3 {
            return Err(format!("the face has {count} corners where at least 3 are needed; is the file cut off?"));
        }
        self.every_corner_has_texture &= self.face.iter().all(|corner| corner.1 != NONE);
        self.faces.corners.extend(self.face.iter().map(|corner| corner.0));
        self.texture_of_corner.extend(self.face.iter().map(|corner| corner.1));
        self.faces.close(line)
    }

    /// `o name` or `g name name ..`: the object or groups of the faces that follow.
    fn part(&mut self, is_object: bool, line: &[u8]) {
        let name = String::from_utf8_lossy(&line.trim_ascii()[1..]);
        let mut name: String = name.trim().chars().filter(|c| !c.is_control()).collect();
        if name.len() > LONGEST_NAME {
            let end = (0..=LONGEST_NAME).rev().find(|&end| name.is_char_boundary(end)).unwrap_or(0);
            name.truncate(end);
        }
        let (first, mut object, mut group) = self.parts.pop().unwrap_or_default();
        if first < self.faces.len() {
            self.parts.push((first, object.clone(), group.clone()));
        }
        // A new object ends the groups of the previous one.
        (object, group) = if is_object { (name, String::new()) } else { (object, name) };
        self.parts.push((self.faces.len(), object, group));
    }

    fn finish(self, far: f64) -> Result<Surface, ParseFault> {
        if self.faces.len() == 0 {
            return Err(ParseFault::whole("no face in it (an OBJ mesh has `v x y z` and `f a b c` lines)"));
        }
        let (base, positions) = rounded(&self.positions, far);
        let cut = self.faces.cut(&positions)?;
        let mut texture_uv = Vec::new();
        if self.every_corner_has_texture {
            let count = self.texture.len();
            if let Some(corner) = self.texture_of_corner.iter().position(|&i| i as usize >= count) {
                let index = u64::from(self.texture_of_corner[corner]) + 1;
                let what = format!("texture coordinate index {index}, but the file has only {count}");
                return Err(ParseFault::at(self.faces.line_of(corner), what));
            }
            let uv = |corner: u32| self.texture[self.texture_of_corner[corner as usize] as usize];
            texture_uv = cut.triangles.iter().map(|corners| corners.map(uv)).collect();
        }
        let mut parts = Vec::new();
        for (i, (first, object, group)) in self.parts.iter().enumerate() {
            let end = self.parts.get(i + 1).map_or(self.faces.len(), |next| next.0);
            let triangles = cut.starts[*first]..cut.starts[end];
            if !triangles.is_empty() && !(object.is_empty() && group.is_empty()) {
                parts.push(Part { object: object.clone(), group: group.clone(), triangles });
            }
        }
        let triangles = cut.triangles.iter().map(|t| t.map(|corner| self.faces.corners[corner as usize])).collect();
        let seams = self.stitches.seams(positions.len()).map_err(ParseFault::whole)?;
        let edges = self.edges;
        Ok(Surface { base, positions, triangles, texture_uv, parts, edges, seams, properties: Vec::new() })
    }
}

/// Converts an OBJ index (from 1, or negative = counted back from the last element) to an index from 0. A positive
/// index may refer to an element that is defined later.
fn index(word: &[u8], count: usize, noun: &str) -> Result<u32, String> {
    let text = shown(word);
    let number: i64 = text.parse().map_err(|_| format!("`{text}` is not a {noun} index"))?;
    let zero_based = if number > 0 { number - 1 } else { number.saturating_add(count as i64) };
    match number {
        0 => Err(format!("{noun} index 0, but OBJ counts from 1")),
        _ if zero_based < 0 => Err(format!("{noun} index {number}, but only {count} are defined up to this line")),
        _ if zero_based >= MOST_VERTICES as i64 => Err(format!("{noun} index {number} is above {MOST_VERTICES}")),
        _ => Ok(zero_based as u32),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Vec3;

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
        assert_eq!(with("f 1 2 4"), "4: vertex index 4, but the file has only 3");
        assert_eq!(with("f 1 2 -4"), "4: vertex index -4, but only 3 are defined up to this line");
        assert_eq!(with("f 1 2"), "4: the face has 2 corners where at least 3 are needed; is the file cut off?");
        assert_eq!(with("f 1 2 x"), "4: `x` is not a vertex index");
        assert_eq!(with("f 1/1 2/1 3/1"), "4: texture coordinate index 1, but the file has only 0");
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

    #[test]
    fn faces_may_stand_before_their_vertices() {
        let surface = parse_obj("f 1 2 3\nv 0 0 0\nv 1 0 0\nv 0 1 0".as_bytes()).unwrap();
        assert_eq!((surface.triangles, surface.positions.len()), (vec![[0, 1, 2]], 3));
    }

    #[test]
    fn a_comment_does_not_continue() {
        let text = "# saved in C:\\meshes\\\nv 0 0 0 # here \\\nv 1 0 0\nv 0 1 0\no a#b\\\nf\nf 1 \\\n2 3 # the end \\\nf 3 2 1";
        let surface = parse_obj(text.as_bytes()).unwrap();
        assert_eq!((surface.positions.len(), surface.triangles.len()), (3, 2));
        assert_eq!(surface.parts[0].object, "a#b f", "a name is no comment, so its backslash joins the next line");
    }

    #[test]
    fn objects_and_groups_are_kept_with_their_triangles() {
        let vertices = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";
        let text = format!(
            "{vertices}f 1 2 3\no Coat\ng left sleeve\nf 1 2 3 4\nf 1 2 3\ng\nf 2 3 4\no Belt\ng left\ng right\nf 1 2 4\no empty"
        );
        let parts: Vec<_> = parse_obj(text.as_bytes())
            .unwrap()
            .parts
            .into_iter()
            .map(|part| (part.object, part.group, part.triangles))
            .collect();
        let part = |object: &str, group: &str, triangles| (object.to_owned(), group.to_owned(), triangles);
        assert_eq!(parts, [part("Coat", "left sleeve", 1..4), part("Coat", "", 4..5), part("Belt", "right", 5..6)]);
        assert!(parse_obj(format!("{vertices}f 1 2 3").as_bytes()).unwrap().parts.is_empty());
    }

    #[test]
    fn lines_may_end_with_a_carriage_return_alone_and_quads_repeat_a_corner() {
        let surface = parse_obj("v 0 0 0\rv 1 0 0\rv 0 1 0\rf 1 2 3 3\rf 3 2 1 3".as_bytes()).unwrap();
        assert_eq!(surface.triangles, [[0, 1, 2], [2, 1, 0]]);
        assert_eq!(
            fault("v 0 0 0\nv 1 0 0\nf 1 2 2 1"),
            "3: the face has 2 corners where at least 3 are needed; is the file cut off?"
        );
    }
}
