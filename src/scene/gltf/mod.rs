//! Bodies from glTF 2.0 files (`.glb`, `.gltf`): meshes, skins, morph targets and animations. The crate `gltf` reads
//! the container and the JSON; what the bytes mean and every check is here, because a sentence must name what is wrong.
//! Materials, cameras and lights are not looked at.

mod accessor;
mod body;
mod primitive;

use std::path::Path;

use ::gltf::binary::Glb;
use ::gltf::json::{self, Root};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::SceneError;
use crate::input::{Input, Streams};

pub use body::{BodyFile, Clip};
pub(super) use body::{MadeBody, MadeClip};

/// Required extensions that change nothing in the positions of vertices, or that are read.
const KNOWN: [&str; 6] = [
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_texture_basisu",
    "KHR_lights_punctual",
    "EXT_texture_webp",
    "EXT_texture_avif",
];
/// Extensions of materials change no position.
const MATERIALS: &str = "KHR_materials_";
/// Extensions that replace the data of accessors or buffers.
const COMPRESSIONS: [&str; 3] = ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"];

/// The JSON and the bytes of a file.
struct Document {
    root: Root,
    buffers: Vec<Vec<u8>>,
}

/// What is read first, because files of other versions have other forms.
#[derive(serde::Deserialize)]
struct Head {
    asset: Version,
    #[serde(default, rename = "extensionsRequired")]
    required: Vec<String>,
}

#[derive(serde::Deserialize)]
struct Version {
    version: String,
    #[serde(default, rename = "minVersion")]
    least: Option<String>,
}

/// Reads a body. It is checked as a whole, so that a run cannot fail on it later.
///
/// # Errors
/// The file cannot be read, needs an extension that is not known here, or contradicts itself.
pub fn read_body(path: &Path) -> Result<BodyFile, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    let document = Document::read(path).map_err(fault)?;
    BodyFile::new(&document).map_err(fault)
}

impl Document {
    /// An error is half a sentence.
    fn read(path: &Path) -> Result<Document, String> {
        let bytes = bytes_of(path).map_err(|what| format!("cannot be read: {what}"))?;
        let (text, mut binary) = chunks(&bytes)?;
        let broken = |error: serde_json::Error| format!("is not glTF: {error}");
        let head: Head = serde_json::from_slice(text).map_err(broken)?;
        let is_readable = head.asset.version.starts_with("2.")
            && head.asset.least.as_ref().is_none_or(|least| least.starts_with("2.0"));
        if !is_readable {
            let version = head.asset.least.unwrap_or(head.asset.version);
            return Err(format!("has the version {version} of glTF; 2.0 is read"));
        }
        let unknown = |name: &&String| !KNOWN.contains(&name.as_str()) && !name.starts_with(MATERIALS);
        if let Some(name) = head.required.iter().find(unknown) {
            let what = match COMPRESSIONS.contains(&name.as_str()) {
                true => "export the file without compression",
                false => "without it the file cannot be read as it is meant",
            };
            return Err(format!("requires the extension {name}, which is not supported: {what}"));
        }
        let root: Root = serde_json::from_slice(text).map_err(broken)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut buffers = Vec::with_capacity(root.buffers.len());
        for (i, buffer) in root.buffers.iter().enumerate() {
            let bytes = match (&buffer.uri, binary.take()) {
                (Some(uri), kept) => {
                    binary = kept;
                    external(folder, uri).map_err(|what| format!("buffer {i}: {what}"))?
                }
                (None, Some(bytes)) => bytes.to_vec(),
                (None, None) => return Err(format!("buffer {i} has no bytes{}", compression(&root))),
            };
            let needed = buffer.byte_length.0;
            if (bytes.len() as u64) < needed {
                return Err(format!("buffer {i} has {} bytes, {needed} are declared: it is cut off", bytes.len()));
            }
            buffers.push(bytes);
        }
        Ok(Document { root, buffers })
    }
}

/// The end of a sentence about data that is not there, if an extension that is used would have it.
fn compression(root: &Root) -> String {
    match root.extensions_used.iter().find(|name| COMPRESSIONS.contains(&name.as_str())) {
        Some(name) => format!("; {name} is not supported: export the file without compression"),
        None => String::new(),
    }
}

