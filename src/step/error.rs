//! Why a rank could not be set up, or could not make a step.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::transport::TransportError;

/// Why a rank could not be set up.
#[derive(Debug, Error)]
pub enum SetupError {
    /// A vertex with too many neighbours.
    #[error(transparent)]
    RowTooLong(#[from] crate::assembly::RowTooLong),
    /// The preconditioner that was asked for is not to be had on this executor.
    #[error("{0}")]
    Preconditioner(String),
    /// Products without a stored matrix are made by one executor and in one exchange mode alone.
    #[error("products without a stored matrix need the cpu executor and --exchange halo")]
    MatrixFree,
    /// What collisions are to work on does not fit together.
    #[error("collisions: {0}")]
    Collision(String),
    /// The device refused.
    #[error(transparent)]
    Device(#[from] crate::gpu::GpuError),
}

/// What is moved by the scene and cannot give way to cloth.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Imposed {
    /// An obstacle, by its name.
    Obstacle(String),
    /// A pinned vertex, by its global row.
    Pin(u32),
}

/// Why a step failed.
#[derive(Debug, Error)]
pub enum StepError {
    /// A transfer failed: another rank is gone, or the run was told to stop.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A value that is not finite; `vertex` is a global row.
    #[error("step {step}: {quantity} of vertex {vertex} is not finite ({cause}); likely too large: {suspect}")]
    NotFinite { step: u32, vertex: u32, quantity: &'static str, cause: String, suspect: &'static str },
    /// No state without penetration was found at the end of the step.
    #[error("step {step}: the cloth cannot be kept free of penetration")]
    Squeezed { step: u32, imposed: Vec<Imposed> },
    /// Collision detection could not be made.
    #[error("step {step}: collision detection: {message}")]
    Collision { step: u32, message: String },
    /// The solve failed for another reason.
    #[error("step {step}: {cause}")]
    Solve { step: u32, cause: String },
    /// The device failed.
    #[error("step {step}: {message}")]
    Device { step: u32, message: String },
}
