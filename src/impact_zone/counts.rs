//! What impact zones did in a step, as `report.json` has it. The counts are the same on every rank, iterations
//! excepted.

use serde::{Deserialize, Serialize};

/// Counts of a step or of a part of one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ZoneCounts {
    /// Zones at the end.
    pub zones: u64,
    /// Impacts of all rounds.
    pub impacts: u64,
    /// Rounds of continuous detection that found impacts.
    #[serde(rename = "zone_rounds")]
    pub rounds: u32,
    /// Vertices of the largest zone.
    #[serde(rename = "largest_zone")]
    pub largest: u64,
    /// Descent iterations of the zones that this rank solved; in a report those of all ranks. Counted by the caller of
    /// [`super::ImpactZones::solve`].
    #[serde(rename = "zone_iterations")]
    pub iterations: u64,
    /// Times that a zone fell back to a fail-safe.
    pub fail_safes: u64,
    /// Times that the step was cut in two because nothing else helped. Counted by the step.
    pub halvings: u32,
}

impl ZoneCounts {
    /// Adds the counts of another part of the same step.
    pub fn add(&mut self, part: &ZoneCounts) {
        self.zones += part.zones;
        self.impacts += part.impacts;
        self.rounds += part.rounds;
        self.largest = self.largest.max(part.largest);
        self.iterations += part.iterations;
        self.fail_safes += part.fail_safes;
        self.halvings += part.halvings;
    }
}

/// How often zones fell back to which fail-safe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FailSafes {
    /// Times that a zone was to move as a rigid body.
    pub rigid: u64,
    /// Times that a zone's motion was scaled down.
    pub scaled: u64,
    /// Times that a zone was made to stand still.
    pub still: u64,
}

impl FailSafes {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.rigid + self.scaled + self.still
    }
}
