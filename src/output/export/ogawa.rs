//! The container of Alembic files as AbcCoreOgawa of Alembic 1.8 lays it out. `scene/alembic/ogawa.rs`, which reads it,
//! says what groups and data are.

use xxhash_rust::xxh3::xxh3_128;

/// The bit of a child that is data.
const DATA: u64 = 1 << 63;
/// Data without bytes.
pub(super) const EMPTY_DATA: u64 = DATA;
/// A group without children.
pub(super) const EMPTY_GROUP: u64 = 0;
/// Bytes of the header: the name, a mark that the file is whole, its version, the place of the first group.
pub(super) const HEADER_BYTES: u64 = 16;
/// Bytes before the values of a sample: their number and their key.
const SAMPLE_BYTES: u64 = 24;

/// The header of a file whose first group is at `root`.
pub(super) fn header(root: u64) -> [u8; HEADER_BYTES as usize] {
    let mut bytes = *b"Ogawa\xff\x00\x01\0\0\0\0\0\0\0\0";
    bytes[8..].copy_from_slice(&root.to_le_bytes());
    bytes
}

/// Bytes of a sample with that many bytes of values.
pub(super) fn sample_bytes(values: usize) -> u64 {
    SAMPLE_BYTES + values as u64
}

/// What stands before the values of a sample. Readers take the key for the identity of the values; any good hash will
/// do.
pub(super) fn sample_head(values: &[u8]) -> [u8; SAMPLE_BYTES as usize] {
    let mut bytes = [0; SAMPLE_BYTES as usize];
    bytes[..8].copy_from_slice(&(values.len() as u64 + 16).to_le_bytes());
    bytes[8..].copy_from_slice(&xxh3_128(values).to_le_bytes());
    bytes
}

/// A child that is the sample at this place.
pub(super) fn sample_at(place: u64) -> u64 {
    DATA | place
}

/// The end of a file: its groups and what they say of themselves.
pub(super) struct Tail {
    pub bytes: Vec<u8>,
    /// Place of the first byte in the file.
    start: u64,
}

impl Tail {
    pub(super) fn new(start: u64) -> Tail {
        Tail { bytes: Vec::new(), start }
    }

    /// Adds data and returns it as a child.
    pub(super) fn data(&mut self, bytes: &[u8]) -> u64 {
        let place = self.start + self.bytes.len() as u64;
        self.bytes.extend((bytes.len() as u64).to_le_bytes());
        self.bytes.extend(bytes);
        DATA | place
    }

    /// Adds a group and returns it as a child.
    pub(super) fn group(&mut self, children: &[u64]) -> u64 {
        let place = self.start + self.bytes.len() as u64;
        self.bytes.extend((children.len() as u64).to_le_bytes());
        children.iter().for_each(|child| self.bytes.extend(child.to_le_bytes()));
        place
    }
}

/// Types of numbers.
#[derive(Clone, Copy)]
pub(super) enum Number {
    I32 = 6,
    F32 = 10,
    F64 = 11,
}

/// A property with samples, as its header says it.
pub(super) struct Property<'a> {
    pub name: &'a str,
    /// Several values per sample; otherwise one.
    pub is_array: bool,
    pub number: Number,
    /// Numbers per value.
    pub extent: u32,
    /// Number of samples, which are at the times of sampling 1.
    pub samples: usize,
    /// Only the first sample is stored.
    pub is_constant: bool,
    /// Number of its metadata in the table of the archive; 0 for none.
    pub metadata: u32,
}

impl Property<'_> {
    /// Appends the header.
    pub(super) fn write(&self, out: &mut Vec<u8>) {
        const SAMPLING: u32 = 0x100;
        const EVEN: u32 = 0x400;
        const CONSTANT: u32 = 0x800;
        // Counts take 1, 2 or 4 bytes.
        let (hint, bytes) = match self.samples.max(self.name.len()) {
            0..=0xff => (0u32, 1),
            0x100..=0xffff => (1, 2),
            _ => (2, 4),
        };
        let kind = if self.is_array { 2 } else { 1 };
        let constant = if self.is_constant { CONSTANT } else { 0 };
        let info = kind | hint << 2 | (self.number as u32) << 4 | SAMPLING | EVEN | constant;
        out.extend((info | self.extent << 12 | self.metadata << 20).to_le_bytes());
        let mut count = |number: usize| out.extend(&(number as u32).to_le_bytes()[..bytes]);
        count(self.samples);
        count(1);
        count(self.name.len());
        out.extend(self.name.as_bytes());
    }
}

/// Appends the header of a list of properties. `metadata`: as for a property.
pub(super) fn write_compound(name: &str, metadata: u32, out: &mut Vec<u8>) {
    out.extend((metadata << 20).to_le_bytes());
    out.push(name.len() as u8);
    out.extend(name.as_bytes());
}

/// The headers of objects, and keys of their content, which nobody compares between files. `metadata`: as for a
/// property.
pub(super) fn object_headers(names: &[String], metadata: u8) -> Vec<u8> {
    let mut bytes = Vec::new();
    for name in names {
        bytes.extend((name.len() as u32).to_le_bytes());
        bytes.extend(name.as_bytes());
        bytes.push(metadata);
    }
    let keys = [xxh3_128(&bytes), 0];
    keys.iter().for_each(|key| bytes.extend(key.to_le_bytes()));
    bytes
}
