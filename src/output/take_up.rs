//! Prepares a resumed run for frame formats that it has not written before. A point cache is filled from the existing
//! frames; other formats start at the first new frame.

use super::frames::FrameFormat;
use super::pc2::{self, Pc2Error, Pc2Writer};
use super::{FrameSource, FramesError, RunDirectory};

/// Prepares `directory` for frames from `first_frame` on in `formats`. Returns one sentence for each format that will
/// lack earlier frames.
///
/// # Errors
/// A point cache cannot be filled, because earlier frames are missing or damaged.
pub fn take_up_formats(
    directory: &RunDirectory,
    formats: &[FrameFormat],
    first_frame: u32,
) -> Result<Vec<String>, FramesError> {
    let mut sentences = Vec::new();
    let mut cached = pc2::samples(&directory.point_cache()).unwrap_or(0);
    if formats.contains(&FrameFormat::Pc2) && cached < first_frame {
        fill_point_cache(directory, first_frame)?;
        cached = first_frame;
        sentences.push(format!("cloth.pc2: frames 0 to {} converted from those in frames/", first_frame - 1));
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
        sentences.push(format!("{format} files begin with frame {first_frame}; earlier frames are there as {earlier}"));
    }
    Ok(sentences)
}

/// Writes frames 0 to `frames - 1` into the point cache.
fn fill_point_cache(directory: &RunDirectory, frames: u32) -> Result<(), FramesError> {
    let source = FrameSource::open(directory)?;
    let numbers = source.numbers();
    let path = directory.point_cache();
    let whole = (0..).zip(&numbers).take_while(|(expected, number)| expected == *number).count() as u32;
    if whole < frames {
        return Err(Pc2Error::Gap { path, frame: frames, samples: whole }.into());
    }
    let mut cache = Pc2Writer::open(&path, source.read(0)?.positions.len(), 0)?;
    for frame in 0..frames {
        cache.write(frame, &source.read(frame)?.positions)?;
    }
    Ok(())
}
