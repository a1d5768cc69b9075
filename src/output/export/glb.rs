//! Small animations as glTF 2.0 (`.glb`) [Khronos 2021]: a morph target per frame, whose weight is 1 at its time.

use std::io::{self, Write};
use std::path::Path;

use serde_json::{Value, json};

use super::{Animation, ExportError, bounds, plain_names};
use crate::math::Vec3;
use crate::output::write_atomically;

/// Largest file. The weights alone grow with the square of the frames, and viewers hold all targets in memory.
const LARGEST_BYTES: usize = 512 << 20;

/// Writes all tracks and frames. The first frame is the mesh itself.
pub fn write_glb(path: &Path, animation: &Animation) -> Result<(), ExportError> {
    let frames = animation.frames();
    let vertices: usize = animation.tracks.iter().map(|track| track.vertices.len()).sum();
    let bytes = (frames.len() * vertices * 12).saturating_add(4 * frames.len().pow(2) * animation.tracks.len());
    if bytes > LARGEST_BYTES {
        return Err(ExportError::TooLarge(format!(
            "{} frames of {vertices} vertices make {} MiB of morph targets, {} MiB at most are written; usd and pc2 \
             hold such animations",
            frames.len(),
            bytes >> 20,
            LARGEST_BYTES >> 20
        )));
    }
    let mut file = File::default();
    let times: Vec<f32> = frames.iter().map(|&frame| animation.time_s(frame) as f32).collect();
    let ends = [times[0], times[times.len() - 1]];
    let input = file.numbers(&times, "SCALAR", 1, Some([json!([ends[0]]), json!([ends[1]])]));
    let names = plain_names(&animation.tracks);
    let (mut nodes, mut meshes, mut samplers, mut channels) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (i, (track, name)) in animation.tracks.iter().zip(&names).enumerate() {
        let base = animation.mesh(track, frames[0])?;
        let indices = file.indices(base.triangles.as_flattened());
        let positions = file.vectors(&base.positions);
        let mut targets = Vec::new();
        for &frame in &frames[1..] {
            let mesh = animation.mesh(track, frame)?;
            let moved: Vec<Vec3> = mesh.positions.iter().zip(&base.positions).map(|(p, start)| *p - *start).collect();
            targets.push(json!({ "POSITION": file.vectors(&moved) }));
        }
        let mut primitive = json!({ "attributes": { "POSITION": positions }, "indices": indices });
        let mut mesh = json!({ "name": name });
        if !targets.is_empty() {
            let count = targets.len();
            primitive["targets"] = targets.into();
            mesh["weights"] = vec![0.0; count].into();
            // At the time of frame k the weight of target k - 1 is 1 and all others are 0.
            let mut weights = vec![0f32; frames.len() * count];
            (1..frames.len()).for_each(|k| weights[k * count + k - 1] = 1.0);
            let output = file.numbers(&weights, "SCALAR", 1, None);
            samplers.push(json!({ "input": input, "output": output, "interpolation": "LINEAR" }));
            channels.push(json!({ "sampler": samplers.len() - 1, "target": { "node": i, "path": "weights" } }));
        }
        mesh["primitives"] = vec![primitive].into();
        meshes.push(mesh);
        nodes.push(json!({ "name": name, "mesh": i }));
    }
    // glTF is y up: a node above all turns a run whose z points up.
    let top = nodes.len();
    let children: Vec<usize> = (0..top).collect();
    let mut root = json!({ "name": "run", "children": children });
    if animation.z_up {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        root["rotation"] = json!([-half, 0.0, 0.0, half]);
    }
    nodes.push(root);
    let mut document = json!({
        "asset": { "version": "2.0", "generator": format!("loomtree {}", env!("CARGO_PKG_VERSION")) },
        "scene": 0, "scenes": [{ "nodes": [top] }], "nodes": nodes, "meshes": meshes,
        "accessors": file.accessors, "bufferViews": file.views, "buffers": [{ "byteLength": file.bytes.len() }],
    });
    if !channels.is_empty() {
        document["animations"] = json!([{ "name": "run", "samplers": samplers, "channels": channels }]);
    }
    write_atomically(path, |out| write_chunks(out, &document, &file.bytes)).map_err(ExportError::Write)
}

fn write_chunks(out: &mut dyn Write, document: &Value, bytes: &[u8]) -> io::Result<()> {
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let word = |length: usize| (length as u32).to_le_bytes();
    out.write_all(b"glTF")?;
    out.write_all(&2u32.to_le_bytes())?;
    out.write_all(&word(12 + 8 + text.len() + 8 + bytes.len()))?;
    out.write_all(&word(text.len()))?;
    out.write_all(b"JSON")?;
    out.write_all(&text)?;
    out.write_all(&word(bytes.len()))?;
    out.write_all(b"BIN\0")?;
    out.write_all(bytes)
}

/// The binary chunk and what lies in it. All numbers have 4 bytes, so everything is aligned.
#[derive(Default)]
struct File {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl File {
    fn vectors(&mut self, vectors: &[Vec3]) -> usize {
        let ends = bounds(vectors).map(|end| json!(end.to_array()));
        self.numbers(bytemuck::cast_slice(vectors), "VEC3", 3, Some(ends))
    }

    fn numbers(&mut self, numbers: &[f32], kind: &str, width: usize, ends: Option<[Value; 2]>) -> usize {
        const FLOAT: u32 = 5126;
        self.add(bytemuck::cast_slice(numbers), numbers.len() / width, kind, FLOAT, ends)
    }

    fn indices(&mut self, indices: &[u32]) -> usize {
        const UNSIGNED_INT: u32 = 5125;
        self.add(bytemuck::cast_slice(indices), indices.len(), "SCALAR", UNSIGNED_INT, None)
    }

    fn add(&mut self, bytes: &[u8], count: usize, kind: &str, component: u32, ends: Option<[Value; 2]>) -> usize {
        let view = json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() });
        self.bytes.extend_from_slice(bytes);
        self.views.push(view);
        let mut accessor =
            json!({ "bufferView": self.views.len() - 1, "componentType": component, "count": count, "type": kind });
        if let Some([low, high]) = ends {
            accessor["min"] = low;
            accessor["max"] = high;
        }
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }
}
