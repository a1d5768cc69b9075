//! Arrays that numpy wrote (`.npz`), as far as the test data needs them: uncompressed or deflated, little-endian, in C
//! order.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

/// An array with its numbers in C order.
#[derive(Clone, Debug)]
pub struct Array {
    /// Its extents.
    pub shape: Vec<usize>,
    /// Its numbers.
    pub values: Vec<f64>,
}

impl Array {
    /// The numbers of the `i`-th entry along the first axis.
    pub fn entry(&self, i: usize) -> &[f64] {
        let length = self.shape[1..].iter().product::<usize>();
        &self.values[i * length..(i + 1) * length]
    }

    /// Its numbers as triples of whole numbers.
    pub fn triples(&self) -> Vec<[u32; 3]> {
        self.values.as_chunks::<3>().0.iter().map(|triple| triple.map(|x| x as u32)).collect()
    }
}

/// A file or folder of the third-party test data; none, with a line that says so, if there is none on this machine.
pub fn test_data(path: &str) -> Option<PathBuf> {
    let Some(data) = std::env::var_os("LOOMTREE_TEST_DATA") else {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
        return None;
    };
    Some(Path::new(&data).join(path))
}

/// All arrays of an `.npz` file. It panics on anything that is none.
pub fn read_npz(path: &Path) -> BTreeMap<String, Array> {
    let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let half = |at: usize| usize::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]));
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let end = (0..bytes.len() - 21).rfind(|&at| bytes[at..].starts_with(b"PK\x05\x06")).expect("a zip file");
    let (entries, mut at) = (half(end + 10), word(end + 16));
    let mut arrays = BTreeMap::new();
    for _ in 0..entries {
        assert!(bytes[at..].starts_with(b"PK\x01\x02"), "an entry of the directory");
        let (method, packed, place) = (half(at + 10), word(at + 20), word(at + 42));
        let name = String::from_utf8(bytes[at + 46..at + 46 + half(at + 28)].to_vec()).unwrap();
        at += 46 + half(at + 28) + half(at + 30) + half(at + 32);
        // The sizes of the local header can be left out; its lengths are its own.
        let start = place + 30 + half(place + 26) + half(place + 28);
        let content = &bytes[start..start + packed];
        let plain = match method {
            0 => content.to_vec(),
            8 => {
                let mut plain = Vec::new();
                flate2::read::DeflateDecoder::new(content).read_to_end(&mut plain).expect("deflated bytes");
                plain
            }
            other => panic!("{name}: method {other}"),
        };
        arrays.insert(name.trim_end_matches(".npy").to_owned(), array(&plain));
    }
    arrays
}

fn array(bytes: &[u8]) -> Array {
    assert!(bytes.starts_with(b"\x93NUMPY\x01"), "version 1 of the format");
    let length = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = std::str::from_utf8(&bytes[10..10 + length]).unwrap();
    assert!(header.contains("'fortran_order': False"), "{header}");
    let (_, shape) = header.split_once("'shape': (").unwrap();
    let (shape, _) = shape.split_once(')').unwrap();
    let shape: Vec<usize> = shape.split(',').filter_map(|extent| extent.trim().parse().ok()).collect();
    let numbers = &bytes[10 + length..];
    let (_, kind) = header.split_once("'descr': '").unwrap();
    let values: Vec<f64> = match &kind[..3] {
        "<f8" => numbers.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        "<f4" => numbers.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
        "<i4" => numbers.as_chunks::<4>().0.iter().map(|b| f64::from(i32::from_le_bytes(*b))).collect(),
        other => panic!("numbers of the kind {other}"),
    };
    assert_eq!(values.len(), shape.iter().product::<usize>(), "{header}");
    Array { shape, values }
}
