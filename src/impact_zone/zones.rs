//! The zones of a step: which impacts belong together, and how far each zone has come on the way from descent to standing
//! still. Replicated: every rank makes the same zones from the same impacts.
//!
//! Zones are disjoint in movable vertices. A zone whose descents are used up is divided, once, if what still hits is the
//! smaller part of it: that part goes on to the fail-safe, the rest gets a few more descents around it. A vertex never leaves
//! the fail-safe; there it counts as immovable for zones still in descent, and once it stands still for all others, so neither
//! spreads. Effort falls only where a vertex enters the fail-safe by a division, so after finitely many rounds either nothing
//! hits or everything that hits stands still.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::constraint::{Constraint, all_met};
use super::counts::{FailSafes, ZoneCounts};
use super::group::DisjointSets;
use super::rigid::{self, MovingPoint, RigidMotion};
use super::{Impossible, StepPositions, ZoneSettings, at};
use crate::collision::Impact;
use crate::math::DVec3;

/// Effort of a round in which a zone hits itself: a failed attempt.
const FAILED: u32 = 3;
/// Effort of a round in which a zone only meets others: its own solution may have been fine.
const GROWN: u32 = 1;
/// Stages of the fail-safe after the descents.
const FALLBACKS: u32 = 4;
/// Descents that the rest of a divided zone gets: the first one does not know yet where the other part goes.
const AFTER_DIVISION: u32 = 3;
/// Largest number of times that standing vertices are given another body to follow.
const MOST_REBASES: u32 = 8;
/// Shares of the wanted motion in the stages of the fail-safe, for zones that hit imposed vertices and for others, which
/// try to move as a rigid body first.
const SHARES: [f64; 4] = [0.5, 0.25, 0.125, 0.0];
const SHARES_AFTER_RIGID: [f64; 3] = [0.5, 0.25, 0.0];

/// The way in which a zone is resolved in a round.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Stage {
    /// Smallest change that keeps all constraints; the number counts failed attempts.
    Descent(u32),
    /// All vertices move as one rigid body with their momentum.
    Rigid,
    /// This share of the wanted motion, relative to the body that the zone touches or to standing still.
    Scaled(f64),
    /// No motion relative to the body that the zone touches, or none at all.
    Still,
}

/// Impacts that share movable vertices, and those vertices.
#[derive(Clone, Debug)]
pub struct Zone {
    pub(super) vertices: Vec<u32>,
    /// End positions without zones, in the order of the vertices.
    pub(super) wanted: Vec<[f32; 3]>,
    /// By pair; those of a pair in the order of their impacts.
    pub(super) constraints: Vec<Constraint>,
    effort: u32,
    rebases: u32,
    /// True if a part of it went on to the fail-safe before.
    divided: bool,
}

impl Zone {
    /// Movable vertices of the zone, ascending.
    pub fn vertices(&self) -> &[u32] {
        &self.vertices
    }

    /// Constraints from impacts so far, earlier rounds included.
    pub fn impacts(&self) -> usize {
        self.constraints.len()
    }

    /// Place of a vertex among [`Zone::vertices`]; none if it is not one of them.
    pub(super) fn place(&self, vertex: u32) -> Option<usize> {
        self.vertices.binary_search(&vertex).ok()
    }

    /// Vertices of its impacts that it cannot move, ascending.
    pub(super) fn immovable(&self) -> BTreeSet<u32> {
        let all = self.constraints.iter().flat_map(|c| c.candidate.vertices);
        all.filter(|&v| self.place(v).is_none()).collect()
    }

    /// Estimate of the work of a solve.
    pub(super) fn size(&self) -> u64 {
        self.vertices.len() as u64 + 4 * self.constraints.len() as u64
    }

    pub(super) fn wanted_at(&self, place: usize) -> DVec3 {
        at(self.wanted[place].as_slice(), 0)
    }
}

/// The impact zones of one step.
#[derive(Clone, Debug)]
pub struct ImpactZones {
    pub(super) settings: ZoneSettings,
    pub(super) zones: Vec<Zone>,
    /// Zone of every vertex in one. Never iterated.
    zone_of: HashMap<u32, u32>,
    active: Vec<u32>,
    counts: ZoneCounts,
    fail_safes: FailSafes,
}

