//! Writes the frames of a run in the requested formats. Vertex order and triangles are those of the mesh.

use std::borrow::Cow;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::RunDirectory;
use super::atomic::{WriteError, write_atomically};
use super::obj::{self, TextureCoordinates};
use super::pc2::{Pc2Error, Pc2Writer};
use super::ply;
use crate::math::{DVec3, Vec3};
use crate::mesh::{Part, TriangleMesh};

/// A file format of frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FrameFormat {
    /// Wavefront OBJ: one text file per frame, with material coordinates.
    Obj,
    /// Binary little-endian PLY: one file per frame.
    Ply,
    /// One PC2 point cache for the whole run, with `rest.obj`.
    Pc2,
}

/// A format that is made from the frames when a run ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CacheFormat {
    /// A USD stage as text.
    Usd,
    /// A binary USD stage.
    Usdc,
    /// An Alembic archive.
    Abc,
    /// LightWave's point cache, a file per mesh.
    Mdd,
    /// VTK grids for ParaView.
    Vtu,
    /// Binary glTF.
    Glb,
}

impl CacheFormat {
    const ALL: [(CacheFormat, &'static str); 6] = [
        (CacheFormat::Usd, "usd"),
        (CacheFormat::Usdc, "usdc"),
        (CacheFormat::Abc, "abc"),
        (CacheFormat::Mdd, "mdd"),
        (CacheFormat::Vtu, "vtu"),
        (CacheFormat::Glb, "glb"),
    ];

    /// Its name in `--format` and `--to`.
    pub fn name(self) -> &'static str {
        CacheFormat::ALL[self as usize].1
    }

    fn named(text: &str) -> Option<CacheFormat> {
        let text = text.trim().to_ascii_lowercase();
        CacheFormat::ALL.into_iter().find(|(_, name)| *name == text).map(|(format, _)| format)
    }
}

/// Why a `--format` value is invalid.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum FormatError {
    /// An unknown format.
    #[error(
        "--format {0:?} is unknown; valid are obj, ply, pc2, usd, usdc, abc, mdd, vtu and glb (separated by commas)"
    )]
    Unknown(String),
    /// The list is empty.
    #[error("--format is empty; name at least one of obj, ply, pc2, usd, usdc, abc, mdd, vtu and glb")]
    Empty,
}

impl FromStr for FrameFormat {
    type Err = FormatError;
    fn from_str(text: &str) -> Result<FrameFormat, FormatError> {
        match text.trim().to_ascii_lowercase().as_str() {
            "obj" => Ok(FrameFormat::Obj),
            "ply" => Ok(FrameFormat::Ply),
            "pc2" => Ok(FrameFormat::Pc2),
            "" => Err(FormatError::Empty),
            _ => Err(FormatError::Unknown(text.trim().to_string())),
        }
    }
}

impl fmt::Display for FrameFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            FrameFormat::Obj => "obj",
            FrameFormat::Ply => "ply",
            FrameFormat::Pc2 => "pc2",
        })
    }
}

/// A list of formats, separated by commas in text: those of frames, of which there is at least one, and those that are
/// made from the frames at the end. Repetitions are dropped.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct FormatList(pub Vec<FrameFormat>, pub Vec<CacheFormat>);

impl FromStr for FormatList {
    type Err = FormatError;
    fn from_str(list: &str) -> Result<FormatList, FormatError> {
        let (mut formats, mut caches) = (Vec::new(), Vec::new());
        for text in list.split(',') {
            match CacheFormat::named(text) {
                Some(cache) if caches.contains(&cache) => {}
                Some(cache) => caches.push(cache),
                None => {
                    let format = text.parse()?;
                    if !formats.contains(&format) {
                        formats.push(format);
                    }
                }
            }
        }
        // What is made from frames needs frames.
        if formats.is_empty() {
            formats.push(FrameFormat::Ply);
        }
        Ok(FormatList(formats, caches))
    }
}

impl TryFrom<String> for FormatList {
    type Error = FormatError;
    fn try_from(list: String) -> Result<FormatList, FormatError> {
        list.parse()
    }
}

impl fmt::Display for FormatList {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let files = self.0.iter().map(FrameFormat::to_string);
        let names: Vec<String> = files.chain(self.1.iter().map(|cache| cache.name().to_owned())).collect();
        f.write_str(&names.join(","))
    }
}

impl From<FormatList> for String {
    fn from(list: FormatList) -> String {
        list.to_string()
    }
}

/// Why a frame was not written. Earlier frames are complete.
#[derive(Debug, Error)]
pub enum FrameError {
    /// The operating system reported an error.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The point cache does not match the run.
    #[error(transparent)]
    PointCache(#[from] Pc2Error),
    /// A position is not finite, and no reader would accept it.
    #[error("frame {frame} is not written: position of vertex {vertex} is {position} (not a finite number)")]
    NotFinite {
        /// Number of the frame.
        frame: u32,
        /// First vertex with such a position.
        vertex: usize,
        /// Its position, meters.
        position: Vec3,
    },
    /// The number of positions does not match the mesh.
    #[error("frame {frame} is not written: {got} positions for a mesh of {expected} vertices")]
    WrongCount {
        /// Number of the frame.
        frame: u32,
        /// Vertices of the mesh.
        expected: usize,
        /// Number of positions given.
        got: usize,
    },
}

/// Writes frames into a run directory.
pub struct FrameWriter {
    folder: PathBuf,
    files: Vec<FrameFormat>,
    texture: Option<TextureCoordinates>,
    /// Objects and groups of the mesh, for OBJ files.
    parts: Vec<Part>,
    point_cache: Option<Pc2Writer>,
    vertices: usize,
    /// Positions are relative to it.
    origin_m: DVec3,
    buffer: Vec<u8>,
}

impl FrameWriter {
    /// A writer for the frames of `mesh` from `first_frame` on (0 unless the run is resumed).
    pub fn new(
        directory: &RunDirectory,
        formats: &[FrameFormat],
        mesh: &TriangleMesh,
        first_frame: u32,
    ) -> Result<FrameWriter, FrameError> {
        FrameWriter::with_parts(directory, formats, mesh, &[], DVec3::ZERO, first_frame)
    }

