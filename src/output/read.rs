//! Reads frames of a run directory that `output` wrote. Any other bytes give an error.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::frame_mesh::{FrameMesh, ReadError};
use super::frames::{FrameFormat, frame_path};
use super::{RunDirectory, obj, pc2, ply};
use crate::math::{DVec3, Vec3};

/// Why the frames of a run cannot be read.
#[derive(Debug, Error)]
pub enum FramesError {
    /// The directory holds no frames.
    #[error("{} holds no frames: neither frames/frame_*.ply, frames/frame_*.obj nor cloth.pc2 with rest.obj", .0.display())]
    None(PathBuf),
    /// A file could not be opened.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// A file is damaged.
    #[error("{}: {source}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Description of the error.
        source: ReadError,
    },
    /// The point cache is damaged.
    #[error(transparent)]
    PointCache(#[from] pc2::Pc2Error),
    /// A frame that a point cache should take over belongs to another mesh.
    #[error("frame {frame} in {} is of another mesh than the run, so cloth.pc2 cannot take it over; leave out pc2",
        folder.display())]
    OtherMesh {
        /// The folder of the frames.
        folder: PathBuf,
        /// Number of the frame.
        frame: u32,
    },
    /// The point cache belongs to another mesh.
    #[error("{} has {cached} points, but rest.obj has {vertices} vertices", path.display())]
    RestDiffers {
        /// The point cache.
        path: PathBuf,
        /// Points of a frame.
        cached: usize,
        /// Vertices of the rest mesh.
        vertices: usize,
    },
}

/// The frames in a run directory, read one at a time.
#[derive(Debug)]
pub struct FrameSource {
    folder: PathBuf,
    files: BTreeMap<u32, FrameFormat>,
    obstacles: BTreeMap<u32, FrameFormat>,
    /// Point caches with their first frames and their meshes, ascending: of a run that sews there are two.
    point_caches: Vec<(u32, PathBuf, FrameMesh)>,
    /// Frames of the coarse run of a shot that is split in time, for those that are not there yet.
    coarse: Option<Box<FrameSource>>,
    /// Positions are read relative to it.
    origin_m: DVec3,
}

impl FrameSource {
    /// Searches `directory` for frames. PLY is preferred to OBJ, because it is faster to read, and both to the point
    /// cache.
    pub fn open(directory: &RunDirectory) -> Result<FrameSource, FramesError> {
        let folder = directory.frames();
        let mut files = numbered(&folder, "frame_");
        let obstacles = numbered(&folder, "obstacle_");
        let mut point_caches = Vec::new();
        if files.is_empty() {
            let caches = [
                (directory.point_cache(), directory.rest_mesh()),
                (directory.second_point_cache(), directory.second_rest_mesh()),
            ];
            for (cache, rest) in caches.into_iter().filter(|(cache, _)| cache.is_file()) {
                let start = pc2::start(&cache)?;
                let end = start.saturating_add(pc2::samples(&cache)?);
                files.extend((start..end).map(|frame| (frame, FrameFormat::Pc2)));
                point_caches.push((start, cache, read_mesh(&rest, FrameFormat::Obj, DVec3::ZERO)?));
            }
        }
        if files.is_empty() {
            return Err(FramesError::None(directory.path().to_path_buf()));
        }
        Ok(FrameSource { folder, files, obstacles, point_caches, coarse: None, origin_m: DVec3::ZERO })
    }

    /// Like [`FrameSource::open`]; frames that a shot split in time does not have yet are those of its coarse run.
    pub fn open_with_coarse(directory: &RunDirectory) -> Result<FrameSource, FramesError> {
        let coarse = RunDirectory::open(&directory.preview()).ok().and_then(|preview| FrameSource::open(&preview).ok());
        let own = FrameSource::open(directory);
        let Some(mut coarse) = coarse else { return own };
        let own = own.or_else(|error| match error {
            FramesError::None(_) => Ok(FrameSource {
                folder: directory.frames(),
                files: BTreeMap::new(),
                obstacles: BTreeMap::new(),
                point_caches: Vec::new(),
                coarse: None,
                origin_m: DVec3::ZERO,
            }),
            other => Err(other),
        })?;
        coarse.files.retain(|frame, _| !own.files.contains_key(frame));
        let coarse = (!coarse.files.is_empty()).then(|| Box::new(coarse));
        Ok(FrameSource { coarse, ..own })
    }

