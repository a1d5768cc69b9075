//! Checkpoints: the state after a step. A run continues from it with the same bits on any number of workers.
//!
//! `checkpoint/step_%08d.ltc` (the newest three) and `states/step_%08d.ltc` (all that were requested), little-endian:
//! "LOOMCKPT", version (u32), header length (u32), header (bincode), positions and velocities (3 f32 per vertex,
//! original vertex order), creases (2 f32 per hinge), rest stretches (4 f32 per triangle), what is let go (3 u32 per
//! pair), holds of pins (10 words each), xxh3 of all bytes before (u64). A damaged file is detected and skipped, not
//! repaired. A state without holds is written in layout 4, one without rest stretches as well in layout 3, one that has
//! let nothing go in layout 2, one without creases as well in layout 1: their headers do not count what is not there.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::atomic::{WriteError, write_atomically};
use super::ply::{positions_from_bytes, write_words};
use crate::model::{Crease, LetGo, RestStretch, State};
use crate::scene::Hold;

const MAGIC: &[u8; 8] = b"LOOMCKPT";
/// Layouts without creases, with creases, with what is let go as well, with rest stretches as well, and with holds as
/// well.
const VERSIONS: [u32; 5] = [1, 2, 3, 4, 5];
const CREASE_BYTES: u64 = size_of::<Crease>() as u64;
const STRETCH_BYTES: u64 = size_of::<RestStretch>() as u64;
const LET_GO_BYTES: u64 = size_of::<LetGo>() as u64;
const HOLD_BYTES: u64 = size_of::<Hold>() as u64;
/// Magic, version and header length.
const PREFIX_BYTES: usize = 16;
/// Limit of the header length. A longer one in a file means damage.
const HEADER_LIMIT: usize = 4096;
const CHECKSUM_BYTES: usize = 8;
/// Checkpoints kept: the newest and two older ones, in case it is damaged.
const KEPT: usize = 3;

/// State after a step, with its place in the run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    /// Last frame written at or before this state.
    pub frame: u32,
    /// Number of steps made.
    pub step: u64,
    /// Simulated time, seconds.
    pub time_s: f64,
    /// [`super::scene_fingerprint`] of the scene.
    pub fingerprint: u64,
    /// The state.
    pub state: State,
}

#[derive(Serialize, Deserialize)]
struct Header {
    program: String,
    frame: u32,
    step: u64,
    time_s: f64,
    fingerprint: u64,
    vertices: u64,
}

/// Why bytes are not a checkpoint.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum CheckpointError {
    /// The file is of another kind.
    #[error("it is not a checkpoint")]
    Magic,
    /// The file was written by a version with another layout.
    #[error("it has layout {0}, this program reads layouts 1 to 5")]
    Version(u32),
    /// The file is too short or too long.
    #[error("it is cut off or damaged: {got} bytes where its header asks for {expected}")]
    Length {
        /// Bytes it should have.
        expected: u64,
        /// Bytes it has.
        got: u64,
    },
    /// The header does not decode.
    #[error("its header is damaged")]
    Header,
    /// The checksum does not match.
    #[error("it is damaged: its checksum does not match")]
    Checksum,
}

