//! Impact zones [Li et al. 2020, Sec. 4.3; Tang et al. 2018; Harmon et al. 2008]: impacts that share movable vertices are
//! resolved together, by the smallest change of the end positions (weighted by mass) that puts every pair back on the side
//! it came from.
//!
//! Every rank holds the same [`ImpactZones`] and the same positions of all vertices. Per round of a step: the impacts of all
//! ranks, sorted, go to [`ImpactZones::add`]; [`ImpactZones::owners`] says who solves which zone; each rank calls
//! [`ImpactZones::solve`] for its own; all results together go to [`apply`] on every rank; the pairs of moved vertices are
//! tested again. Rounds end when no impact is left. Nothing here communicates or depends on the number of ranks.
//!
//! The rounds always end: a zone that keeps failing falls back in stages to standing still at the start positions,
//! which are free of penetration. Only imposed vertices (pins, obstacles) that move into it can then still hit:
//! [`Impossible`].

mod constraint;
mod counts;
mod distribute;
mod group;
mod problem;
mod respond;
mod rigid;
pub mod solve;
mod solve_cpu;
mod zones;

pub use counts::{FailSafes, ZoneCounts};
pub use distribute::distribute;
pub use problem::{Row, ZoneBatch, ZoneSpan};
pub use respond::{Moved, Solved, apply};
pub use zones::{ImpactZones, Stage, Zone};

use thiserror::Error;

use crate::math::DVec3;

/// Margin and limits of the solves of zones.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ZoneSettings {
    /// Distance that a resolved pair keeps at the end of the step along the normal of its impact, meters; as many times
    /// that as the pair has hit.
    pub margin_m: f64,
    /// Attempts by descent before the fail-safe begins.
    pub attempts: u32,
    /// Sweeps of a descent at most; an attempt has a few descents.
    pub iterations: u32,
}

impl ZoneSettings {
    /// Settings for a cloth of this thickness: a tenth of it as margin, so that a resolved pair lies where proximity
    /// forces act.
    pub fn for_thickness(thickness_m: f64) -> ZoneSettings {
        ZoneSettings { margin_m: 0.1 * thickness_m, attempts: 10, iterations: 400 }
    }
}

/// One step of all vertices, obstacles included: x, y, z of each.
#[derive(Clone, Copy, Debug)]
pub struct StepPositions<'a> {
    /// Start positions, meters, free of penetration.
    pub x_t0: &'a [f32],
    /// End positions as they stand, meters.
    pub x_t1: &'a [f32],
    /// Inverse masses, 1/kg: one per vertex, 0 for pins and obstacles.
    pub inverse_masses: &'a [f32],
}

impl StepPositions<'_> {
    fn start(&self, vertex: u32) -> DVec3 {
        at(self.x_t0, vertex)
    }

    fn end(&self, vertex: u32) -> DVec3 {
        at(self.x_t1, vertex)
    }
}

fn at(positions: &[f32], vertex: u32) -> DVec3 {
    let x = &positions[3 * vertex as usize..][..3];
    DVec3::new(f64::from(x[0]), f64::from(x[1]), f64::from(x[2]))
}

/// A step that no position of the movable vertices makes free of penetration, as far as the fail-safe can tell: imposed
/// vertices hit each other, or cloth that already follows them or stands still. A shorter step may help.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error(
    "imposed motion cannot be followed without penetration: vertices with imposed motion {imposed:?} against vertices {vertices:?}"
)]
pub struct Impossible {
    /// Movable vertices of the pairs that cannot be resolved, ascending.
    pub vertices: Vec<u32>,
    /// Vertices of infinite mass (pins, obstacles) that they or their zone have hit, ascending. Empty if the start state
    /// touches itself.
    pub imposed: Vec<u32>,
}
