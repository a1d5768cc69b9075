//! LightWave's MDD point cache: positions of one mesh at times in seconds, big-endian. It names no triangles.

use std::path::Path;

use super::{Animation, ExportError, Track};
use crate::output::write_atomically;

/// Writes all frames of a track. Header: numbers of frames and points (i32), then the times (f32).
pub fn write_mdd(path: &Path, animation: &Animation, track: &Track) -> Result<(), ExportError> {
    let frames = animation.frames();
    let too_large = |_| ExportError::TooLarge(format!("`{}` has more frames or points than MDD can count", track.name));
    let counts =
        [i32::try_from(frames.len()).map_err(too_large)?, i32::try_from(track.vertices.len()).map_err(too_large)?];
    let mut fault = None;
    let result = write_atomically(path, |out| {
        counts.iter().try_for_each(|count| out.write_all(&count.to_be_bytes()))?;
        frames.iter().try_for_each(|&frame| out.write_all(&(animation.time_s(frame) as f32).to_be_bytes()))?;
        for &frame in &frames {
            match animation.mesh(track, frame) {
                Ok(mesh) => {
                    let values = mesh.positions.iter().flat_map(|p| p.to_array());
                    let bytes: Vec<u8> = values.flat_map(f32::to_be_bytes).collect();
                    out.write_all(&bytes)?;
                }
                Err(error) => {
                    fault = Some(error);
                    return Err(std::io::Error::other("a frame cannot be read"));
                }
            }
        }
        Ok(())
    });
    fault.map_or_else(|| result.map_err(ExportError::Write), Err)
}
