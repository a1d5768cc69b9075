//! Errors of topologies: one sentence that names the file and the line, or the number asked for.

use super::parts::MAX_GPUS;

/// Why a topology cannot be read or made.
#[derive(Debug, thiserror::Error)]
pub enum TopologyError {
    /// The file could not be read.
    #[error("cannot read topology file {file}: {source}")]
    Read {
        /// File as the user named it.
        file: String,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The file is not text, not TOML, or not a valid topology.
    #[error("{file}{}: {message}", at_line(*line))]
    Malformed {
        /// File as the user named it.
        file: String,
        /// Line, counting from 1, if one line is to blame.
        line: Option<usize>,
        /// What is wrong and what would be right.
        message: String,
    },
    /// A generated topology of impossible size was asked for.
    #[error("a run can have 1 to {MAX_GPUS} workers, but {gpus} were asked for")]
    GpuCount {
        /// Number of GPUs asked for.
        gpus: usize,
    },
    /// More ranks than the machine has GPUs.
    #[error("topology {name} has {has} GPUs, so it cannot hold {asked} workers: ask for 1 to {has}")]
    TooFewGpus {
        /// Name of the topology.
        name: String,
        /// GPUs that it has.
        has: usize,
        /// Number of workers asked for.
        asked: usize,
    },
}

fn at_line(line: Option<usize>) -> String {
    line.map(|line| format!(", line {line}")).unwrap_or_default()
}
