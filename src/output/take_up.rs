//! Prepares a resumed run for frame formats that it has not written before. A point cache is filled from the existing
//! frames; other formats start at the first new frame.

use std::path::Path;

use super::atomic::WriteError;
use super::frames::FrameFormat;
use super::pc2::{self, Pc2Error, Pc2Writer};
use super::{FrameSource, FramesError, RunDirectory};
use crate::mesh::TriangleMesh;

/// Prepares `directory` for frames of `mesh` from `first_frame` on in `formats`. `since`: the first frame of this mesh
/// in a run that has sewn another one before. Returns one sentence for each format
/// that will lack earlier frames.
///
/// # Errors
/// A point cache cannot be filled, because earlier frames are missing, damaged or of another mesh.
pub fn take_up_formats(
    directory: &RunDirectory,
    formats: &[FrameFormat],
    mesh: &TriangleMesh,
    since: Option<u32>,
    first_frame: u32,
) -> Result<Vec<String>, FramesError> {
    let mut sentences = Vec::new();
    let start = since.unwrap_or(0);
    let path = if since.is_some() { directory.second_point_cache() } else { directory.point_cache() };
    let there = pc2::start(&path).ok().filter(|&found| found == start).and_then(|_| pc2::samples(&path).ok());
    let mut cached = start + there.unwrap_or(0);
    if formats.contains(&FrameFormat::Pc2) && cached < first_frame {
        fill_point_cache(directory, mesh, &path, start, first_frame)?;
        cached = first_frame;
        let (name, last) = (path.file_name().unwrap_or_default().display(), first_frame - 1);
        sentences.push(format!("{name}: frames {start} to {last} converted from those in frames/"));
    }
    let last = first_frame - 1;
    let there = |format: FrameFormat| match format {
        FrameFormat::Pc2 => cached > last,
        _ => super::frames::frame_path(&directory.frames(), "frame", last, format).exists(),
    };
    let earlier: Vec<String> = [FrameFormat::Ply, FrameFormat::Obj, FrameFormat::Pc2]
        .into_iter()
        .filter(|&format| there(format))
        .map(|format| format.to_string())
        .collect();
    for &format in formats.iter().filter(|&&format| !there(format)) {
        let earlier = earlier.join(" and ");
        let before = if earlier.is_empty() { "earlier frames are not there" } else { "earlier frames are there as " };
        sentences.push(format!("{format} files begin with frame {first_frame}; {before}{earlier}"));
    }
    Ok(sentences)
}

/// Writes frames `start` to `end - 1` into the point cache `path`, which replaces an existing one only when it is
/// complete.
fn fill_point_cache(
    directory: &RunDirectory,
    mesh: &TriangleMesh,
    path: &Path,
    start: u32,
    end: u32,
) -> Result<(), FramesError> {
    let source = FrameSource::open(directory)?;
    let numbers = source.numbers();
    let from_start = numbers.iter().skip_while(|&&number| number < start);
    let samples = start + (start..).zip(from_start).take_while(|(expected, number)| expected == *number).count() as u32;
    if samples < end {
        return Err(Pc2Error::Gap { path: path.into(), frame: end, samples }.into());
    }
    // A killed conversion leaves a file that the next start sweeps.
    let new = path.with_file_name(".cloth.pc2.part");
    let fill = || -> Result<(), FramesError> {
        let mut cache = Pc2Writer::open_from(&new, mesh.positions.len(), start, start)?;
        for frame in start..end {
            let there = source.read(frame)?;
            if there.positions.len() != mesh.positions.len() || there.triangles != mesh.triangles {
                return Err(FramesError::OtherMesh { folder: directory.frames(), frame });
            }
            cache.write(frame, &there.positions)?;
        }
        std::fs::rename(&new, path).map_err(|error| Pc2Error::from(WriteError::at(path)(error)).into())
    };
    fill().inspect_err(|_| drop(std::fs::remove_file(&new)))
}
