//! Frames, reports, traces, checkpoints, pictures. (placeholder)
