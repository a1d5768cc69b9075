//! New end positions of zones, by the stage that each has reached.

use bytemuck::{Pod, Zeroable};

use super::constraint::{Constraint, all_met, margins};
use super::distribute::distribute;
use super::problem::{IMMOVABLE, Row, ZoneBatch};
use super::rigid::{self, MovingPoint, RigidMotion};
use super::solve::{ZoneResult, solve};
use super::zones::{ImpactZones, Stage, Zone};
use super::{StepPositions, at};
use crate::collision::elementary::ccd;
use crate::collision::{Candidate, Impact};
use crate::gpu::{CpuExecutor, Executor};
use crate::math::{DVec3, Vec3};

/// Solves per attempt: between them the zone's own pairs are tested along the new paths, and those that still hit get a
/// constraint from there. Saves rounds, in which all ranks meet.
const PASSES: u32 = 6;
/// Pairs that one thread tests at least.
const GRAIN: usize = 256;
/// Error of a constraint that ends a descent, in margins: what is left of the margin is free of penetration.
const TOLERANCE: f64 = 0.1;

/// A vertex and its new end position. Ranks exchange these.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Moved {
    /// Vertex in the global order.
    pub vertex: u32,
    /// Position at the end of the step, meters.
    pub position: [f32; 3],
}

/// Result of solving some zones.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Solved {
    /// New end positions of all their vertices, zone by zone.
    pub moved: Vec<Moved>,
    /// Iterations of all descents.
    pub iterations: u64,
    /// Zones whose last descent ended at the limit on iterations.
    pub unconverged: u64,
}

/// Writes new end positions into `x_t1` (x, y, z of every vertex).
pub fn apply(moved: &[Moved], x_t1: &mut [f32]) {
    for one in moved {
        x_t1[3 * one.vertex as usize..][..3].copy_from_slice(&one.position);
    }
}

/// A zone whose constraints are being solved by descent.
struct Descent<'a> {
    zone: &'a Zone,
    /// Of the zone, and those found between passes, with their multipliers; by pair, and in the order they were found.
    constraints: Vec<(Constraint, f64)>,
    positions: Vec<[f32; 3]>,
    converged: bool,
}

impl ImpactZones {
    /// The rank that solves each of the [`ImpactZones::active`] zones: evenly by size.
    pub fn owners(&self, ranks: usize) -> Vec<u32> {
        let sizes: Vec<u64> = self.active().iter().map(|&zone| self.zones[zone as usize].size()).collect();
        distribute(&sizes, ranks)
    }

    /// The active zones that `rank` solves.
    pub fn share(&self, rank: usize, ranks: usize) -> Vec<u32> {
        let owned = self.active().iter().zip(self.owners(ranks));
        owned.filter(|(_, owner)| *owner as usize == rank).map(|(&zone, _)| zone).collect()
    }

    /// New end positions of the vertices of zones `which`. A zone's result depends on that zone alone, not on where or with
    /// which others it is solved, or on how many of the `host`'s threads. On a device, ask [`Executor::take_fault`] afterwards.
    pub fn solve(&self, executor: &Executor, host: &CpuExecutor, step: &StepPositions, which: &[u32]) -> Solved {
        let mut solved = Solved::default();
        let mut descents = Vec::new();
        for zone in which.iter().map(|&zone| &self.zones[zone as usize]) {
            match self.stage(zone) {
                Stage::Descent(_) => descents.push(Descent {
                    zone,
                    constraints: zone.constraints.iter().map(|&constraint| (constraint, 0.0)).collect(),
                    positions: Vec::new(),
                    converged: true,
                }),
                Stage::Rigid => moved_as(zone, step, &momentum_preserving(zone, step), 0.0, &mut solved.moved),
                Stage::Scaled(share) => moved_as(zone, step, &self.base(zone, step), share, &mut solved.moved),
                Stage::Still => moved_as(zone, step, &self.base(zone, step), 0.0, &mut solved.moved),
            }
        }
        let mut left: Vec<usize> = (0..descents.len()).collect();
        for pass in 0..PASSES {
            if left.is_empty() {
                break;
            }
            let mut batch = ZoneBatch::new();
            left.iter().for_each(|&i| descents[i].push_to(&mut batch, step, self.settings.margin_m));
            for (&i, result) in left.iter().zip(solve(executor, &batch, self.settings.iterations)) {
                solved.iterations += u64::from(result.iterations);
                descents[i].take(&result);
            }
            if pass + 1 < PASSES {
                left.retain(|&i| descents[i].hits_again(host, step, self.settings.margin_m));
            }
        }
        for descent in descents {
            solved.unconverged += u64::from(!descent.converged);
            let moved = descent.zone.vertices.iter().zip(descent.positions);
            solved.moved.extend(moved.map(|(&vertex, position)| Moved { vertex, position }));
        }
        solved
    }
}

