//! PC2 point cache: all frames of a run in one file. Blender and other programs apply it to `rest.obj`.
//!
//! Header, 32 bytes little-endian: "POINTCACHE2\0", version 1, points, start frame (f32), frames per sample (f32), samples.
//! The sample count is increased only after a sample is complete, so that the file of an interrupted run can be loaded.

use std::collections::BTreeSet;
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::atomic::WriteError;
use super::ply::{positions_from_bytes, write_words};
use crate::math::Vec3;

const MAGIC: &[u8; 12] = b"POINTCACHE2\0";
const HEADER_BYTES: u64 = 32;
/// Byte offset of the sample count.
const SAMPLES_AT: u64 = 28;

/// Why a point cache cannot be used.
#[derive(Debug, Error)]
pub enum Pc2Error {
    /// The operating system reported an error.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The file cannot be opened or read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The point cache.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The bytes are not a point cache of this mesh.
    #[error("{} is not a point cache of this run: {problem}", path.display())]
    Unfit {
        /// The point cache.
        path: PathBuf,
        /// Description of the error.
        problem: String,
    },
    /// Frames before the first one to be written are missing.
    #[error("frame {frame} does not follow the {samples} frames that {} holds; start without --resume or leave out --format pc2", path.display())]
    Gap {
        /// The point cache.
        path: PathBuf,
        /// Number of the frame to be written.
        frame: u32,
        /// Number of frames in the file.
        samples: u32,
    },
}

/// Content of the header.
struct Header {
    points: u32,
    /// Number of the first frame.
    start: u32,
    samples: u32,
}

fn read_header(file: &mut File, path: &Path) -> Result<Header, Pc2Error> {
    let mut bytes = [0u8; HEADER_BYTES as usize];
    let unfit = |problem: &str| Pc2Error::Unfit { path: path.to_path_buf(), problem: problem.to_string() };
    file.seek(SeekFrom::Start(0))
        .and_then(|_| file.read_exact(&mut bytes))
        .map_err(|_| unfit("its header is cut off"))?;
    if &bytes[..12] != MAGIC {
        return Err(unfit("it does not begin with POINTCACHE2"));
    }
    let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
    let (points, samples) = (word(16), word(28));
    // It bounds the frames that a reader lists on the word of the header.
    let length = file.metadata().map(|m| m.len()).unwrap_or(0);
    if u64::from(samples) > length {
        return Err(unfit(&format!("its header counts {samples} frames in a file of {length} bytes")));
    }
    let start = f32::from_bits(word(20));
    if !(0.0..=16_777_216.0).contains(&start) || start.fract() != 0.0 {
        return Err(unfit(&format!("its first frame is {start}")));
    }
    Ok(Header { points, start: start as u32, samples })
}

/// Appends frames to a point cache.
pub struct Pc2Writer {
    path: PathBuf,
    file: File,
    points: usize,
    /// Number of the first frame of the cache.
    start: u32,
    /// Number of frames in the header; added to the first one it is the number of the first missing frame.
    samples: u32,
    /// Frames already written after the first missing one.
    ahead: BTreeSet<u32>,
    buffer: Vec<u8>,
}

impl Pc2Writer {
    /// Creates a cache (`first_frame` = 0), or continues one after its first `first_frame` frames.
    pub fn open(path: &Path, points: usize, first_frame: u32) -> Result<Pc2Writer, Pc2Error> {
        Pc2Writer::open_from(path, points, 0, first_frame)
    }

    /// Like [`Pc2Writer::open`] for a cache whose first frame is `start`: created if that is `first_frame`.
    pub fn open_from(path: &Path, points: usize, start: u32, first_frame: u32) -> Result<Pc2Writer, Pc2Error> {
        let unfit = |problem: String| Pc2Error::Unfit { path: path.to_path_buf(), problem };
        let count = i32::try_from(points).map_err(|_| unfit(format!("{points} points are more than PC2 can count")))?;
        if first_frame == start {
            let create = || -> io::Result<File> {
                let mut file = File::create(path)?;
                let mut header = MAGIC.to_vec();
                header.extend(1i32.to_le_bytes());
                header.extend(count.to_le_bytes());
                header.extend((start as f32).to_le_bytes());
                header.extend(1f32.to_le_bytes());
                header.extend(0i32.to_le_bytes());
                file.write_all(&header)?;
                Ok(file)
            };
            let file = create().map_err(WriteError::at(path))?;
            return Ok(Pc2Writer {
                path: path.to_path_buf(),
                file,
                points,
                start,
                samples: 0,
                ahead: BTreeSet::new(),
                buffer: Vec::new(),
            });
        }
        let mut file = OpenOptions::new().read(true).write(true).open(path).map_err(WriteError::at(path))?;
        let header = read_header(&mut file, path)?;
        if header.points as usize != points {
            return Err(unfit(format!("it holds {} points, the mesh has {points} vertices", header.points)));
        }
        let end = header.start.saturating_add(header.samples);
        if header.start != start || end < first_frame {
            return Err(Pc2Error::Gap { path: path.to_path_buf(), frame: first_frame, samples: end });
        }
        Ok(Pc2Writer {
            path: path.to_path_buf(),
            file,
            points,
            start,
            samples: header.samples,
            ahead: BTreeSet::new(),
            buffer: Vec::new(),
        })
    }

