//! Errors of pictures.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use crate::gpu::GpuError;
use crate::output::{FramesError, WriteError};

/// Why pictures, or some of them, cannot be drawn.
#[derive(Debug, Error)]
pub enum PictureError {
    /// A frame cannot be read.
    #[error(transparent)]
    Frames(#[from] FramesError),
    /// The device cannot draw.
    #[error("{0}; --executor cpu draws without it")]
    Gpu(#[from] GpuError),
    /// A picture cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The folder for pictures cannot be made.
    #[error("cannot make {}: {source}", path.display())]
    Folder {
        /// Path of the folder.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A name of a file that says nothing of what it shall be.
    #[error("{0}")]
    Name(String),
    /// A coloring that is not known for a frame.
    #[error("frame {frame}: {what}")]
    Values {
        /// The frame.
        frame: u32,
        /// Why it is not known.
        what: String,
    },
    /// No frame has a vertex that a camera could see.
    #[error("frames {first} to {last} have no vertex with finite coordinates, so there is nothing to draw")]
    NothingToSee {
        /// First frame asked for.
        first: u32,
        /// Last frame asked for.
        last: u32,
    },
}
