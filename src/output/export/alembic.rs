//! Alembic archives (`.abc`, Ogawa): one polygon mesh per piece and obstacle, with points that have a sample per frame.
//! Alembic is y up, and its faces go round clockwise.

use std::io::Write;
use std::path::Path;

use super::ogawa::{
    EMPTY_DATA, EMPTY_GROUP, HEADER_BYTES, Number, Property, Tail, header, object_headers, sample_at, sample_bytes,
    sample_head, write_compound,
};
use super::{Animation, ExportError, Stop, bounds, plain_names, write_frames};
use crate::math::Vec3;

/// The version of Alembic whose layout this is.
const ALEMBIC: u32 = 10_812;
/// Metadata that headers name by number, from 1.
const METADATA: [&str; 5] = [
    "interpretation=box",
    "geoScope=vtx;interpretation=point",
    "schema=AbcGeom_PolyMesh_v1;schemaBaseType=AbcGeom_GeomBase_v1",
    "schema=AbcGeom_PolyMesh_v1;schemaBaseType=AbcGeom_GeomBase_v1;schemaObjTitle=AbcGeom_PolyMesh_v1:.geom",
    "geoScope=fvr;interpretation=vector;isGeomParam=true;podExtent=2;podName=float32_t",
];
const BOX: u32 = 1;
const POINTS: u32 = 2;
const MESH: u32 = 3;
const MESH_OBJECT: u8 = 4;
const UV: u32 = 5;

/// Where the samples of a mesh are in the file.
struct Places {
    indices: u64,
    counts: u64,
    uv: Option<u64>,
    /// Box and points of every frame.
    frames: Vec<[u64; 2]>,
}

/// Writes the archive: constant samples, a block of samples per frame, then the groups that name them.
pub fn write_abc(path: &Path, animation: &Animation) -> Result<(), ExportError> {
    let frames = animation.frames();
    let mut constant = Vec::new();
    let mut all: Vec<Places> = Vec::new();
    for track in &animation.tracks {
        let mesh = animation.mesh(track, frames[0])?;
        let mut add = |values: &[u8]| {
            let place = HEADER_BYTES + constant.len() as u64;
            constant.extend(sample_head(values));
            constant.extend(values);
            place
        };
        let indices: Vec<u32> = mesh.triangles.iter().flat_map(|&[a, b, c]| [c, b, a]).collect();
        let indices = add(bytemuck::cast_slice(&indices));
        let counts = add(bytemuck::cast_slice(&vec![3u32; mesh.triangles.len()]));
        let uv: Vec<f32> = track.uv.iter().flat_map(|&[a, b, c]| [c, b, a]).flat_map(|uv| uv.to_array()).collect();
        let has_uv = track.uv.len() == mesh.triangles.len() && !track.uv.is_empty();
        let uv = has_uv.then(|| add(bytemuck::cast_slice(&uv)));
        all.push(Places { indices, counts, uv, frames: Vec::with_capacity(frames.len()) });
    }
    let mut end = HEADER_BYTES + constant.len() as u64;
    for _ in &frames {
        for (places, track) in all.iter_mut().zip(&animation.tracks) {
            let points = end + sample_bytes(BOX_BYTES);
            places.frames.push([end, points]);
            end = points + sample_bytes(12 * track.vertices.len());
        }
    }
    let mut tail = Tail::new(end);
    let root = groups(&mut tail, animation, &all);
    write_frames(path, |out| {
        out.write_all(&header(root))?;
        out.write_all(&constant)?;
        for &frame in &frames {
            for points in animation.points(frame)? {
                write_points(out, y_up(points, animation.z_up))?;
            }
        }
        out.write_all(&tail.bytes).map_err(Stop::from)
    })
}

/// A box is six f64.
const BOX_BYTES: usize = 48;

fn write_points(out: &mut dyn Write, points: Vec<Vec3>) -> Result<(), Stop> {
    let sides: Vec<f64> = bounds(&points).iter().flat_map(|p| p.to_array()).map(f64::from).collect();
    for values in [bytemuck::cast_slice(&sides), bytemuck::cast_slice::<Vec3, u8>(&points)] {
        out.write_all(&sample_head(values))?;
        out.write_all(values)?;
    }
    Ok(())
}