impl Descent<'_> {
    /// The constraints, grouped by pair.
    fn of_pairs(&self) -> impl Iterator<Item = &[(Constraint, f64)]> {
        self.constraints.chunk_by(|(a, _), (b, _)| a.candidate == b.candidate)
    }

    /// Rows of all constraints, in order.
    fn rows(&self, step: &StepPositions, margin_m: f64) -> Vec<Row> {
        let zone = self.zone;
        let row = |before: usize, c: &Constraint, start: f64| {
            let places = c.candidate.vertices.map(|v| zone.place(v));
            let positions = std::array::from_fn(|i| match places[i] {
                Some(place) => zone.wanted_at(place),
                None => step.end(c.candidate.vertices[i]),
            });
            let vertices = places.map(|place| place.map_or(IMMOVABLE, |p| p as u32));
            Row { start, ..Row::new(c.normal, c.weights, vertices, positions, margin_m * margins(before)) }
        };
        let of_pair = |pair: &[(Constraint, f64)]| -> Vec<Row> {
            pair.iter().enumerate().map(|(before, (c, start))| row(before, c, *start)).collect()
        };
        self.of_pairs().flat_map(of_pair).collect()
    }

    fn push_to(&self, batch: &mut ZoneBatch, step: &StepPositions, margin_m: f64) {
        let masses = self.zone.vertices.iter().map(|&v| f64::from(step.inverse_masses[v as usize]));
        batch.push(&masses.collect::<Vec<f64>>(), self.rows(step, margin_m), TOLERANCE * margin_m);
    }

    fn take(&mut self, result: &ZoneResult) {
        self.converged = result.converged;
        self.positions = result
            .displacements
            .iter()
            .enumerate()
            .map(|(place, &d)| {
                let x = self.zone.wanted_at(place) + DVec3::from(d);
                // Rows that contradict each other may drive vertices away; the next attempt starts anew.
                if x.is_finite() && x.abs().max_element() < 1e18 {
                    x.as_vec3().to_array()
                } else {
                    self.zone.wanted[place]
                }
            })
            .collect();
        let mut multipliers = result.multipliers.iter();
        for (constraint, multiplier) in &mut self.constraints {
            if moves(self.zone, constraint) {
                *multiplier = multipliers.next().copied().filter(|y| y.is_finite()).unwrap_or(0.0);
            }
        }
    }

    /// Start positions of a pair and its present end positions.
    fn motion(&self, candidate: &Candidate, step: &StepPositions) -> [[DVec3; 4]; 2] {
        let x_t1 = candidate.vertices.map(|v| match self.zone.place(v) {
            Some(place) => at(self.positions[place].as_slice(), 0),
            None => step.end(v),
        });
        [candidate.vertices.map(|v| step.start(v)), x_t1]
    }

    /// Tests the zone's own pairs along their new paths, on the host's threads. Those that still hit get a constraint from
    /// there for the next pass, unless the descent has not met the ones they have.
    fn hits_again(&mut self, host: &CpuExecutor, step: &StepPositions, margin_m: f64) -> bool {
        let pairs: Vec<&[(Constraint, f64)]> = self.of_pairs().collect();
        let mut times: Vec<Option<f32>> = vec![None; pairs.len()];
        host.for_ranges_mut(&mut times, 1, GRAIN, |range, times| {
            for (pair, time) in pairs[range].iter().zip(times) {
                let candidate = &pair[0].0.candidate;
                let [x_t0, x_t1] = self.motion(candidate, step).map(|x| x.map(|p| p.as_vec3()));
                *time = ccd(candidate.kind(), x_t0, x_t1, 0.0).toi;
            }
        });
        let mut more = Vec::new();
        let hits = pairs.iter().zip(&times).filter_map(|(pair, time)| Some((pair, (*time)?)));
        for (pair, toi) in hits {
            let candidate = pair[0].0.candidate;
            let [x_t0, x_t1] = self.motion(&candidate, step);
            if all_met(pair.iter().map(|(c, _)| c), x_t1, margin_m, |c| moves(self.zone, c)) {
                more.push((Constraint::of_impact(&Impact { candidate, toi }, x_t0, x_t1), 0.0));
            }
        }
        self.constraints.extend(more);
        self.constraints.sort_by_key(|(constraint, _)| constraint.candidate);
        times.iter().any(Option::is_some)
    }
}

/// True if a vertex of the zone has weight in the constraint.
fn moves(zone: &Zone, constraint: &Constraint) -> bool {
    let mut parts = constraint.candidate.vertices.iter().zip(constraint.weights);
    parts.any(|(&v, w)| w != 0.0 && zone.place(v).is_some())
}

fn momentum_preserving(zone: &Zone, step: &StepPositions) -> RigidMotion {
    let points: Vec<MovingPoint> = zone
        .vertices
        .iter()
        .enumerate()
        .map(|(place, &v)| (step.start(v), zone.wanted_at(place), 1.0 / f64::from(step.inverse_masses[v as usize])))
        .collect();
    rigid::momentum_preserving(&points)
}

/// Positions that follow `base` but for `share` of the way to the wanted ones.
fn moved_as(zone: &Zone, step: &StepPositions, base: &RigidMotion, share: f64, moved: &mut Vec<Moved>) {
    moved.extend(zone.vertices.iter().enumerate().map(|(place, &vertex)| {
        let follows: Vec3 = {
            let x = base.apply(step.start(vertex));
            (x + (zone.wanted_at(place) - x) * share).as_vec3()
        };
        Moved { vertex, position: follows.to_array() }
    }));
}