    /// Writes frame `frame`, in any order. An existing frame is replaced. The header counts the frames before the first
    /// missing one.
    pub fn write(&mut self, frame: u32, positions: &[Vec3]) -> Result<(), Pc2Error> {
        if positions.len() != self.points {
            let problem = format!("it holds {} points, frame {frame} has {}", self.points, positions.len());
            return Err(Pc2Error::Unfit { path: self.path.clone(), problem });
        }
        let Some(sample) = frame.checked_sub(self.start) else {
            let problem = format!("it begins with frame {}, which is after frame {frame}", self.start);
            return Err(Pc2Error::Unfit { path: self.path.clone(), problem });
        };
        let offset = HEADER_BYTES + u64::from(sample) * self.points as u64 * 12;
        self.ahead.insert(sample);
        let mut samples = self.samples;
        while self.ahead.remove(&samples) {
            samples += 1;
        }
        self.ahead = self.ahead.split_off(&samples);
        let (file, buffer) = (&mut self.file, &mut self.buffer);
        let mut put = || -> io::Result<()> {
            file.seek(SeekFrom::Start(offset))?;
            write_words(file, buffer, bytemuck::cast_slice(positions))?;
            file.seek(SeekFrom::Start(SAMPLES_AT))?;
            file.write_all(&samples.to_le_bytes())
        };
        put().map_err(WriteError::at(&self.path))?;
        self.samples = samples;
        Ok(())
    }
}

/// Number of complete frames in a point cache.
pub fn samples(path: &Path) -> Result<u32, Pc2Error> {
    let mut file = open(path)?;
    Ok(read_header(&mut file, path)?.samples)
}

/// Number of the first frame of a point cache.
pub fn start(path: &Path) -> Result<u32, Pc2Error> {
    let mut file = open(path)?;
    Ok(read_header(&mut file, path)?.start)
}

/// Positions of sample `frame`, counted from the first frame of the cache.
pub fn read(path: &Path, frame: u32) -> Result<Vec<Vec3>, Pc2Error> {
    let unfit = |problem: String| Pc2Error::Unfit { path: path.to_path_buf(), problem };
    let mut file = open(path)?;
    let header = read_header(&mut file, path)?;
    let size = u64::from(header.points) * 12;
    // The header's numbers are checked against the length of the file; damaged ones may exceed every integer.
    let length = file.metadata().map(|m| m.len()).unwrap_or(0);
    let end = size.checked_mul(u64::from(frame) + 1).and_then(|bytes| bytes.checked_add(HEADER_BYTES));
    let Some(end) = end.filter(|&end| frame < header.samples && end <= length) else {
        return Err(unfit(format!("frame {frame} is missing or cut off")));
    };
    let offset = end - size;
    let mut bytes = vec![0; size as usize];
    let fill = file.seek(SeekFrom::Start(offset)).and_then(|_| file.read_exact(&mut bytes));
    fill.map_err(|source| Pc2Error::Read { path: path.to_path_buf(), source })?;
    Ok(positions_from_bytes(&bytes))
}

fn open(path: &Path) -> Result<File, Pc2Error> {
    File::open(path).map_err(|source| Pc2Error::Read { path: path.to_path_buf(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 2^31 points and 2^31 frames: the number of their bytes wraps around to zero.
    #[test]
    fn numbers_beyond_every_integer_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloth.pc2");
        let mut bytes = MAGIC.to_vec();
        for word in [1u32, 1 << 31, 0, 1.0f32.to_bits(), 1 << 31] {
            bytes.extend(word.to_le_bytes());
        }
        let refusal = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            read(&path, 3).unwrap_err().to_string()
        };
        let counted = refusal(&bytes);
        assert!(counted.ends_with("its header counts 2147483648 frames in a file of 32 bytes"), "{counted}");
        assert_eq!(samples(&path).unwrap_err().to_string(), counted);
        // Fewer frames, of 24 GiB each.
        bytes[28..].copy_from_slice(&4u32.to_le_bytes());
        let cut = refusal(&bytes);
        assert!(cut.ends_with("frame 3 is missing or cut off"), "{cut}");
    }
}
