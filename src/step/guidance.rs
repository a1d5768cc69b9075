//! What a step is drawn toward: a motion, how strongly, and what the system holds of it meanwhile.

use serde::{Deserialize, Serialize};

use super::span::Span;
use crate::gpu::DeviceVec;

/// How strongly a step is drawn toward its guide.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Guidance {
    /// Share of the guide's velocity in that of the cloth where no other force acts, 0 to below 1.
    pub weight: f64,
    /// Share of the distance from the guide at the start of the step that the cloth is to have at its end, 0 to 1.
    pub distance_left: f64,
}

/// A motion over one step: positions of the own rows at its start and at its end, xyz, meters.
#[derive(Clone, Debug, PartialEq)]
pub struct Guide {
    /// At the start of the step.
    pub start: Vec<f32>,
    /// At its end.
    pub end: Vec<f32>,
    /// Its strength.
    pub guidance: Guidance,
}

/// The guide of a step under way.
pub(super) struct Guided {
    pub guide: Guide,
    pub step: Span,
    /// alpha.
    pub pull: f64,
    /// alpha m of the own rows, kg.
    pub pulled: DeviceVec<f32>,
    /// Masses of the own rows, kg; those of the system are (1 + alpha) m meanwhile.
    pub masses: DeviceVec<f32>,
    /// v* of the own rows over the current span, xyz, m/s.
    pub wanted: Vec<f32>,
}
