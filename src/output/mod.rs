//! Output of a run (frames, report, manifest, trace, checkpoints) and figures made from it (pictures, plots, drape).
//!
//! Files appear complete or not at all (`atomic`). This module does not influence the simulation.

mod account;
mod atomic;
pub mod checkpoint;
mod directory;
mod drape;
pub mod export;
mod frame_mesh;
mod frames;
mod hash;
mod machine;
mod manifest;
pub mod obj;
pub mod pc2;
pub mod picture;
pub mod plot;
pub mod ply;
mod read;
mod report;
mod sewing;
mod stretch;
mod take_up;
mod timeline;
mod touching;
mod trace;
mod trace_read;

pub use account::{Account, account};
pub use atomic::{WriteError, check_writable, write_atomically};
pub use checkpoint::Checkpoint;
pub use directory::{DirectoryError, Existing, RunDirectory};
pub use drape::{Drape, drape};
pub use frame_mesh::{FrameMesh, ReadError};
pub use frames::{CacheFormat, FormatError, FormatList, FrameError, FrameFormat, FrameWriter};
pub use hash::scene_fingerprint;
pub use machine::Machine;
pub use manifest::{Input, ManifestError, RunManifest};
pub use read::{FrameSource, FramesError};
pub use report::{
    FrameRecord, LetGoRecord, QueryRecord, Report, ReportError, ReportHeader, ReportWriter, Resumption, SeamRecord,
    SegmentRecord, Status, StepRecord,
};
pub use sewing::{OpenBecause, OpenSeam, SeamGap, StageRecord, Straightened};
pub use stretch::{BeyondLimits, TouchedObstacle, beyond_limit, principal_stretches};
pub use take_up::take_up_formats;
pub use timeline::{Timeline, TimelineBox, timeline_svg, write_timeline};
pub use trace::{RankEvents, TraceWriter};
pub use trace_read::{TraceReadError, read_trace};