/// A zone being put together.
#[derive(Default)]
struct Parts {
    vertices: Vec<(u32, [f32; 3])>,
    constraints: Vec<Constraint>,
    /// Constraints of the impacts of this round.
    fresh: Vec<Constraint>,
    effort: u32,
    rebases: u32,
    divided: bool,
    olds: u32,
    immovable_before: usize,
    touched: bool,
    failed: bool,
}

impl ImpactZones {
    /// The zones of a step before its first impacts.
    pub fn new(settings: ZoneSettings) -> ImpactZones {
        ImpactZones {
            settings,
            zones: Vec::new(),
            zone_of: HashMap::new(),
            active: Vec::new(),
            counts: ZoneCounts::default(),
            fail_safes: FailSafes::default(),
        }
    }

    /// All zones, by ascending smallest vertex.
    pub fn zones(&self) -> &[Zone] {
        &self.zones
    }

    /// Zones (places in [`ImpactZones::zones`]) that the last round's impacts touch: those to be solved, ascending.
    pub fn active(&self) -> &[u32] {
        &self.active
    }

    /// Counts so far, without iterations and halvings, which the caller counts.
    pub fn counts(&self) -> ZoneCounts {
        ZoneCounts {
            zones: self.zones.len() as u64,
            largest: self.zones.iter().map(|z| z.vertices.len() as u64).max().unwrap_or(0),
            fail_safes: self.fail_safes.total(),
            ..self.counts
        }
    }

    /// The fail-safes so far.
    pub fn fail_safes(&self) -> FailSafes {
        self.fail_safes
    }

    /// Takes in the impacts of the motion from `x_t0` to `x_t1` as they stand: sorted by [`Impact::key`], the same on every
    /// rank. Zones that share movable vertices become one. Vertices that are in no zone must still have the end positions
    /// of the time step, to which their zone will stay as close as it can.
    pub fn add(&mut self, step: &StepPositions, impacts: &[Impact]) -> Result<(), Impossible> {
        self.active.clear();
        if impacts.is_empty() {
            return Ok(());
        }
        self.counts.rounds += 1;
        self.counts.impacts += impacts.len() as u64;
        let (mut sets, fresh, homes) = self.connect(step, impacts)?;
        let mut parts: BTreeMap<u32, Parts> = BTreeMap::new();
        for (node, zone) in std::mem::take(&mut self.zones).into_iter().enumerate() {
            let part = parts.entry(sets.root(node as u32)).or_default();
            part.olds += 1;
            part.effort = part.effort.max(zone.effort);
            part.rebases = part.rebases.max(zone.rebases);
            part.divided |= zone.divided;
            part.immovable_before += zone.immovable().len();
            part.vertices.extend(zone.vertices.iter().copied().zip(zone.wanted));
            part.constraints.extend(zone.constraints);
        }
        for (node, vertex) in fresh {
            let x = &step.x_t1[3 * vertex as usize..][..3];
            parts.entry(sets.root(node)).or_default().vertices.push((vertex, [x[0], x[1], x[2]]));
        }
        for (impact, (node, failed)) in impacts.iter().zip(homes) {
            let part = parts.entry(sets.root(node)).or_default();
            part.touched = true;
            part.failed |= failed;
            let vertices = impact.candidate.vertices;
            let (x_t0, x_t1) = (vertices.map(|v| step.start(v)), vertices.map(|v| step.end(v)));
            part.fresh.push(Constraint::of_impact(impact, x_t0, x_t1));
        }
        self.rebuild(step, parts, impacts)
    }