impl Checkpoint {
    /// Writes the content of the file.
    fn put(&self, out: &mut dyn Write) -> io::Result<()> {
        let Some(vertices) = self.state.vertices() else {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "the lists of the state do not fit each other"));
        };
        let header = Header {
            program: env!("CARGO_PKG_VERSION").to_string(),
            frame: self.frame,
            step: self.step,
            time_s: self.time_s,
            fingerprint: self.fingerprint,
            vertices: vertices as u64,
        };
        let State { positions, velocities, creases, stretches, let_go, holds } = &self.state;
        let form = bincode_form();
        let counts = [creases.len(), let_go.len(), stretches.len(), holds.len()].map(|count| count as u64);
        let (version, header) = match counts {
            [0, 0, 0, 0] => (VERSIONS[0], bincode::serde::encode_to_vec(header, form)),
            [creases, 0, 0, 0] => (VERSIONS[1], bincode::serde::encode_to_vec((header, creases), form)),
            [creases, let_go, 0, 0] => (VERSIONS[2], bincode::serde::encode_to_vec((header, creases, let_go), form)),
            [creases, let_go, stretches, 0] => {
                (VERSIONS[3], bincode::serde::encode_to_vec((header, creases, let_go, stretches), form))
            }
            [creases, let_go, stretches, holds] => {
                (VERSIONS[4], bincode::serde::encode_to_vec((header, creases, let_go, stretches, holds), form))
            }
        };
        let header = header.map_err(io::Error::other)?;
        let mut out = Hashing { out, hasher: Xxh3::new() };
        out.write_all(MAGIC)?;
        out.write_all(&version.to_le_bytes())?;
        out.write_all(&(header.len() as u32).to_le_bytes())?;
        out.write_all(&header)?;
        let mut buffer = Vec::new();
        write_words(&mut out, &mut buffer, bytemuck::cast_slice(positions))?;
        write_words(&mut out, &mut buffer, bytemuck::cast_slice(velocities))?;
        write_words(&mut out, &mut buffer, bytemuck::cast_slice(creases))?;
        write_words(&mut out, &mut buffer, bytemuck::cast_slice(stretches))?;
        for one in let_go {
            [one.vertex, one.obstacle, one.inside].iter().try_for_each(|word| out.write_all(&word.to_le_bytes()))?;
        }
        write_words(&mut out, &mut buffer, bytemuck::cast_slice(holds))?;
        let checksum = out.hasher.digest();
        out.out.write_all(&checksum.to_le_bytes())
    }

    /// Decodes the content of a file.
    pub fn from_bytes(bytes: &[u8]) -> Result<Checkpoint, CheckpointError> {
        if bytes.len() < MAGIC.len() || &bytes[..MAGIC.len()] != MAGIC {
            return Err(CheckpointError::Magic);
        }
        let got = bytes.len() as u64;
        let cut_off = |expected: u64| CheckpointError::Length { expected, got };
        let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        let (Some(version), Some(header_bytes)) = (word(8), word(12)) else { return Err(cut_off(PREFIX_BYTES as u64)) };
        if !VERSIONS.contains(&version) {
            return Err(CheckpointError::Version(version));
        }
        let header_bytes = header_bytes as usize;
        if header_bytes > HEADER_LIMIT {
            return Err(CheckpointError::Header);
        }
        let body = PREFIX_BYTES + header_bytes;
        let Some(header) = bytes.get(PREFIX_BYTES..body) else { return Err(cut_off((body + CHECKSUM_BYTES) as u64)) };
        let form = bincode_form();
        let decoded: Result<((Header, u64, u64, u64, u64), usize), _> = if version == VERSIONS[0] {
            bincode::serde::decode_from_slice(header, form).map(|(header, used)| ((header, 0, 0, 0, 0), used))
        } else if version == VERSIONS[1] {
            bincode::serde::decode_from_slice(header, form)
                .map(|((header, creases), used)| ((header, creases, 0, 0, 0), used))
        } else if version == VERSIONS[2] {
            bincode::serde::decode_from_slice(header, form)
                .map(|((header, creases, let_go), used)| ((header, creases, let_go, 0, 0), used))
        } else if version == VERSIONS[3] {
            bincode::serde::decode_from_slice(header, form)
                .map(|((header, creases, let_go, stretches), used)| ((header, creases, let_go, stretches, 0), used))
        } else {
            bincode::serde::decode_from_slice(header, form)
        };
        let ((header, creases, let_go, stretches, holds), used) = decoded.map_err(|_| CheckpointError::Header)?;
        if used != header_bytes {
            return Err(CheckpointError::Header);
        }
        let of_creases = creases.checked_mul(CREASE_BYTES).ok_or(CheckpointError::Header)?;
        let of_stretches = stretches.checked_mul(STRETCH_BYTES).ok_or(CheckpointError::Header)?;
        let of_let_go = let_go.checked_mul(LET_GO_BYTES).ok_or(CheckpointError::Header)?;
        let of_holds = holds.checked_mul(HOLD_BYTES).ok_or(CheckpointError::Header)?;
        let of_vertices = header.vertices.checked_mul(24).and_then(|n| n.checked_add((body + CHECKSUM_BYTES) as u64));
        let parts = [of_creases, of_stretches, of_let_go, of_holds];
        let expected = parts.iter().fold(of_vertices, |sum, &part| sum.and_then(|n| n.checked_add(part)));
        let expected = expected.ok_or(CheckpointError::Header)?;
        if expected != got {
            return Err(cut_off(expected));
        }
        let (content, checksum) = bytes.split_at(bytes.len() - CHECKSUM_BYTES);
        if xxh3_64(content).to_le_bytes() != checksum {
            return Err(CheckpointError::Checksum);
        }
        let (rest, holds) = content[body..].split_at(content.len() - body - of_holds as usize);
        let (rest, let_go) = rest.split_at(rest.len() - of_let_go as usize);
        let (rest, stretches) = rest.split_at(rest.len() - of_stretches as usize);
        let (of_vertices, creases) = rest.split_at(rest.len() - of_creases as usize);
        let (positions, velocities) = of_vertices.split_at(of_vertices.len() / 2);
        let state = State {
            positions: positions_from_bytes(positions),
            velocities: positions_from_bytes(velocities),
            creases: floats_from_bytes(creases),
            stretches: floats_from_bytes(stretches),
            let_go: let_go_from_bytes(let_go),
            holds: holds_from_bytes(holds),
        };
        if state.vertices().is_none() {
            return Err(CheckpointError::Header);
        }
        Ok(Checkpoint {
            frame: header.frame,
            step: header.step,
            time_s: header.time_s,
            fingerprint: header.fingerprint,
            state,
        })
    }
}

