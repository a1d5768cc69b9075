//! What the code of a rank works with: its device, the other ranks, and the record of what it does. Passed down as one value
//! from the step, or the solve, to whatever computes or exchanges. Owns nothing.

use crate::gpu::Executor;
use crate::telemetry::Recorder;
use crate::transport::Transport;

/// Executor, transport and recorder of one rank, lent for one call.
pub struct RankContext<'a> {
    /// Runs the kernels.
    pub executor: &'a Executor,
    /// Reaches the other ranks.
    pub transport: &'a mut dyn Transport,
    /// Keeps the events; nothing that is computed depends on it.
    pub recorder: &'a mut Recorder,
}
