//! Binary USD stages (`.usdc`) with the content of the text ones: one mesh per piece and obstacle, its points as time
//! samples.

use std::path::Path;

use super::crate_file::{
    HEADER_BYTES, SpecType, Structure, Type, Values, array_at, header, inlined, list_head, point_bytes, points_bytes,
};
use super::{Animation, ExportError, Stop, bounds, plain_names, write_frames};

/// `def`, the specifier of prims that are there.
const DEF: u32 = 0;
/// The variability of what has no samples.
const UNIFORM: u32 = 1;

/// Values of a mesh.
struct MeshValues {
    counts: u64,
    indices: u64,
    uv: Option<u64>,
    /// Extents and points of every frame.
    frames: Vec<[u64; 2]>,
}

/// Writes the stage: values that stay, points and extents of every frame, then what names them. Time codes are the
/// numbers of the frames.
pub fn write_usdc(path: &Path, animation: &Animation) -> Result<(), ExportError> {
    let frames = animation.frames();
    let mut fixed = Values::new(HEADER_BYTES);
    let codes: Vec<f64> = frames.iter().map(|&frame| f64::from(frame)).collect();
    let times = fixed.times(&codes);
    let mut all = Vec::new();
    for track in &animation.tracks {
        let mesh = animation.mesh(track, frames[0])?;
        let counts = fixed.integers(&vec![3; mesh.triangles.len()]);
        let indices = fixed.integers(mesh.triangles.as_flattened());
        let has_uv = track.uv.len() == mesh.triangles.len() && !track.uv.is_empty();
        let uv = has_uv.then(|| fixed.vectors(Type::Vec2f, 3 * track.uv.len(), bytemuck::cast_slice(&track.uv)));
        all.push(MeshValues { counts, indices, uv, frames: Vec::with_capacity(frames.len()) });
    }
    let mut end = HEADER_BYTES + fixed.bytes.len() as u64;
    for _ in &frames {
        for (values, track) in all.iter_mut().zip(&animation.tracks) {
            let points = end + points_bytes(2);
            values.frames.push([array_at(Type::Vec3f, end), array_at(Type::Vec3f, points)]);
            end = points + points_bytes(track.vertices.len());
        }
    }
    let (tail, table) = structure(animation, &codes, times, &all, Values::new(end));
    write_frames(path, |out| {
        out.write_all(&header(table))?;
        out.write_all(&fixed.bytes)?;
        for &frame in &frames {
            for points in animation.points(frame)? {
                for list in [&bounds(&points)[..], &points] {
                    out.write_all(&list_head(list.len()))?;
                    out.write_all(point_bytes(list))?;
                }
            }
        }
        out.write_all(&tail).map_err(Stop::from)
    })
}

/// The end of the file, and the place of its table.
fn structure(
    animation: &Animation,
    codes: &[f64],
    times: u64,
    all: &[MeshValues],
    mut values: Values,
) -> (Vec<u8>, u64) {
    let mut parts = Structure::new();
    let names = plain_names(&animation.tracks);
    let rate = values.double(animation.frames_per_s);
    let [first, last] = [codes[0], codes[codes.len() - 1]].map(|code| values.double(code));
    let unit = values.double(1.0);
    let def = inlined(Type::Specifier, DEF);
    let uniform = inlined(Type::Variability, UNIFORM);
    let run = parts.token("run");
    let children = values.tokens(&[run]);
    let up = parts.token_value(if animation.z_up { "Z" } else { "Y" });
    let default = parts.token_value("run");
    let fields = [
        ("defaultPrim", default),
        ("endTimeCode", last),
        ("framesPerSecond", rate),
        ("metersPerUnit", unit),
        ("startTimeCode", first),
        ("timeCodesPerSecond", rate),
        ("upAxis", up),
        ("primChildren", children),
    ];
    parts.spec(0, "", SpecType::Root, &fields);
    let meshes: Vec<u32> = names.iter().map(|name| parts.token(name)).collect();
    let children = values.tokens(&meshes);
    let kind = parts.token_value("Xform");
    parts.spec(1, "run", SpecType::Prim, &[("specifier", def), ("typeName", kind), ("primChildren", children)]);
    for (name, mesh) in names.iter().zip(all) {
        let [extents, points] = [0, 1].map(|which| mesh.frames.iter().map(|frame| frame[which]).collect::<Vec<u64>>());
        let [extents, points] = [extents, points].map(|samples| values.samples(times, &samples));
        let mut attributes = vec![
            ("extent", "float3[]", "timeSamples", extents, None),
            ("faceVertexCounts", "int[]", "default", mesh.counts, None),
            ("faceVertexIndices", "int[]", "default", mesh.indices, None),
            ("orientation", "token", "default", parts.token_value("rightHanded"), Some(("variability", uniform))),
            ("points", "point3f[]", "timeSamples", points, None),
        ];
        if let Some(uv) = mesh.uv {
            let varying = parts.token_value("faceVarying");
            attributes.push(("primvars:st", "texCoord2f[]", "default", uv, Some(("interpolation", varying))));
        }
        let scheme = parts.token_value("none");
        attributes.push(("subdivisionScheme", "token", "default", scheme, Some(("variability", uniform))));
        let properties: Vec<u32> = attributes.iter().map(|attribute| parts.token(attribute.0)).collect();
        let properties = values.tokens(&properties);
        let kind = parts.token_value("Mesh");
        parts.spec(2, name, SpecType::Prim, &[("specifier", def), ("typeName", kind), ("properties", properties)]);
        for (name, kind, field, value, more) in attributes {
            let kind = parts.token_value(kind);
            let mut fields = vec![("typeName", kind), (field, value)];
            fields.extend(more);
            parts.spec(3, name, SpecType::Attribute, &fields);
        }
    }
    let (sections, table) = parts.end(values.start + values.bytes.len() as u64);
    values.bytes.extend(sections);
    (values.bytes, table)
}
