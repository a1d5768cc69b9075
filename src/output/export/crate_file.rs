//! The container of binary USD files (`.usdc`, "crate", version 0.8.0): values, and behind them tokens, fields, paths
//! and specs in sections. The crate `openusd` 0.6.0, which reads stages here, writes files that USD itself refuses; a
//! later one needs a later compiler.
//!
//! Sections are compressed by the format with LZ4. What is written here are LZ4 blocks that hold all bytes as they are:
//! the sections are small, and long arrays of integers are made short by coding their differences.

use crate::math::Vec3;

/// Bytes before the values: name, version, place of the table of sections, and reserve.
pub(super) const HEADER_BYTES: u64 = 88;
/// Shorter arrays of integers are not coded.
const SHORTEST_CODED: usize = 16;

/// Types of values.
#[derive(Clone, Copy)]
pub(super) enum Type {
    Int = 3,
    Double = 9,
    Token = 11,
    Vec2f = 20,
    Vec3f = 24,
    TokenVector = 41,
    Specifier = 42,
    Variability = 44,
    TimeSamples = 46,
    DoubleVector = 48,
}

/// Types of specs.
#[derive(Clone, Copy)]
pub(super) enum SpecType {
    Attribute = 1,
    Prim = 6,
    Root = 7,
}

const ARRAY: u64 = 1 << 63;
const INLINED: u64 = 1 << 62;
const CODED: u64 = 1 << 61;

/// A value that is its own place.
pub(super) fn inlined(kind: Type, bits: u32) -> u64 {
    INLINED | (kind as u64) << 48 | u64::from(bits)
}

/// A value at a place of the file.
pub(super) fn at(kind: Type, place: u64) -> u64 {
    (kind as u64) << 48 | place
}

/// A list of values at a place of the file.
pub(super) fn array_at(kind: Type, place: u64) -> u64 {
    ARRAY | at(kind, place)
}

/// Bytes of a list of points.
pub(super) fn points_bytes(points: usize) -> u64 {
    8 + 12 * points as u64
}

/// What stands before the values of a list.
pub(super) fn list_head(count: usize) -> [u8; 8] {
    (count as u64).to_le_bytes()
}

/// Values that do not depend on a frame; they follow the header, or whatever ends at `start`.
pub(super) struct Values {
    pub bytes: Vec<u8>,
    pub start: u64,
}

impl Values {
    pub(super) fn new(start: u64) -> Values {
        Values { bytes: Vec::new(), start }
    }

    fn place(&self) -> u64 {
        self.start + self.bytes.len() as u64
    }

    pub(super) fn integers(&mut self, values: &[u32]) -> u64 {
        let place = self.place();
        self.bytes.extend(list_head(values.len()));
        if values.len() < SHORTEST_CODED {
            self.bytes.extend_from_slice(bytemuck::cast_slice(values));
            return array_at(Type::Int, place);
        }
        block(&coded(values), &mut self.bytes);
        CODED | array_at(Type::Int, place)
    }

    /// A list of vectors of two or three f32.
    pub(super) fn vectors(&mut self, kind: Type, count: usize, bytes: &[u8]) -> u64 {
        let place = self.place();
        self.bytes.extend(list_head(count));
        self.bytes.extend_from_slice(bytes);
        array_at(kind, place)
    }

    pub(super) fn tokens(&mut self, tokens: &[u32]) -> u64 {
        let place = self.place();
        self.bytes.extend(list_head(tokens.len()));
        self.bytes.extend_from_slice(bytemuck::cast_slice(tokens));
        at(Type::TokenVector, place)
    }

    pub(super) fn double(&mut self, value: f64) -> u64 {
        // One that is a single-precision number needs no place.
        if f64::from(value as f32) == value {
            return inlined(Type::Double, (value as f32).to_bits());
        }
        let place = self.place();
        self.bytes.extend(value.to_le_bytes());
        at(Type::Double, place)
    }

    /// Times of samples, to be shared.
    pub(super) fn times(&mut self, times: &[f64]) -> u64 {
        let place = self.place();
        self.bytes.extend(list_head(times.len()));
        times.iter().for_each(|time| self.bytes.extend(time.to_le_bytes()));
        at(Type::DoubleVector, place)
    }

    /// Samples at such times.
    pub(super) fn samples(&mut self, times: u64, values: &[u64]) -> u64 {
        /// Times and values may stand elsewhere; these words say that they follow.
        const FOLLOWS: u64 = 8;
        let place = self.place();
        self.bytes.extend(FOLLOWS.to_le_bytes());
        self.bytes.extend(times.to_le_bytes());
        self.bytes.extend(FOLLOWS.to_le_bytes());
        self.bytes.extend(list_head(values.len()));
        values.iter().for_each(|value| self.bytes.extend(value.to_le_bytes()));
        at(Type::TimeSamples, place)
    }
}