/// The points with y up, exactly.
fn y_up(mut points: Vec<Vec3>, z_up: bool) -> Vec<Vec3> {
    if z_up {
        points.iter_mut().for_each(|p| *p = Vec3::new(p.x, p.z, -p.y));
    }
    points
}

/// Adds all groups; returns the place of the first.
fn groups(tail: &mut Tail, animation: &Animation, all: &[Places]) -> u64 {
    let names = plain_names(&animation.tracks);
    let mut objects = vec![EMPTY_GROUP];
    for places in all {
        objects.push(mesh(tail, places));
    }
    let headers = tail.data(&object_headers(&names, MESH_OBJECT));
    objects.push(headers);
    let objects = tail.group(&objects);
    let [layout, version] = [tail.data(&0u32.to_le_bytes()), tail.data(&ALEMBIC.to_le_bytes())];
    let about = format!(
        "FramesPerTimeUnit={};_ai_AlembicVersion=Alembic 1.8.12;_ai_Application=loomtree {}",
        animation.frames_per_s,
        env!("CARGO_PKG_VERSION")
    );
    let about = tail.data(about.as_bytes());
    let frames = animation.frames();
    let mut times = Vec::new();
    let samplings = [(0, 1.0, 0.0), (frames.len() as u32, 1.0 / animation.frames_per_s, animation.time_s(frames[0]))];
    for (samples, cycle_s, start_s) in samplings {
        times.extend(u32::to_le_bytes(samples));
        times.extend(f64::to_le_bytes(cycle_s));
        times.extend(1u32.to_le_bytes());
        times.extend(f64::to_le_bytes(start_s));
    }
    let times = tail.data(&times);
    let metadata: Vec<u8> =
        METADATA.iter().flat_map(|text| std::iter::once(text.len() as u8).chain(text.bytes())).collect();
    let metadata = tail.data(&metadata);
    tail.group(&[layout, version, objects, about, times, metadata])
}

/// Adds the object of a mesh.
fn mesh(tail: &mut Tail, places: &Places) -> u64 {
    let samples = places.frames.len();
    let property = |name, number, extent, is_array, metadata| Property {
        name,
        is_array,
        number,
        extent,
        samples,
        is_constant: samples == 1,
        metadata,
    };
    let fixed = |property| Property { is_constant: true, ..property };
    let mut headers = Vec::new();
    let mut groups = Vec::new();
    property(".selfBnds", Number::F64, 6, false, BOX).write(&mut headers);
    groups.push(tail.group(&places.frames.iter().map(|[sides, _]| sample_at(*sides)).collect::<Vec<u64>>()));
    property("P", Number::F32, 3, true, POINTS).write(&mut headers);
    // Of an array, the place of its lengths follows; a list without them is one row.
    let points: Vec<u64> = places.frames.iter().flat_map(|[_, points]| [sample_at(*points), EMPTY_DATA]).collect();
    groups.push(tail.group(&points));
    fixed(property(".faceIndices", Number::I32, 1, true, 0)).write(&mut headers);
    groups.push(tail.group(&[sample_at(places.indices), EMPTY_DATA]));
    fixed(property(".faceCounts", Number::I32, 1, true, 0)).write(&mut headers);
    groups.push(tail.group(&[sample_at(places.counts), EMPTY_DATA]));
    if let Some(uv) = places.uv {
        fixed(property("uv", Number::F32, 2, true, UV)).write(&mut headers);
        groups.push(tail.group(&[sample_at(uv), EMPTY_DATA]));
    }
    groups.push(tail.data(&headers));
    let geometry = tail.group(&groups);
    let mut header = Vec::new();
    write_compound(".geom", MESH, &mut header);
    let header = tail.data(&header);
    let properties = tail.group(&[geometry, header]);
    let keys = tail.data(&object_headers(&[], 0));
    tail.group(&[properties, keys])
}
