//! Untangling: moves cloth that crosses itself, other cloth or an obstacle at the start, until the exact check finds
//! nothing or progress stops. `regions.rs` decides which parts of a surface are on the wrong side, `push.rs` moves
//! them.
//!
//! It sees one state only, so it must guess the wrong side: the smaller part of a piece that another surface cuts in
//! two, or the part inside a closed obstacle [Baraff et al. 2003]. It guarantees neither success nor a state that the
//! fabric would take by itself. The result is the same on any number of threads.

mod push;
mod regions;
mod tangle;
mod targets;

use super::{Group, GroupKind, crossings};
use crate::math::{DVec3, Vec3};
use regions::Shape;
pub use tangle::Tangle;

/// Limit of the rounds of checking and pushing.
const ROUNDS: usize = 200;
/// Untangling ends after this many rounds without a new minimum of crossing pairs.
const PATIENCE: usize = 30;

/// Smoothing moves the displacement of a vertex by this fraction toward the mean of its neighbors' displacements.
const SMOOTHING: f64 = 0.5;

/// Result of an untangling.
#[derive(Clone, Debug, PartialEq)]
pub struct Untangled {
    /// The positions with the fewest crossing pairs; no pair crosses if `left` is empty.
    pub positions: Vec<Vec3>,
    /// The pairs that cross or touch at these positions, as [`crossings`] lists them.
    pub left: Vec<[u32; 2]>,
    /// Crossing pairs at the start.
    pub pairs_before: usize,
    /// Rounds that led to `positions`.
    pub rounds: usize,
}

impl Tangle<'_> {
    /// Moves crossing parts by short distances until nothing crosses or the rounds bring no progress.
    pub fn untangle(&self, positions: &[Vec3]) -> Untangled {
        // Pushing can bend a flat sheet, so it is checked against itself afterwards.
        let bent = |group: &Group| match group.kind {
            GroupKind::FlatCloth => Group { kind: GroupKind::Cloth, ..group.clone() },
            _ => group.clone(),
        };
        let groups: Vec<Group> = self.groups.iter().map(bent).collect();
        let mut left = crossings(positions, self.triangles, &groups);
        let mut best =
            Untangled { positions: positions.to_vec(), pairs_before: left.len(), left: left.clone(), rounds: 0 };
        if left.is_empty() {
            return best;
        }
        let shape = Shape::new(positions, self.triangles, &groups);
        let mut now = positions.to_vec();
        for round in 1..=ROUNDS {
            let moves = push::moves(&now, self, &shape, &left);
            for (position, by) in now.iter_mut().zip(&moves) {
                if *by != DVec3::ZERO {
                    *position = (position.as_dvec3() + *by).as_vec3();
                }
            }
            self.smooth(positions, &mut now, &shape, &left);
            left = crossings(&now, self.triangles, &groups);
            // Full lists cannot be compared, because they may be incomplete.
            if left.len() < best.left.len()
                || (left.len() == best.left.len() && left.len() >= super::crossings::MOST_PAIRS)
            {
                (best.positions, best.left, best.rounds) = (now.clone(), left.clone(), round);
            }
            if best.left.is_empty() || round - best.rounds >= PATIENCE || moves.iter().all(|by| *by == DVec3::ZERO) {
                break;
            }
        }
        best
    }

    /// Smooths the displacements from `start` where a piece crosses itself, because such a place has mostly been
    /// crumpled by pushing.
    fn smooth(&self, start: &[Vec3], now: &mut [Vec3], shape: &Shape, pairs: &[[u32; 2]]) {
        let piece = |t: &u32| shape.piece[self.triangles[*t as usize][0] as usize];
        let itself = pairs.iter().filter(|[s, t]| piece(s) == piece(t)).flatten();
        let mut near: Vec<u32> = itself.flat_map(|&t| self.triangles[t as usize]).collect();
        near.sort_unstable();
        near.dedup();
        let way = |now: &[Vec3], v: u32| now[v as usize].as_dvec3() - start[v as usize].as_dvec3();
        let even = |&v: &u32| {
            let (sum, count) = shape.neighbors(v).fold((DVec3::ZERO, 0.0), |(sum, n), w| (sum + way(now, w), n + 1.0));
            way(now, v).lerp(sum / count, SMOOTHING)
        };
        let ways: Vec<DVec3> = near.iter().map(even).collect();
        for (&v, way) in near.iter().zip(ways).filter(|(v, _)| self.movable[**v as usize]) {
            now[v as usize] = (start[v as usize].as_dvec3() + way).as_vec3();
        }
    }
}
