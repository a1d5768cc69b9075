//! The options of `loomtree run` that split a shot in time.

use std::path::PathBuf;

use clap::Args;
use clap::builder::RangedU64ValueParser;
use serde::{Deserialize, Serialize};

use crate::scene::TimeTable;
pub use crate::scene::{PartitionRule, Recovery, SeamRule};

/// How a shot is split in time [Liang and Lin 2018]. Doc comments are the texts of `--help`.
#[derive(Clone, Debug, PartialEq, Args, Serialize, Deserialize)]
#[serde(default)]
#[command(next_help_heading = "Splitting the shot in time")]
pub struct TimeOptions {
    /// Segments of the shot that are simulated side by side, from states of a coarse run; 1 = an ordinary run
    #[arg(long, value_name = "P", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub segments: u32,
    /// Segments under way at a time, each on --workers processes [default: as many as the cores allow]
    #[arg(long, value_name = "S", value_parser = RangedU64ValueParser::<usize>::new().range(1..=256))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sessions: Option<usize>,
    /// Length of the edges of the coarse run over those of the shot: 2, 4 or 8
    #[arg(long, value_name = "RATIO", default_value_t = 4, value_parser = edge_ratio)]
    pub coarse: u32,
    /// Levels of the shot: 2, or more to split the coarse run in time as well, by a coarser one with edges --coarse
    /// times as long, and so on
    #[arg(long, value_name = "L", default_value_t = 2, value_parser = clap::value_parser!(u32).range(2..=4))]
    #[serde(skip_serializing_if = "is_two")]
    pub levels: u32,
    /// Steps of the shot in a step of the coarse run [default: as many as divide a frame and last 5 ms or less]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coarse_steps: Option<u32>,
    /// Where the shot is cut
    #[arg(long, value_enum, default_value_t)]
    pub partition: PartitionRule,
    /// How a segment finds detail that the coarse run lacks
    #[arg(long, value_enum, default_value_t)]
    pub recovery: Recovery,
    /// Steps of the recovery
    #[arg(long, value_name = "R", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub recovery_steps: u32,
    /// How a segment joins the one before
    #[arg(long, value_enum, default_value_t)]
    pub seam: SeamRule,
    /// Most steps of a hand-over [default: those of 0.5 s]
    #[arg(long, value_name = "B", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub handover_steps: Option<u32>,
    /// Make the segments again from the true ends of those before, this many times; after k sweeps the first k + 1
    /// segments are those of a plain run. Seams are cuts then
    #[arg(long, value_name = "K", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=4095))]
    #[serde(skip_serializing_if = "is_zero")]
    pub sweeps: u32,
    /// Start the segments from the states that this run has kept instead (--keep-states 1), without recovery: true
    /// states give the bits of a plain run
    #[arg(long, value_name = "RUN")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_states: Option<PathBuf>,
    /// First steps of the segments, once they are known. A resumed run is cut alike.
    #[arg(skip)]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cuts: Vec<u32>,
}

impl TimeOptions {
    /// Those of a scene, with defaults for what it does not say.
    pub fn of_scene(table: &TimeTable) -> TimeOptions {
        let default = TimeOptions::default();
        TimeOptions {
            segments: table.segments.unwrap_or(default.segments),
            coarse: table.coarse.unwrap_or(default.coarse),
            levels: table.levels.unwrap_or(default.levels),
            coarse_steps: table.coarse_steps,
            partition: table.partition.unwrap_or(default.partition),
            recovery: table.recovery.unwrap_or(default.recovery),
            recovery_steps: table.recovery_steps.unwrap_or(default.recovery_steps),
            seam: table.seam.unwrap_or(default.seam),
            handover_steps: table.handover_steps,
            sweeps: table.sweeps.unwrap_or(default.sweeps),
            ..default
        }
    }

    /// Whether segments are handed over to each other.
    pub fn hands_over(&self) -> bool {
        self.seam == SeamRule::HandOver && self.sweeps == 0
    }
}

fn is_two(levels: &u32) -> bool {
    *levels == 2
}

fn is_zero(count: &u32) -> bool {
    *count == 0
}

impl Default for TimeOptions {
    fn default() -> TimeOptions {
        TimeOptions {
            segments: 1,
            sessions: None,
            coarse: 4,
            levels: 2,
            coarse_steps: None,
            partition: PartitionRule::default(),
            recovery: Recovery::default(),
            recovery_steps: 10,
            seam: SeamRule::default(),
            handover_steps: None,
            sweeps: 0,
            start_states: None,
            cuts: Vec::new(),
        }
    }
}

fn edge_ratio(text: &str) -> Result<u32, String> {
    match text.parse() {
        Ok(ratio @ (2 | 4 | 8)) => Ok(ratio),
        _ => Err("expected 2, 4 or 8".into()),
    }
}