    /// Like [`FrameWriter::new`], but OBJ files also name the objects and groups of the mesh, and the positions of mesh,
    /// frames and obstacles are relative to `origin_m`. Files hold world coordinates.
    pub fn with_parts(
        directory: &RunDirectory,
        formats: &[FrameFormat],
        mesh: &TriangleMesh,
        parts: &[Part],
        origin_m: DVec3,
        first_frame: u32,
    ) -> Result<FrameWriter, FrameError> {
        FrameWriter::of_stage(directory, formats, mesh, parts, origin_m, None, first_frame)
    }

    /// Like [`FrameWriter::with_parts`] for the frames of the second stage of a run that sews. `since`: the first of
    /// them; none for the first stage. The second stage has a point cache and a rest mesh of its own.
    pub fn of_stage(
        directory: &RunDirectory,
        formats: &[FrameFormat],
        mesh: &TriangleMesh,
        parts: &[Part],
        origin_m: DVec3,
        since: Option<u32>,
        first_frame: u32,
    ) -> Result<FrameWriter, FrameError> {
        let texture = formats
            .iter()
            .any(|format| *format != FrameFormat::Ply)
            .then(|| TextureCoordinates::new(mesh.positions.len(), &mesh.triangles, &mesh.material_uv));
        let files = formats.iter().copied().filter(|format| *format != FrameFormat::Pc2).collect();
        let mut point_cache = None;
        if formats.contains(&FrameFormat::Pc2) {
            let (rest, cache) = match since {
                None => (directory.rest_mesh(), directory.point_cache()),
                Some(_) => (directory.second_rest_mesh(), directory.second_point_cache()),
            };
            write_atomically(&rest, |out| {
                obj::write(out, &mut Vec::new(), origin_m, &mesh.positions, &mesh.triangles, texture.as_ref(), parts)
            })?;
            let points = mesh.positions.len();
            point_cache = Some(Pc2Writer::open_from(&cache, points, since.unwrap_or(0), first_frame)?);
        }
        let vertices = mesh.positions.len();
        let (folder, parts) = (directory.frames(), parts.to_vec());
        Ok(FrameWriter { folder, files, texture, parts, point_cache, vertices, origin_m, buffer: Vec::new() })
    }

    /// Writes one frame of the cloth. `mesh` must be the mesh that the writer was created for. Only its triangles are
    /// used.
    pub fn write(&mut self, frame: u32, mesh: &TriangleMesh, positions: &[Vec3]) -> Result<(), FrameError> {
        check(frame, self.vertices, positions)?;
        for format in &self.files {
            let path = frame_path(&self.folder, "frame", frame, *format);
            write_file(
                &path,
                *format,
                &mut self.buffer,
                self.origin_m,
                positions,
                &mesh.triangles,
                self.texture.as_ref(),
                &self.parts,
            )?;
        }
        if let Some(cache) = &mut self.point_cache {
            cache.write(frame, &in_world(positions, self.origin_m))?;
        }
        Ok(())
    }

    /// Writes the obstacles of one frame beside the cloth. With the point cache format they are written as PLY.
    pub fn write_obstacle(&mut self, frame: u32, positions: &[Vec3], triangles: &[[u32; 3]]) -> Result<(), FrameError> {
        check(frame, positions.len(), positions)?;
        let formats = if self.files.is_empty() { &[FrameFormat::Ply][..] } else { &self.files };
        for format in formats {
            let path = frame_path(&self.folder, "obstacle", frame, *format);
            write_file(&path, *format, &mut self.buffer, self.origin_m, positions, triangles, None, &[])?;
        }
        Ok(())
    }
}

/// `FOLDER/KIND_%06d.EXT`.
pub(super) fn frame_path(folder: &Path, kind: &str, frame: u32, format: FrameFormat) -> PathBuf {
    folder.join(format!("{kind}_{frame:06}.{format}"))
}

/// World positions, rounded to f32.
fn in_world(positions: &[Vec3], origin_m: DVec3) -> Cow<'_, [Vec3]> {
    if origin_m == DVec3::ZERO {
        return Cow::Borrowed(positions);
    }
    Cow::Owned(positions.iter().map(|p| (p.as_dvec3() + origin_m).as_vec3()).collect())
}

fn check(frame: u32, expected: usize, positions: &[Vec3]) -> Result<(), FrameError> {
    if positions.len() != expected {
        return Err(FrameError::WrongCount { frame, expected, got: positions.len() });
    }
    match positions.iter().position(|p| !p.is_finite()) {
        Some(vertex) => Err(FrameError::NotFinite { frame, vertex, position: positions[vertex] }),
        None => Ok(()),
    }
}

fn write_file(
    path: &Path,
    format: FrameFormat,
    buffer: &mut Vec<u8>,
    origin_m: DVec3,
    positions: &[Vec3],
    triangles: &[[u32; 3]],
    texture: Option<&TextureCoordinates>,
    parts: &[Part],
) -> Result<(), WriteError> {
    write_atomically(path, |out| match format {
        FrameFormat::Obj => obj::write(out, buffer, origin_m, positions, triangles, texture, parts),
        FrameFormat::Ply => ply::write(out, buffer, &in_world(positions, origin_m), triangles),
        FrameFormat::Pc2 => Ok(()),
    })
}