    /// Sets of old zones (by their places) and vertices new in zones (by the numbers after them); the new vertices with
    /// their numbers; per impact a number of its set, and whether it lies within one old zone.
    #[allow(clippy::type_complexity)]
    fn connect(
        &self,
        step: &StepPositions,
        impacts: &[Impact],
    ) -> Result<(DisjointSets, Vec<(u32, u32)>, Vec<(u32, bool)>), Impossible> {
        let mut sets = DisjointSets::new(self.zones.len());
        let mut fresh = Vec::new();
        let mut node_of_fresh: HashMap<u32, u32> = HashMap::new();
        let mut homes = Vec::with_capacity(impacts.len());
        for impact in impacts {
            let movable = impact.candidate.vertices.into_iter().filter(|&v| step.inverse_masses[v as usize] > 0.0);
            // Before the fail-safe, in it, standing still.
            let mut nodes: [Vec<u32>; 3] = Default::default();
            for vertex in movable {
                match self.zone_of.get(&vertex) {
                    Some(&zone) => nodes[self.precedence(&self.zones[zone as usize])].push(zone),
                    None => nodes[0].push(*node_of_fresh.entry(vertex).or_insert_with(|| {
                        let node = sets.push();
                        fresh.push((node, vertex));
                        node
                    })),
                }
            }
            let nodes = nodes.into_iter().find(|nodes| !nodes.is_empty()).unwrap_or_default();
            let Some(&first) = nodes.first() else { return Err(impossible(step, [impact])) };
            let failed = (first as usize) < self.zones.len() && nodes.iter().all(|&node| node == first);
            nodes.iter().for_each(|&node| sets.join(first, node));
            homes.push((first, failed));
        }
        Ok((sets, fresh, homes))
    }

    /// Makes the zones of this round from the parts that belong together.
    fn rebuild(
        &mut self,
        step: &StepPositions,
        parts: BTreeMap<u32, Parts>,
        impacts: &[Impact],
    ) -> Result<(), Impossible> {
        let mut made: Vec<(Zone, bool)> = Vec::with_capacity(parts.len());
        for mut part in parts.into_values() {
            part.vertices.sort_unstable_by_key(|&(vertex, _)| vertex);
            self.take_fresh(step, &mut part);
            let (vertices, wanted) = part.vertices.into_iter().unzip();
            let mut zone = Zone {
                vertices,
                wanted,
                constraints: part.constraints,
                effort: part.effort,
                rebases: part.rebases,
                divided: part.divided,
            };
            if part.touched && self.stands(&zone) {
                // Standing vertices hit each other or imposed ones: they follow another body, or there is none to follow.
                zone.rebases += 1;
                let grown = part.olds > 1 || zone.immovable().len() > part.immovable_before;
                if !grown || zone.rebases > MOST_REBASES {
                    let inside = |i: &&Impact| i.candidate.vertices.iter().any(|&v| zone.place(v).is_some());
                    let mut verdict = impossible(step, impacts.iter().filter(inside));
                    // What it follows or has met before holds it as well.
                    let imposed = zone.immovable().into_iter().filter(|&v| step.inverse_masses[v as usize] == 0.0);
                    verdict.imposed.extend(imposed);
                    verdict.imposed.sort_unstable();
                    verdict.imposed.dedup();
                    return Err(verdict);
                }
            } else if part.touched && part.olds > 0 {
                let most = FAILED * (self.settings.attempts + FALLBACKS - 1);
                let descended = self.precedence(&zone) == 0;
                zone.effort = (zone.effort + if part.failed { FAILED } else { GROWN }).min(most);
                if descended && self.precedence(&zone) > 0 {
                    made.extend(self.divide(&mut zone, &part.fresh).map(|rest| (rest, true)));
                }
            }
            made.push((zone, part.touched));
        }
        made.sort_by_key(|(zone, _)| zone.vertices[0]);
        for (place, (zone, touched)) in made.into_iter().enumerate() {
            for &vertex in &zone.vertices {
                self.zone_of.insert(vertex, place as u32);
            }
            if touched {
                self.active.push(place as u32);
                match self.stage(&zone) {
                    Stage::Descent(_) => {}
                    Stage::Rigid => self.fail_safes.rigid += 1,
                    Stage::Scaled(_) => self.fail_safes.scaled += 1,
                    Stage::Still => self.fail_safes.still += 1,
                }
            }
            self.zones.push(zone);
        }
        Ok(())
    }