/// Tokens, paths, fields and specs.
pub(super) struct Structure {
    tokens: Vec<String>,
    fields: Vec<(u32, u64)>,
    /// Fields of the specs, each list with an end.
    sets: Vec<u32>,
    /// In the order of a walk from the root down: depth, token, is a property.
    paths: Vec<(u32, u32, bool)>,
    specs: Vec<(u32, u32, SpecType)>,
}

impl Structure {
    pub(super) fn new() -> Structure {
        // A property has the negative of its token's number, so none may be the first.
        let tokens = vec![";-)".to_owned()];
        Structure { tokens, fields: Vec::new(), sets: Vec::new(), paths: Vec::new(), specs: Vec::new() }
    }

    pub(super) fn token(&mut self, text: &str) -> u32 {
        let known = self.tokens.iter().position(|token| token == text);
        known.unwrap_or_else(|| {
            self.tokens.push(text.to_owned());
            self.tokens.len() - 1
        }) as u32
    }

    pub(super) fn token_value(&mut self, text: &str) -> u64 {
        inlined(Type::Token, self.token(text))
    }

    /// Adds a spec. Specs come in the order of a walk: the root has depth 0, and a prim's properties stand before its
    /// children.
    pub(super) fn spec(&mut self, depth: u32, name: &str, kind: SpecType, fields: &[(&str, u64)]) {
        const END: u32 = u32::MAX;
        let token = self.token(name);
        let path = self.paths.len() as u32;
        self.paths.push((depth, token, matches!(kind, SpecType::Attribute)));
        self.specs.push((path, self.sets.len() as u32, kind));
        for &(name, value) in fields {
            let token = self.token(name);
            self.sets.push(self.fields.len() as u32);
            self.fields.push((token, value));
        }
        self.sets.push(END);
    }

    /// The sections and their table, from `start` on; and the place of the table.
    pub(super) fn end(&self, start: u64) -> (Vec<u8>, u64) {
        let mut bytes = Vec::new();
        let mut table: Vec<([u8; 16], u64, u64)> = Vec::new();
        let mut section = |name: &str, content: Vec<u8>| {
            let mut padded = [0; 16];
            padded[..name.len()].copy_from_slice(name.as_bytes());
            table.push((padded, start + bytes.len() as u64, content.len() as u64));
            bytes.extend(content);
        };
        let text: Vec<u8> = self.tokens.iter().flat_map(|token| token.bytes().chain([0])).collect();
        let mut content = list_head(self.tokens.len()).to_vec();
        content.extend(list_head(text.len()));
        block(&text, &mut content);
        section("TOKENS", content);
        section("STRINGS", list_head(0).to_vec());
        let numbers = |numbers: Vec<u32>, content: &mut Vec<u8>| block(&coded(&numbers), content);
        let mut content = list_head(self.fields.len()).to_vec();
        numbers(self.fields.iter().map(|field| field.0).collect(), &mut content);
        let values: Vec<u8> = self.fields.iter().flat_map(|field| field.1.to_le_bytes()).collect();
        block(&values, &mut content);
        section("FIELDS", content);
        let mut content = list_head(self.sets.len()).to_vec();
        numbers(self.sets.clone(), &mut content);
        section("FIELDSETS", content);
        let mut content = [list_head(self.paths.len()), list_head(self.paths.len())].concat();
        numbers((0..self.paths.len() as u32).collect(), &mut content);
        let element = |&(_, token, is_property): &(u32, u32, bool)| {
            if is_property { (token as i32).wrapping_neg() as u32 } else { token }
        };
        numbers(self.paths.iter().map(element).collect(), &mut content);
        numbers(self.jumps(), &mut content);
        section("PATHS", content);
        let mut content = list_head(self.specs.len()).to_vec();
        numbers(self.specs.iter().map(|spec| spec.0).collect(), &mut content);
        numbers(self.specs.iter().map(|spec| spec.1).collect(), &mut content);
        numbers(self.specs.iter().map(|spec| spec.2 as u32).collect(), &mut content);
        section("SPECS", content);
        let place = start + bytes.len() as u64;
        bytes.extend(list_head(table.len()));
        for (name, start, size) in table {
            bytes.extend(name);
            bytes.extend(start.to_le_bytes());
            bytes.extend(size.to_le_bytes());
        }
        (bytes, place)
    }