fn bytes_of(path: &Path) -> Result<Vec<u8>, String> {
    let mut input = Input::open(path, Streams::Refused).map_err(|error| error.to_string())?;
    let mut bytes = Vec::new();
    std::io::Read::read_to_end(&mut input.reader, &mut bytes).map_err(|error| error.to_string())?;
    Ok(bytes)
}

/// The JSON and the binary chunk, if there is one. Text alone is JSON.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), String> {
    /// Length of the header and of the smallest first chunk.
    const LEAST: u64 = 20;
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    let word = |at: usize| bytes.get(at..at + 4).map(|w| u32::from_le_bytes([w[0], w[1], w[2], w[3]]));
    match word(4) {
        Some(2) => {}
        Some(version) => return Err(format!("has the version {version} of glTF; 2.0 is read")),
        None => return Err("is cut off within its header".into()),
    }
    let length = word(8).map_or(0, u64::from);
    if length < LEAST || length > bytes.len() as u64 {
        return Err(format!("is cut off: it has {} bytes, and its header says {length}", bytes.len()));
    }
    let Glb { json, bin, .. } =
        Glb::from_slice(&bytes[..length as usize]).map_err(|error| format!("is not binary glTF: {error}"))?;
    match (json, bin) {
        (std::borrow::Cow::Borrowed(json), Some(std::borrow::Cow::Borrowed(bin))) => Ok((json, Some(bin))),
        (std::borrow::Cow::Borrowed(json), _) => Ok((json, None)),
        _ => Err("is not binary glTF".into()),
    }
}

/// The bytes of a buffer outside of the file or within its text.
fn external(folder: &Path, uri: &str) -> Result<Vec<u8>, String> {
    if let Some(data) = uri.strip_prefix("data:") {
        let (_, text) = data.split_once(";base64,").ok_or("its data: URI is not base64")?;
        return STANDARD.decode(text.trim()).map_err(|error| format!("its base64 text is damaged: {error}"));
    }
    if uri.contains("://") {
        return Err(format!("`{uri}` is not a file beside the scene"));
    }
    let name = percent_decoded(uri).ok_or_else(|| format!("`{uri}` is not a file name"))?;
    bytes_of(&folder.join(&name)).map_err(|what| format!("its file `{name}` cannot be read: {what}"))
}

fn percent_decoded(uri: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.as_bytes();
    while let [first, tail @ ..] = rest {
        rest = tail;
        if *first == b'%' {
            let digits = tail.get(..2).and_then(|two| std::str::from_utf8(two).ok())?;
            bytes.push(u8::from_str_radix(digits, 16).ok()?);
            rest = &tail[2..];
        } else {
            bytes.push(*first);
        }
    }
    String::from_utf8(bytes).ok()
}

/// The entry of a list; an error names what refers to it.
fn entry<'a, T>(list: &'a [T], index: &json::Index<T>, kind: &str, of: &str) -> Result<&'a T, String> {
    list.get(index.value()).ok_or_else(|| format!("{of} names {kind} {}, but there are only {}", index, list.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_decoded() {
        assert_eq!(percent_decoded("a%20b%C3%A4.bin").as_deref(), Some("a bä.bin"));
        for wrong in ["a%2", "a%zz", "%ff"] {
            assert_eq!(percent_decoded(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn containers_that_are_cut_off_say_so() {
        let header =
            |version: u32, length: u32| [&b"glTF"[..], &version.to_le_bytes(), &length.to_le_bytes(), &[0; 8]].concat();
        assert!(chunks(b"glTF\x02").unwrap_err().contains("cut off"));
        for length in [0, 11, 12, 21, u32::MAX] {
            assert!(chunks(&header(2, length)).unwrap_err().contains("cut off"), "{length}");
        }
        assert!(chunks(&header(1, 20)).unwrap_err().contains("version 1"));
        assert!(chunks(&header(2, 20)).is_err());
        assert_eq!(chunks(b"{}"), Ok((&b"{}"[..], None)));
    }
}