    /// Adds the constraints of this round, but for pairs that do not meet those they have: they need more of the same.
    fn take_fresh(&self, step: &StepPositions, part: &mut Parts) {
        let mut all = std::mem::take(&mut part.constraints);
        all.sort_by_key(|constraint| constraint.candidate);
        let lacks_one = |new: &Constraint| {
            let start = all.partition_point(|old| old.candidate < new.candidate);
            let of_pair = all[start..].iter().take_while(|old| old.candidate == new.candidate);
            let x = new.candidate.vertices.map(|v| step.end(v));
            let movable = |v: u32| part.vertices.binary_search_by_key(&v, |&(vertex, _)| vertex).is_ok();
            let moves =
                |c: &Constraint| c.candidate.vertices.iter().zip(c.weights).any(|(&v, w)| w != 0.0 && movable(v));
            all_met(of_pair, x, self.settings.margin_m, moves)
        };
        let fresh: Vec<Constraint> = part.fresh.iter().filter(|new| lacks_one(new)).copied().collect();
        all.extend(fresh);
        all.sort_by_key(|constraint| constraint.candidate);
        part.constraints = all;
    }

    /// Leaves in a zone that begins its fail-safe what still hits, by the impacts of this round, and returns the rest; nothing
    /// if that is the smaller part.
    fn divide(&self, zone: &mut Zone, fresh: &[Constraint]) -> Option<Zone> {
        let hits: BTreeSet<u32> = fresh.iter().flat_map(|c| c.candidate.vertices).collect();
        let count = zone.vertices.iter().filter(|v| hits.contains(v)).count();
        if 2 * count > zone.vertices.len() || zone.divided {
            return None;
        }
        zone.divided = true;
        let effort = FAILED * self.settings.attempts.saturating_sub(AFTER_DIVISION);
        let mut rest = Zone { effort, ..zone.clone() };
        for (part, hitting) in [(&mut *zone, true), (&mut rest, false)] {
            let kept = part.vertices.iter().zip(&part.wanted).filter(|(v, _)| hits.contains(v) == hitting);
            (part.vertices, part.wanted) = kept.map(|(&v, &x)| (v, x)).unzip();
        }
        let (of_rest, own) =
            zone.constraints.iter().partition(|c| c.candidate.vertices.iter().any(|&v| rest.place(v).is_some()));
        (rest.constraints, zone.constraints) = (of_rest, own);
        Some(rest)
    }

    /// Of zones that meet, those of the lowest precedence give way: 0 in descent, 1 in the fail-safe, 2 standing still.
    fn precedence(&self, zone: &Zone) -> usize {
        if self.stands(zone) { 2 } else { usize::from(zone.effort / FAILED >= self.settings.attempts) }
    }

    fn stands(&self, zone: &Zone) -> bool {
        zone.effort / FAILED >= self.settings.attempts + FALLBACKS - 1
    }

    /// The way in which a zone is resolved, by its effort so far.
    pub fn stage(&self, zone: &Zone) -> Stage {
        let tries = zone.effort / FAILED;
        let Some(fallback) = tries.checked_sub(self.settings.attempts) else { return Stage::Descent(tries) };
        let fallback = fallback.min(FALLBACKS - 1) as usize;
        let share = match (fallback, zone.immovable().is_empty()) {
            (0, true) => return Stage::Rigid,
            (_, true) => SHARES_AFTER_RIGID[fallback - 1],
            (_, false) => SHARES[fallback],
        };
        if share == 0.0 { Stage::Still } else { Stage::Scaled(share) }
    }

    /// The motion that a zone in the fail-safe is given, or is scaled down to: that of the one body it touches, if it does.
    pub(super) fn base(&self, zone: &Zone, step: &StepPositions) -> RigidMotion {
        let points: Vec<MovingPoint> =
            zone.immovable().into_iter().map(|v| (step.start(v), step.end(v), 1.0)).collect();
        if points.is_empty() {
            return RigidMotion::STILL;
        }
        rigid::shared(&points, 0.1 * self.settings.margin_m).unwrap_or(RigidMotion::STILL)
    }
}

/// The verdict on impacts that nothing resolves.
fn impossible<'a>(step: &StepPositions, impacts: impl IntoIterator<Item = &'a Impact>) -> Impossible {
    let (mut vertices, mut imposed) = (BTreeSet::new(), BTreeSet::new());
    for vertex in impacts.into_iter().flat_map(|impact| impact.candidate.vertices) {
        if step.inverse_masses[vertex as usize] > 0.0 {
            vertices.insert(vertex)
        } else {
            imposed.insert(vertex)
        };
    }
    Impossible { vertices: vertices.into_iter().collect(), imposed: imposed.into_iter().collect() }
}