    /// For every path where its next sibling is: -2 without child and sibling, -1 with a child only, 0 with a sibling
    /// only, which then follows; else the way to the sibling.
    fn jumps(&self) -> Vec<u32> {
        let jump = |i: usize| {
            let depth = self.paths[i].0;
            let has_child = self.paths.get(i + 1).is_some_and(|next| next.0 > depth);
            let after = self.paths[i + 1..].iter().position(|next| next.0 <= depth).map(|way| i + 1 + way);
            let sibling = after.filter(|&after| self.paths[after].0 == depth);
            match (has_child, sibling) {
                (false, None) => -2,
                (true, None) => -1,
                (false, Some(_)) => 0,
                (true, Some(sibling)) => (sibling - i) as i32,
            }
        };
        (0..self.paths.len()).map(|i| jump(i) as u32).collect()
    }
}

/// The header of a file whose table of sections is at `table`.
pub(super) fn header(table: u64) -> [u8; HEADER_BYTES as usize] {
    let mut bytes = [0; HEADER_BYTES as usize];
    bytes[..8].copy_from_slice(b"PXR-USDC");
    bytes[8..11].copy_from_slice(&[0, 8, 0]);
    bytes[16..24].copy_from_slice(&table.to_le_bytes());
    bytes
}

/// The bytes of points.
pub(super) fn point_bytes(points: &[Vec3]) -> &[u8] {
    bytemuck::cast_slice(points)
}

/// Integers as their differences: the commonest one, two bits for each that say its length (0: it is the commonest,
/// then 1, 2 and 4 bytes), and the others.
fn coded(values: &[u32]) -> Vec<u8> {
    let mut last = 0;
    let differences: Vec<i32> =
        values.iter().map(|&value| value.wrapping_sub(std::mem::replace(&mut last, value)) as i32).collect();
    let mut counts = std::collections::HashMap::new();
    differences.iter().for_each(|difference| *counts.entry(*difference).or_insert(0usize) += 1);
    // Of equally common ones the largest, so that a file does not depend on chance.
    let common = counts.into_iter().map(|(difference, count)| (count, difference)).max().map_or(0, |most| most.1);
    let mut codes = vec![0u8; values.len().div_ceil(4)];
    let mut rest = Vec::new();
    for (i, &difference) in differences.iter().enumerate() {
        let length = match difference {
            _ if difference == common => 0,
            -0x80..=0x7f => 1,
            -0x8000..=0x7fff => 2,
            _ => 4,
        };
        codes[i / 4] |= [0, 1, 2, 0, 3][length] << (2 * (i % 4));
        rest.extend(&difference.to_le_bytes()[..length]);
    }
    if values.is_empty() { Vec::new() } else { [&common.to_le_bytes()[..], &codes, &rest].concat() }
}

/// Appends bytes as an LZ4 block without matches, with its length before it and a mark that it is one block.
fn block(bytes: &[u8], out: &mut Vec<u8>) {
    const SHORT: usize = 15;
    let mut lengths = vec![0u8, (bytes.len().min(SHORT) as u8) << 4];
    if let Some(mut more) = bytes.len().checked_sub(SHORT) {
        while more >= 255 {
            lengths.push(255);
            more -= 255;
        }
        lengths.push(more as u8);
    }
    out.extend(list_head(lengths.len() + bytes.len()));
    out.extend(lengths);
    out.extend_from_slice(bytes);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_become_differences() {
        assert!(coded(&[]).is_empty());
        // 3, then 0 three times, then 300.
        let expected = [&0i32.to_le_bytes()[..], &[0b0000_0001, 0b10], &[3], &300i16.to_le_bytes()].concat();
        assert_eq!(coded(&[3, 3, 3, 3, 303]), expected);
        let wide = coded(&[0, 100_000, 0]);
        assert_eq!(wide[..4], 100_000i32.to_le_bytes());
        assert_eq!((wide[4], wide.len()), (0b11_00_01, 4 + 1 + 1 + 4));
    }

    #[test]
    fn blocks_hold_their_bytes() {
        let mut out = Vec::new();
        block(&[7; 3], &mut out);
        assert_eq!(out, [&5u64.to_le_bytes()[..], &[0, 3 << 4, 7, 7, 7]].concat());
        out.clear();
        block(&[7; 300], &mut out);
        assert_eq!(out[8..12], [0, 15 << 4, 255, 30]);
        assert_eq!(out.len(), 8 + 4 + 300);
    }

    #[test]
    fn jumps_lead_to_siblings() {
        let mut structure = Structure::new();
        for (depth, name, kind) in [
            (0, "", SpecType::Root),
            (1, "run", SpecType::Prim),
            (2, "a", SpecType::Prim),
            (3, "points", SpecType::Attribute),
            (3, "extent", SpecType::Attribute),
            (2, "b", SpecType::Prim),
        ] {
            structure.spec(depth, name, kind, &[]);
        }
        let jumps: Vec<i32> = structure.jumps().iter().map(|&jump| jump as i32).collect();
        assert_eq!(jumps, [-1, -1, 3, 0, -2, -2]);
    }
}