    /// Whether a frame is one of the coarse run ([`FrameSource::open_with_coarse`]).
    pub fn is_coarse(&self, frame: u32) -> bool {
        self.coarse_of(frame).is_some()
    }

    fn coarse_of(&self, frame: u32) -> Option<&FrameSource> {
        self.coarse.as_deref().filter(|coarse| coarse.files.contains_key(&frame))
    }

    /// The same frames with positions relative to `origin_m`, so that what computes in f32 with them does not lose more
    /// digits than the files have.
    pub fn about(self, origin_m: DVec3) -> FrameSource {
        let coarse = self.coarse.map(|coarse| Box::new(coarse.about(origin_m)));
        FrameSource { origin_m, coarse, ..self }
    }

    /// The frames from this one on.
    pub fn since(mut self, first: u32) -> FrameSource {
        self.files.retain(|frame, _| *frame >= first);
        self.obstacles.retain(|frame, _| *frame >= first);
        self
    }

    /// Numbers of the frames, ascending.
    pub fn numbers(&self) -> Vec<u32> {
        let mut numbers: Vec<u32> = self.files.keys().copied().collect();
        if let Some(coarse) = &self.coarse {
            numbers.extend(coarse.files.keys());
            numbers.sort_unstable();
        }
        numbers
    }

    /// Whether there is such a frame.
    pub fn holds(&self, frame: u32) -> bool {
        self.files.contains_key(&frame) || self.is_coarse(frame)
    }

    /// Reads the cloth of a frame, which must be one of [`FrameSource::numbers`].
    pub fn read(&self, frame: u32) -> Result<FrameMesh, FramesError> {
        if let Some(coarse) = self.coarse_of(frame) {
            return coarse.read(frame);
        }
        match self.point_caches.iter().rev().find(|(start, ..)| *start <= frame) {
            Some((start, path, rest)) => {
                let positions = relative(pc2::read(path, frame - start)?, self.origin_m);
                if positions.len() != rest.positions.len() {
                    let (cached, vertices) = (positions.len(), rest.positions.len());
                    return Err(FramesError::RestDiffers { path: path.clone(), cached, vertices });
                }
                Ok(FrameMesh { positions, triangles: rest.triangles.clone() })
            }
            None => {
                let format = self.files.get(&frame).copied().unwrap_or(FrameFormat::Ply);
                read_mesh(&frame_path(&self.folder, "frame", frame, format), format, self.origin_m)
            }
        }
    }

    /// Reads the obstacles of a frame, if it has any.
    pub fn read_obstacle(&self, frame: u32) -> Result<Option<FrameMesh>, FramesError> {
        if let Some(coarse) = self.coarse_of(frame) {
            return coarse.read_obstacle(frame);
        }
        let Some(format) = self.obstacles.get(&frame) else { return Ok(None) };
        read_mesh(&frame_path(&self.folder, "obstacle", frame, *format), *format, self.origin_m).map(Some)
    }
}

fn relative(mut positions: Vec<Vec3>, origin_m: DVec3) -> Vec<Vec3> {
    positions.iter_mut().for_each(|p| *p = (p.as_dvec3() - origin_m).as_vec3());
    positions
}

fn read_mesh(path: &Path, format: FrameFormat, origin_m: DVec3) -> Result<FrameMesh, FramesError> {
    let bytes = fs::read(path).map_err(|source| FramesError::Io { path: path.to_path_buf(), source })?;
    let mesh = match format {
        FrameFormat::Ply => {
            ply::read(&bytes).map(|mesh| FrameMesh { positions: relative(mesh.positions, origin_m), ..mesh })
        }
        _ => obj::read(&bytes, origin_m),
    };
    mesh.map_err(|source| FramesError::Damaged { path: path.to_path_buf(), source })
}

/// Files `PREFIX<number>.<ply|obj>` of a folder, by number.
fn numbered(folder: &Path, prefix: &str) -> BTreeMap<u32, FrameFormat> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let Some((number, extension)) = name.strip_prefix(prefix).and_then(|rest| rest.split_once('.')) else {
            continue;
        };
        let (Ok(number), Ok(format)) = (number.parse::<u32>(), extension.parse::<FrameFormat>()) else { continue };
        if format == FrameFormat::Ply || !found.contains_key(&number) {
            found.insert(number, format);
        }
    }
    found
}
