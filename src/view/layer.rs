//! Frames of a run directory as bytes for the page.
//!
//! All numbers are little-endian and start at multiples of four bytes. A mesh is eight u32 (`MESH`, vertices,
//! triangles, obstacle vertices, obstacle triangles, pieces, 0, 0), the triangles and the obstacles' triangles (u32),
//! and the piece of every vertex (u16). A frame is eight u32 (`FRAME`, vertices, obstacle vertices, low and high half
//! of the obstacles' hash, low and high half of the hash of its triangles, 0), the positions and those of the obstacles
//! (f32, meters). Where the page has the obstacles of that hash already, a frame comes without them.

use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use super::Answer;
use crate::mesh::pieces;
use crate::output::{FrameMesh, FrameSource, FramesError, RunDirectory};

const MESH: u32 = u32::from_le_bytes(*b"LTM1");
const FRAME: u32 = u32::from_le_bytes(*b"LTF1");

/// Numbers of the frames in a run directory, ascending; none if it holds no run.
pub(super) fn frames(path: &Path) -> Vec<u32> {
    open(path).map(|frames| frames.numbers()).unwrap_or_default()
}

/// The frames of a run directory.
pub(super) fn open(path: &Path) -> Result<FrameSource, String> {
    let directory = RunDirectory::open(path).map_err(|error| error.to_string())?;
    FrameSource::open(&directory).map_err(|error| error.to_string())
}

/// Triangles of cloth and obstacles, as of a frame or else of the first one. A run that sews has other triangles later.
pub(super) fn mesh(path: &Path, frame: Option<u32>) -> Answer {
    let read = || -> Result<Answer, String> {
        let frames = open(path)?;
        let wanted = frame.or(frames.numbers().first().copied()).ok_or("no frame yet")?;
        if frames.numbers().binary_search(&wanted).is_err() {
            return Err(format!("frame {wanted} is not there"));
        }
        let (cloth, obstacle) = read_both(&frames, wanted).map_err(|error| error.to_string())?;
        Ok(Answer::bytes(mesh_bytes(&cloth, &obstacle)))
    };
    read().unwrap_or_else(Answer::unavailable)
}

/// Positions at a frame. `have`: hash of the obstacles that the page has.
pub(super) fn frame(path: &Path, frame: u32, have: Option<u64>) -> Answer {
    let read = || -> Result<Answer, String> {
        let frames = open(path)?;
        if frames.numbers().binary_search(&frame).is_err() {
            return Err(format!("frame {frame} is not there"));
        }
        let (cloth, obstacle) = read_both(&frames, frame).map_err(|error| error.to_string())?;
        Ok(Answer::bytes(frame_bytes(&cloth, &obstacle, have)))
    };
    read().unwrap_or_else(Answer::unavailable)
}

fn read_both(frames: &FrameSource, frame: u32) -> Result<(FrameMesh, FrameMesh), FramesError> {
    Ok((frames.read(frame)?, frames.read_obstacle(frame)?.unwrap_or_default()))
}

fn mesh_bytes(cloth: &FrameMesh, obstacle: &FrameMesh) -> Vec<u8> {
    // Pieces by number, in the order of their first vertices; the page has colors for fewer than 65,536.
    let (mut numbers, mut first_of) = (Vec::with_capacity(cloth.positions.len()), std::collections::BTreeMap::new());
    for root in pieces(cloth.positions.len(), &cloth.triangles) {
        let next = first_of.len();
        numbers.push(*first_of.entry(root).or_insert(next) as u16);
    }
    let counts = [
        MESH,
        cloth.positions.len() as u32,
        cloth.triangles.len() as u32,
        obstacle.positions.len() as u32,
        obstacle.triangles.len() as u32,
        first_of.len() as u32,
        0,
        0,
    ];
    let mut bytes = bytes_of(&counts);
    bytes.extend_from_slice(&bytes_of(cloth.triangles.as_flattened()));
    bytes.extend_from_slice(&bytes_of(obstacle.triangles.as_flattened()));
    bytes.extend(numbers.iter().flat_map(|piece| piece.to_le_bytes()));
    bytes
}

fn frame_bytes(cloth: &FrameMesh, obstacle: &FrameMesh, have: Option<u64>) -> Vec<u8> {
    let hash = xxh3_64(bytemuck::cast_slice(&obstacle.positions));
    let sent = if have == Some(hash) { &[][..] } else { &obstacle.positions[..] };
    let mesh = xxh3_64(bytemuck::cast_slice(&cloth.triangles));
    let halves = |hash: u64| [hash as u32, (hash >> 32) as u32];
    let ([low, high], [mesh_low, mesh_high]) = (halves(hash), halves(mesh));
    let (vertices, sent_vertices) = (cloth.positions.len() as u32, sent.len() as u32);
    let counts = [FRAME, vertices, sent_vertices, low, high, mesh_low, mesh_high, 0];
    let mut bytes = bytes_of(&counts);
    for points in [&cloth.positions[..], sent] {
        bytes.extend_from_slice(&values(bytemuck::cast_slice(points)));
    }
    bytes
}

fn bytes_of(words: &[u32]) -> Vec<u8> {
    if cfg!(target_endian = "little") {
        return bytemuck::cast_slice(words).to_vec();
    }
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// f32 values as little-endian bytes.
pub(super) fn values(values: &[f32]) -> Vec<u8> {
    if cfg!(target_endian = "little") {
        return bytemuck::cast_slice(values).to_vec();
    }
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Vec3;

    #[test]
    fn obstacles_come_once() {
        let cloth = FrameMesh { positions: vec![Vec3::X, Vec3::Y, Vec3::Z], triangles: vec![[0, 1, 2]] };
        let obstacle = FrameMesh { positions: vec![Vec3::ONE; 4], triangles: vec![[0, 1, 2], [1, 2, 3]] };
        let first = frame_bytes(&cloth, &obstacle, None);
        assert_eq!(first.len(), 32 + 12 * (3 + 4));
        assert_eq!(&first[..4], b"LTF1");
        let word = |i: usize| u32::from_le_bytes(first[4 * i..4 * i + 4].try_into().unwrap());
        assert_eq!((word(1), word(2), f32::from_bits(word(8))), (3, 4, 1.0));
        let other = FrameMesh { triangles: vec![[0, 2, 1]], ..cloth.clone() };
        let words = |bytes: &[u8]| bytes[20..28].to_vec();
        assert_ne!(words(&frame_bytes(&other, &obstacle, None)), words(&first));
        let hash = u64::from(word(3)) | u64::from(word(4)) << 32;
        let again = frame_bytes(&cloth, &obstacle, Some(hash));
        assert_eq!(again.len(), 32 + 12 * 3);
        assert_eq!(again[..8], first[..8]);
        assert_eq!(frame_bytes(&cloth, &obstacle, Some(hash ^ 1)), first);
    }

    #[test]
    fn a_mesh_has_its_pieces() {
        let cloth = FrameMesh { positions: vec![Vec3::X; 7], triangles: vec![[3, 2, 1], [0, 4, 5]] };
        let bytes = mesh_bytes(&cloth, &FrameMesh::default());
        let word = |i: usize| u32::from_le_bytes(bytes[4 * i..4 * i + 4].try_into().unwrap());
        assert_eq!((0..6).map(word).collect::<Vec<_>>(), [MESH, 7, 2, 0, 0, 3]);
        let pieces: Vec<u16> = bytes[32 + 24..].chunks(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect();
        assert_eq!(pieces, [0, 1, 1, 1, 0, 0, 2]);
    }
}
