//! How a step is divided into sub-steps: as the scene says, or as the motion at its start asks for.
//!
//! A step much longer than the cloth can follow stretches it without an error: features pass many cells within one
//! linearization, and contacts and impact zones see only the ends of the way. The choice here depends on the state at
//! the start of each part and on the scene, never on the number of ranks: velocities are compared by their bounds,
//! whose minimum and maximum have no rounding.

use super::span::Span;
use super::{Failure, RankCloth, StepStats};
use crate::context::RankContext;
use crate::math::{DIM, DVec3, bounds};
use crate::scene::Substeps;
use crate::telemetry::{Activity, EventName};
use crate::transport::TransportError;

/// Sub-steps that the program chooses are never shorter than this, seconds: the default length of a step. Contacts and
/// impact zones hold there at every speed of the shipped scenes, and shorter steps are made in halves where they do
/// not.
const SHORTEST_S: f64 = 0.004;
/// Farthest relative motion within a sub-step, in cells of the mesh.
const CELLS_MOST: f64 = 0.25;

/// Largest k dt^2 / (rho h^2) of one solve. f32 keeps the rotation of a sheet to eps k dt^2 / (rho h L), which is 2 %
/// at 1e7 in cells of L / 30; but solves to a tolerance of 1e-3 break off from 1e6 on, and a hung sheet crumples.
const STIFFEST: f64 = 5e5;
/// Maximum number of equal parts of a step.
const PARTS_MAX: f64 = 64.0;

impl RankCloth {
    /// Advances over a step, in the sub-steps that `simulation.substeps` asks for.
    pub(super) fn advance_in_parts(
        &mut self,
        rank: &mut RankContext<'_>,
        step: Span,
        stats: &mut StepStats,
    ) -> Result<(), Failure> {
        let (parts, chosen) = match self.settings.substeps {
            Substeps::Auto => (parts_most(step.length_s), true),
            Substeps::Fixed(parts) => (parts, false),
        };
        let mut done = 0;
        while done < parts {
            let next = match chosen && parts > 1 {
                true => done + self.part(rank, step, done, parts)?,
                false => done + 1,
            };
            let part = step.part(done..next, parts);
            let pieces = if chosen { self.pieces(part) } else { 1 };
            for piece in 0..pieces {
                self.advance_over(rank, part.part(piece..piece + 1, pieces), 0, stats)?;
            }
            stats.substeps += pieces;
            done = next;
        }
        Ok(())
    }

    /// Equal pieces in which extremely stiff cloth is advanced over `part`.
    fn pieces(&self, part: Span) -> u32 {
        parts_of_step(self.stiffness_ratio * (part.length_s / self.settings.step_s).powi(2))
    }

    /// Length of the next part in units of the step / `parts`, where `done` of them are behind: a power of two that
    /// divides what is behind.
    fn part(&self, rank: &mut RankContext<'_>, step: Span, done: u32, parts: u32) -> Result<u32, TransportError> {
        let mut length = if done == 0 { parts } else { 1 << done.trailing_zeros() };
        let speed_m_s = self.relative_speed(rank, step.part(done..done + length, parts))?;
        let farthest_m = (CELLS_MOST * self.cell_m).max(self.settings.thickness_m);
        let unit_s = step.length_s / f64::from(parts);
        while length > 1 && speed_m_s * unit_s * f64::from(length) > farthest_m {
            length /= 2;
        }
        Ok(length)
    }

    /// A bound of the speed of any two points of cloth, pins and obstacles relative to each other, m/s: the diagonal of
    /// the box around their velocities. Those of cloth are those of the state at the start of `span`, those of pins and
    /// obstacles their mean over `span`. A cloth that moves as a whole does not count.
    fn relative_speed(&self, rank: &mut RankContext<'_>, span: Span) -> Result<f64, TransportError> {
        let own = self.state.recorded(rank);
        let cloth = own.velocities.as_chunks::<DIM>().0.iter().map(|&v| DVec3::from_array(v.map(f64::from)));
        let pins = self.pins.ways(span.start_s, span.length_s, &self.pin_paths).map(|way| way / span.length_s);
        let (low, high) = bounds(cloth.chain(pins));
        let start = rank.recorder.now();
        let mut all = Vec::new();
        rank.transport.all_gather(&[low.to_array(), high.to_array()].concat(), &mut all)?;
        rank.recorder.end(EventName::AllReduce, Activity::Wait, start, 6 * size_of::<f64>() as u64, 0);
        let of_ranks = all.iter().flat_map(|values| values.as_chunks::<DIM>().0).map(|&v| DVec3::from_array(v));
        let obstacles = self.collisions.iter().flat_map(|collisions| {
            let ways = collisions.obstacle_ways(span.start_s, span.end_s);
            ways.into_iter().map(|way| way / span.length_s)
        });
        let (low, high) = bounds(of_ranks.chain(obstacles));
        Ok((high - low).length())
    }
}

/// Equal parts in which a step is made so that single precision can tell the motion of cloth of this
/// [`crate::model::GlobalModel::stiffness_ratio`]; 1 for all but extremely stiff or finely graded cloth.
pub fn parts_of_step(stiffness_ratio: f64) -> u32 {
    (stiffness_ratio / STIFFEST).sqrt().ceil().clamp(1.0, PARTS_MAX) as u32
}

/// The most sub-steps that the program chooses for a step of this length, a power of two.
fn parts_most(step_s: f64) -> u32 {
    let mut parts = 1;
    while step_s / f64::from(2 * parts) >= SHORTEST_S && parts < 1 << 10 {
        parts *= 2;
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sub_steps_are_not_shorter_than_the_default_step() {
        for (step_s, most) in [(0.0005, 1), (0.004, 1), (0.005, 1), (0.008, 2), (1.0 / 60.0, 4), (1.0 / 24.0, 8)] {
            assert_eq!(parts_most(step_s), most, "{step_s} s");
        }
    }
}
