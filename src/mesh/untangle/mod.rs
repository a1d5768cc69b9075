//! Moves cloth that crosses itself, other cloth or an obstacle at the start until the exact check finds nothing, or as far
//! as it goes: `regions.rs` says what of a surface is on the wrong side, `push.rs` moves it.
//!
//! Looks at one state only, so "wrong" is a guess: the smaller part of a piece that another surface cuts in two, or what
//! is inside a closed obstacle [Baraff et al. 2003]. Does not promise success, nor a state that a fabric would take by
//! itself. The same result on any number of threads.

mod push;
mod regions;
mod tangle;
mod targets;

use super::{Group, GroupKind, crossings};
use crate::math::{DVec3, Vec3};
use regions::Shape;
pub use tangle::Tangle;

/// Most rounds of checking and pushing.
const ROUNDS: usize = 200;
/// Ends after so many rounds without fewer pairs than ever before.
const PATIENCE: usize = 30;

/// How far the way of a vertex goes towards the mean of its neighbors' where it is evened out.
const SMOOTHING: f64 = 0.5;

/// How far it went.
#[derive(Clone, Debug, PartialEq)]
pub struct Untangled {
    /// Positions with the fewest crossing pairs that were reached; without any if `left` is empty.
    pub positions: Vec<Vec3>,
    /// The pairs that cross or touch in them, as [`crossings`] lists them.
    pub left: Vec<[u32; 2]>,
    /// Pairs at the start.
    pub pairs_before: usize,
    /// Rounds of pushing behind `positions`.
    pub rounds: usize,
}

impl Tangle<'_> {
    /// Moves the vertices that must move, none far from where it is, until nothing crosses or no round brings progress.
    pub fn untangle(&self, positions: &[Vec3]) -> Untangled {
        // What was flat is not once it has been pushed.
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
            // Lists that are full say nothing about progress.
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

    /// Evens out the ways from `start` where a piece crosses itself: mostly it has been crumpled by pushing.
    fn smooth(&self, start: &[Vec3], now: &mut [Vec3], shape: &Shape, pairs: &[[u32; 2]]) {
        let piece = |t: &u32| shape.piece[self.triangles[*t as usize][0] as usize];
        let itself = pairs.iter().filter(|[s, t]| piece(s) == piece(t)).flatten();
        let mut near: Vec<u32> = itself.flat_map(|&t| self.triangles[t as usize]).collect();
        near.sort_unstable();
        near.dedup();
        let way = |now: &[Vec3], v: u32| now[v as usize].as_dvec3() - start[v as usize].as_dvec3();
        let even = |&v: &u32| {
            let (sum, count) = shape.neighbours(v).fold((DVec3::ZERO, 0.0), |(sum, n), w| (sum + way(now, w), n + 1.0));
            way(now, v).lerp(sum / count, SMOOTHING)
        };
        let ways: Vec<DVec3> = near.iter().map(even).collect();
        for (&v, way) in near.iter().zip(ways).filter(|(v, _)| self.movable[**v as usize]) {
            now[v as usize] = (start[v as usize].as_dvec3() + way).as_vec3();
        }
    }
}
