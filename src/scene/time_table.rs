//! `[time]` of the TOML scene format: how the shot is split in time unless the command line says otherwise.
//! `coordinator` does it.

use serde::{Deserialize, Serialize};

use super::SceneError;
use super::fields::{Fields, Value};

/// Where a shot is cut.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum PartitionRule {
    /// So that all segments take as long, by the counted work of the finished coarse run
    #[default]
    Counted,
    /// Segments of equal length [Liang and Lin 2018, Eq. 3]
    Uniform,
    /// For a constant ratio of the costs of both runs [Liang and Lin 2018, Eq. 5]
    Static,
}

/// How a segment finds detail that the coarse run lacks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Recovery {
    /// It starts earlier and follows the coarse run to the cut
    #[default]
    WarmUp,
    /// Before its first step it goes back and forth over the last step of the coarse run [Liang and Lin 2018, Alg. 2]
    Paper,
    /// It starts from the coarse state as it is
    None,
}

/// How a segment joins the one before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum SeamRule {
    /// Its first steps are made again from the end of the one before, drawn toward it until both are one
    #[default]
    HandOver,
    /// It does not: the motion jumps at the cut
    Cut,
}

/// The options of a split shot that a scene gives; each is that of the command line with the same name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[allow(missing_docs, reason = "they are those of `coordinator::TimeOptions`")]
pub struct TimeTable {
    pub segments: Option<u32>,
    pub coarse: Option<u32>,
    pub levels: Option<u32>,
    pub coarse_steps: Option<u32>,
    pub partition: Option<PartitionRule>,
    pub recovery: Option<Recovery>,
    pub recovery_steps: Option<u32>,
    pub seam: Option<SeamRule>,
    pub handover_steps: Option<u32>,
    pub sweeps: Option<u32>,
}

/// Reads `[time]` from the document `root`.
pub(super) fn time_table(root: &Fields) -> Result<TimeTable, SceneError> {
    let known = [
        "segments",
        "coarse",
        "levels",
        "coarse_steps",
        "partition",
        "recovery",
        "recovery_steps",
        "seam",
        "handover_steps",
        "sweeps",
    ];
    let time = root.table("time", &known)?;
    let whole = |key: &str, range: std::ops::RangeInclusive<u64>| {
        Ok::<_, SceneError>(time.optional(key, |value| value.whole(range))?.map(|number| number as u32))
    };
    let partitions =
        [("counted", PartitionRule::Counted), ("uniform", PartitionRule::Uniform), ("static", PartitionRule::Static)];
    let recoveries = [("warm-up", Recovery::WarmUp), ("paper", Recovery::Paper), ("none", Recovery::None)];
    let seams = [("hand-over", SeamRule::HandOver), ("cut", SeamRule::Cut)];
    let ratio = |value: &Value| match value.whole(2..=8)? {
        ratio @ (2 | 4 | 8) => Ok(ratio as u32),
        ratio => Err(value.error(format!("must be 2, 4 or 8, not {ratio}"))),
    };
    Ok(TimeTable {
        segments: whole("segments", 1..=4096)?,
        coarse: time.optional("coarse", ratio)?,
        levels: whole("levels", 2..=4)?,
        coarse_steps: whole("coarse_steps", 1..=1000)?,
        partition: time.optional("partition", |value| value.choice(&partitions))?,
        recovery: time.optional("recovery", |value| value.choice(&recoveries))?,
        recovery_steps: whole("recovery_steps", 1..=10_000)?,
        seam: time.optional("seam", |value| value.choice(&seams))?,
        handover_steps: whole("handover_steps", 1..=10_000)?,
        sweeps: whole("sweeps", 0..=4095)?,
    })
}
