//! USD stages as text (`.usda`): one mesh per piece and obstacle, its points as time samples.

use std::fmt::Write as _;
use std::io::{self, Write};
use std::path::Path;

use super::{Animation, ExportError, Track, bounds, plain_names};
use crate::math::Vec3;
use crate::output::write_atomically;

/// Writes the stage. Time codes are the numbers of the frames. Numbers have the digits that read back to the same f32.
pub fn write_usda(path: &Path, animation: &Animation) -> Result<(), ExportError> {
    let frames = animation.frames();
    let (first, last) = (frames[0], frames[frames.len() - 1]);
    let mut fault = None;
    let result = write_atomically(path, |out| {
        let rate = animation.frames_per_s;
        let up = if animation.z_up { 'Z' } else { 'Y' };
        write!(
            out,
            "#usda 1.0\n(\n    defaultPrim = \"run\"\n    endTimeCode = {last}\n    framesPerSecond = {rate}\n    \
             metersPerUnit = 1\n    startTimeCode = {first}\n    timeCodesPerSecond = {rate}\n    \
             upAxis = \"{up}\"\n)\n\ndef Xform \"run\"\n{{\n"
        )?;
        for (track, name) in animation.tracks.iter().zip(plain_names(&animation.tracks)) {
            if let Err(error) = write_track(out, animation, track, &name, &frames)? {
                fault = Some(error);
                return Err(io::Error::other("a frame cannot be read"));
            }
        }
        out.write_all(b"}\n")
    });
    fault.map_or_else(|| result.map_err(ExportError::Write), Err)
}

/// The outer error is that of the file, the inner one that of a frame.
fn write_track(
    out: &mut dyn Write,
    animation: &Animation,
    track: &Track,
    name: &str,
    frames: &[u32],
) -> io::Result<Result<(), ExportError>> {
    let mesh = match animation.mesh(track, frames[0]) {
        Ok(mesh) => mesh,
        Err(error) => return Ok(Err(error)),
    };
    let counts = list(mesh.triangles.iter().map(|_| "3"));
    let indices = list(mesh.triangles.iter().flatten());
    write!(
        out,
        "    def Mesh \"{name}\"\n    {{\n        int[] faceVertexCounts = [{counts}]\n        \
         int[] faceVertexIndices = [{indices}]\n        uniform token orientation = \"rightHanded\"\n        \
         uniform token subdivisionScheme = \"none\"\n"
    )?;
    if track.uv.len() == mesh.triangles.len() && !track.uv.is_empty() {
        let uv = list(track.uv.iter().flatten().map(|uv| format!("({}, {})", uv.x, uv.y)));
        writeln!(
            out,
            "        texCoord2f[] primvars:st = [{uv}] (\n            interpolation = \"faceVarying\"\n        )"
        )?;
    }
    let vector = |p: &Vec3| format!("({}, {}, {})", p.x, p.y, p.z);
    let mut extents = String::new();
    out.write_all(b"        point3f[] points.timeSamples = {\n")?;
    for &frame in frames {
        let positions = match animation.mesh(track, frame) {
            Ok(mesh) => mesh.positions,
            Err(error) => return Ok(Err(error)),
        };
        let [low, high] = bounds(&positions);
        // Writing to a String cannot fail.
        let _ = writeln!(extents, "            {frame}: [{}, {}],", vector(&low), vector(&high));
        writeln!(out, "            {frame}: [{}],", list(positions.iter().map(vector)))?;
    }
    write!(out, "        }}\n        float3[] extent.timeSamples = {{\n{extents}        }}\n    }}\n")?;
    Ok(Ok(()))
}

/// Values separated by commas.
fn list(values: impl Iterator<Item = impl std::fmt::Display>) -> String {
    let mut text = String::new();
    for value in values {
        if !text.is_empty() {
            text.push_str(", ");
        }
        // Writing to a String cannot fail.
        let _ = write!(text, "{value}");
    }
    text
}