fn floats_from_bytes<const N: usize>(bytes: &[u8]) -> Vec<[f32; N]> {
    let words = bytes.as_chunks().0.iter().map(|&word| f32::from_le_bytes(word)).collect::<Vec<_>>();
    words.as_chunks().0.to_vec()
}

fn let_go_from_bytes(bytes: &[u8]) -> Vec<LetGo> {
    let words = bytes.as_chunks().0.iter().map(|&word| u32::from_le_bytes(word)).collect::<Vec<_>>();
    let pairs = words.as_chunks().0.iter();
    pairs.map(|&[vertex, obstacle, inside]| LetGo { vertex, obstacle, inside }).collect()
}

fn holds_from_bytes(bytes: &[u8]) -> Vec<Hold> {
    let words = bytes.as_chunks().0.iter().map(|&word| u32::from_le_bytes(word)).collect::<Vec<_>>();
    let floats = |words: [u32; 3]| words.map(f32::from_bits);
    let hold = |&[vertex, a, b, c, u, v, w, x, y, z]: &[u32; 10]| Hold {
        vertex,
        corners: [a, b, c],
        weights: floats([u, v, w]),
        offset_m: floats([x, y, z]),
    };
    words.as_chunks().0.iter().map(hold).collect()
}

fn bincode_form() -> impl bincode::config::Config {
    bincode::config::standard().with_limit::<HEADER_LIMIT>()
}

/// A writer that hashes all bytes that pass through.
struct Hashing<'a> {
    out: &'a mut dyn Write,
    hasher: Xxh3,
}

impl Write for Hashing<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.out.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        Ok(written)
    }
    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// Writes `folder/step_%08d.ltc` and removes no other file.
pub fn keep(folder: &Path, checkpoint: &Checkpoint) -> Result<PathBuf, WriteError> {
    let path = folder.join(format!("step_{:08}.ltc", checkpoint.step));
    write_atomically(&path, |out| checkpoint.put(out))?;
    Ok(path)
}

/// Writes `folder/step_%08d.ltc` and keeps the newest three files. Files of later steps are removed too, because the
/// run was resumed from an earlier step and will compute those steps again.
pub fn write(folder: &Path, checkpoint: &Checkpoint) -> Result<PathBuf, WriteError> {
    let path = keep(folder, checkpoint)?;
    let (later, mut files): (Vec<_>, Vec<_>) = list(folder).into_iter().partition(|(step, _)| *step > checkpoint.step);
    files.truncate(files.len().saturating_sub(KEPT));
    for (_, old) in files.into_iter().chain(later) {
        // Failure is ignored: an extra file does no harm, and the new one is already written.
        let _ = fs::remove_file(old);
    }
    Ok(path)
}

/// Writes `path`.
pub fn write_to(path: &Path, checkpoint: &Checkpoint) -> Result<(), WriteError> {
    write_atomically(path, |out| checkpoint.put(out))
}

/// The newest valid state in these folders after no more than `step` steps, and its file.
pub fn newest_until(folders: &[PathBuf], step: u64) -> Option<(PathBuf, Checkpoint)> {
    let mut files: Vec<(u64, PathBuf)> = folders.iter().flat_map(|folder| list(folder)).collect();
    files.retain(|(after, _)| *after <= step);
    // Of two files of one step that of the first folder comes first.
    files.sort_by_key(|(after, _)| std::cmp::Reverse(*after));
    let valid = |path: &Path| Checkpoint::from_bytes(&fs::read(path).ok()?).ok();
    files.into_iter().find_map(|(_, path)| valid(&path).map(|found| (path, found)))
}

/// Result of [`latest`].
#[derive(Debug, Default)]
pub struct Latest {
    /// The newest valid checkpoint and its file.
    pub found: Option<(PathBuf, Checkpoint)>,
    /// One sentence for every newer file that was skipped, with the reason.
    pub notes: Vec<String>,
}

/// The newest valid checkpoint of `folder`.
pub fn latest(folder: &Path) -> Latest {
    let mut latest = Latest::default();
    for (_, path) in list(folder).into_iter().rev() {
        let checkpoint = fs::read(&path)
            .map_err(|e| e.to_string())
            .and_then(|bytes| Checkpoint::from_bytes(&bytes).map_err(|e| e.to_string()));
        match checkpoint {
            Ok(checkpoint) => {
                latest.found = Some((path, checkpoint));
                break;
            }
            Err(problem) => latest.notes.push(format!("{} is skipped: {problem}", path.display())),
        }
    }
    latest
}

/// Checkpoint files by ascending step.
fn list(folder: &Path) -> Vec<(u64, PathBuf)> {
    let mut files: Vec<(u64, PathBuf)> = fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name();
            let step = name.to_str()?.strip_prefix("step_")?.strip_suffix(".ltc")?.parse().ok()?;
            Some((step, entry.path()))
        })
        .collect();
    files.sort();
    files
}
