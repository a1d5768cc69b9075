//! Context of the code of a rank: executor, transport and recorder. The step or the solve passes it down as one value.
//! It owns nothing.

use crate::gpu::Executor;
use crate::telemetry::Recorder;
use crate::transport::Transport;

/// Executor, transport and recorder of one rank, borrowed for one call.
pub struct RankContext<'a> {
    /// Runs the kernels.
    pub executor: &'a Executor,
    /// Reaches the other ranks.
    pub transport: &'a mut dyn Transport,
    /// Records the events. No computed value depends on it.
    pub recorder: &'a mut Recorder,
}
