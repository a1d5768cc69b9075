//! Point caches that other programs write: PC2 (little-endian, times in frames) and MDD (big-endian, times in seconds).
//! Both hold positions alone; the triangles come from the mesh that they were written for.

use std::io::Read;
use std::path::Path;

use crate::input::{Input, Streams};
use crate::math::Vec3;

use super::SceneError;

/// Formats of point caches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum CacheFormat {
    /// 3ds Max's and Blender's; `frames_per_s` makes seconds of its frames.
    Pc2 { frames_per_s: f64 },
    /// LightWave's.
    Mdd,
}

/// Times of the samples (seconds, ascending) and their positions in the unit of the file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Samples {
    pub times_s: Vec<f64>,
    pub frames: Vec<Vec<Vec3>>,
}

/// Reads a point cache for a mesh of `vertices` vertices from the file `rest`. At most `most` positions are held.
pub(super) fn read_cache(
    path: &Path,
    format: CacheFormat,
    (vertices, rest): (usize, &Path),
    most: usize,
) -> Result<Samples, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    let unreadable = |error: std::io::Error| fault(format!("cannot be read: {error}"));
    let mut input = Input::open(path, Streams::Refused).map_err(unreadable)?;
    let mut bytes = Vec::new();
    input.reader.read_to_end(&mut bytes).map_err(unreadable)?;
    let header = Header::read(&bytes, format).map_err(fault)?;
    if header.points != vertices as u64 {
        return Err(fault(format!(
            "has {} points per sample, but {} has {vertices} vertices",
            header.points,
            rest.display()
        )));
    }
    if header.samples.saturating_mul(header.points) > most as u64 {
        return Err(fault(format!(
            "has {} samples, which are too many: at most {most} positions are held",
            header.samples
        )));
    }
    let samples = header.samples as usize;
    let times_s = header.times(&bytes, format, samples);
    if times_s.iter().any(|time| !time.is_finite() || *time < 0.0) || times_s.windows(2).any(|pair| pair[0] >= pair[1])
    {
        return Err(fault("has times that do not grow from 0 on".into()));
    }
    let number = match format {
        CacheFormat::Pc2 { .. } => f32::from_le_bytes,
        CacheFormat::Mdd => f32::from_be_bytes,
    };
    let words = bytes[header.bytes as usize..].as_chunks::<4>().0;
    let point = |three: &[[u8; 4]]| Vec3::new(number(three[0]), number(three[1]), number(three[2]));
    let frame = |i: usize| words[3 * i * vertices..][..3 * vertices].chunks_exact(3).map(point).collect::<Vec<Vec3>>();
    let frames: Vec<Vec<Vec3>> = (0..samples).map(frame).collect();
    for (sample, frame) in frames.iter().enumerate() {
        if let Some(at) = frame.iter().position(|p| !p.is_finite()) {
            return Err(fault(format!("point {at} of sample {sample} (both from 0) is not a finite number")));
        }
    }
    Ok(Samples { times_s, frames })
}

struct Header {
    points: u64,
    samples: u64,
    /// Length of all that stands before the positions.
    bytes: u64,
}

impl Header {
    /// Bytes before the samples of a PC2 file.
    const PC2: u64 = 32;

    /// An error is half a sentence.
    fn read(bytes: &[u8], format: CacheFormat) -> Result<Header, String> {
        let word = |at: usize| bytes.get(at..at + 4).map(|w| [w[0], w[1], w[2], w[3]]);
        let cut = || "is cut off within its header".to_owned();
        let count = |word: i32| u64::try_from(word).map_err(|_| format!("has a header with the count {word}"));
        let header = match format {
            CacheFormat::Pc2 { .. } => {
                if !bytes.starts_with(b"POINTCACHE2\0") {
                    return Err("is not a PC2 cache: it does not begin with POINTCACHE2".into());
                }
                let number = |at| word(at).map(i32::from_le_bytes).ok_or_else(cut).and_then(count);
                Header { points: number(16)?, samples: number(28)?, bytes: Header::PC2 }
            }
            CacheFormat::Mdd => {
                let number = |at| word(at).map(i32::from_be_bytes).ok_or_else(cut).and_then(count);
                let samples = number(0)?;
                Header { points: number(4)?, samples, bytes: 8 + 4 * samples }
            }
        };
        let Header { points, samples, .. } = header;
        if samples == 0 || points == 0 {
            return Err("has no samples in it".into());
        }
        let needed = samples.checked_mul(points).and_then(|all| all.checked_mul(12)?.checked_add(header.bytes));
        match needed {
            Some(needed) if needed <= bytes.len() as u64 => Ok(header),
            _ => Err(format!(
                "is cut off: it has {} bytes, too few for {samples} samples of {points} points",
                bytes.len()
            )),
        }
    }

    fn times(&self, bytes: &[u8], format: CacheFormat, samples: usize) -> Vec<f64> {
        let word = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
        match format {
            CacheFormat::Pc2 { frames_per_s } => {
                let [start, rate] = [20, 24].map(|at| f64::from(f32::from_le_bytes(word(at))));
                (0..samples).map(|i| (start + rate * i as f64) / frames_per_s).collect()
            }
            CacheFormat::Mdd => (0..samples).map(|i| f64::from(f32::from_be_bytes(word(8 + 4 * i)))).collect(),
        }
    }
}
