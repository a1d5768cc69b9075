//! The narrow phase as the threads of the broad phase run it: candidates in groups of four of a kind through the
//! separating-axis test, what is left one by one through the elementary tests.

use glam::Vec4;

use super::broad::{Sink, nanoseconds};
use super::contact::{Pair, Surfaces};
use super::elementary::lanes::{Lanes, undecided, undecided_at_rest};
use super::elementary::{CandidateKind, ccd};
use super::let_go::LetGo;
use super::rules::Rules;
use super::sewn_sides::SewnSides;
use super::{Candidate, Impact};
use crate::forces::ContactElement;
use crate::math::Vec3;
use bytemuck::Zeroable;
use std::time::Instant;

/// Results and counts of the narrow phase, of one thread or added up.
pub(super) struct Findings<T> {
    pub items: Vec<T>,
    /// Stencils that the elementary tests looked at.
    pub tested: u64,
    pub smallest_gap_m: f32,
    /// Time of the narrow phase, added over threads.
    pub ns: u64,
}

impl<T> Findings<T> {
    pub(super) fn new() -> Findings<T> {
        Findings { items: Vec::new(), tested: 0, smallest_gap_m: f32::INFINITY, ns: 0 }
    }

    /// Adds what another thread found.
    pub(super) fn append(&mut self, mut other: Findings<T>) {
        if self.items.is_empty() {
            std::mem::swap(&mut self.items, &mut other.items);
        }
        self.items.append(&mut other.items);
        self.tested += other.tested;
        self.smallest_gap_m = self.smallest_gap_m.min(other.smallest_gap_m);
        self.ns += other.ns;
    }
}

/// Calls `test(kind, group, count)` with groups of four candidates of one kind. Only the first `count` of a group are
/// new; the rest repeats the first one.
#[inline(always)]
fn for_each_group(
    found: &[Candidate],
    wanted: impl Fn(&Candidate) -> bool,
    mut test: impl FnMut(CandidateKind, &[Candidate; 4], usize),
) {
    let mut groups = [[Candidate::zeroed(); 4]; 2];
    let mut counts = [0; 2];
    let kinds = [CandidateKind::VertexFace, CandidateKind::EdgeEdge];
    for candidate in found.iter().filter(|candidate| wanted(candidate)) {
        let kind = usize::from(!candidate.is_vertex_face());
        groups[kind][counts[kind]] = *candidate;
        counts[kind] += 1;
        if counts[kind] == 4 {
            test(kinds[kind], &groups[kind], 4);
            counts[kind] = 0;
        }
    }
    for kind in 0..2 {
        let count = counts[kind];
        if count > 0 {
            for rest in count..4 {
                groups[kind][rest] = groups[kind][0];
            }
            test(kinds[kind], &groups[kind], count);
        }
    }
}

/// Positions of the vertices of four pairs.
#[inline(always)]
fn gather(x: &[f32], group: &[Candidate; 4]) -> [Lanes; 4] {
    std::array::from_fn(|i| {
        let at = |k: usize| {
            let start = 3 * group[k].vertices[i] as usize;
            let x = &x[start..start + 3];
            [x[0], x[1], x[2]]
        };
        let [a, b, c, d] = [at(0), at(1), at(2), at(3)];
        std::array::from_fn(|axis| Vec4::new(a[axis], b[axis], c[axis], d[axis]))
    })
}

/// Numbers below `count` of the bits that are set in a mask of four.
#[inline(always)]
fn left(mask: u32, count: usize) -> impl Iterator<Item = usize> {
    (0..count).filter(move |&i| mask >> i & 1 != 0)
}

/// An upper bound of how much closer the parts of a pair can come on the way to `ahead`, meters.
fn closing_bound(candidate: &Candidate, x: &[f32], ahead: &[f32]) -> f32 {
    let at = |x: &[f32], v: u32| Vec3::from_slice(&x[3 * v as usize..]);
    let [a, b, c, d] = candidate.vertices.map(|v| at(ahead, v) - at(x, v));
    let pairs: &[(Vec3, Vec3)] =
        if candidate.is_vertex_face() { &[(a, b), (a, c), (a, d)] } else { &[(a, c), (a, d), (b, c), (b, d)] };
    // Rounding of the differences is far below the margin.
    1.001 * pairs.iter().map(|(one, other)| (*one - *other).length()).fold(0.0, f32::max)
}

/// Whether the parts of a pair may pass through each other on the straight way from `x` to `ahead`.
fn crosses(candidate: &Candidate, x: &[f32], ahead: &[f32]) -> bool {
    let at = |x: &[f32], v: u32| Vec3::from_slice(&x[3 * v as usize..]);
    let [start, end] = [x, ahead].map(|x| candidate.vertices.map(|v| at(x, v)));
    let kind = if candidate.is_vertex_face() { CandidateKind::VertexFace } else { CandidateKind::EdgeEdge };
    ccd(kind, start, end, 0.0).toi.is_some()
}

/// The contact of a pair on the way from `surfaces` to the positions `ahead` at the end of the step, as far as they are
/// known. Features, weights and normal are those of the end, since features pass each other and turn within a step;
/// where the way leads through, those of the start. The distance is that of the start as this normal sees it: with what
/// the weighted points move along the normal it gives that of the end.
pub(super) fn contact_of(
    surfaces: &Surfaces<'_>,
    ahead: Option<&[f32]>,
    rules: &Rules,
    sewn_sides: &SewnSides,
    candidate: &Candidate,
) -> Option<Pair> {
    let reach_m = rules.reach_m(candidate);
    let closest = |surfaces: &Surfaces<'_>, reach_m: f32| {
        surfaces.closest(candidate, reach_m).map(|pair| sewn_sides.limited(pair, surfaces.x))
    };
    let Some(ahead) = ahead else {
        return closest(surfaces, reach_m).filter(|pair| rules.is_near(pair, 0.0));
    };
    let there = Surfaces { x: ahead, ..*surfaces };
    let mut at_end = closest(&there, reach_m).filter(|pair| rules.is_near(pair, 0.0));
    if let Some(pair) = &mut at_end {
        pair.distance_m -= pair.parting(surfaces.x, ahead);
        if pair.distance_m > 0.0 {
            return at_end;
        }
    }
    let closing = closing_bound(candidate, surfaces.x, ahead);
    let at_start = closest(surfaces, reach_m + closing);
    let at_start = at_start.filter(|pair| rules.is_near(pair, -pair.parting(surfaces.x, ahead)));
    if (at_end.is_some() || at_start.is_some()) && crosses(candidate, surfaces.x, ahead) { at_start } else { at_end }
}

/// Turns candidates into contact elements, on one thread.
pub(super) struct ContactSink<'a> {
    pub surfaces: &'a Surfaces<'a>,
    /// Positions that the step is heading for, if they differ.
    pub ahead: Option<&'a [f32]>,
    pub rules: &'a Rules,
    pub let_go: &'a LetGo,
    pub sewn_sides: &'a SewnSides,
    pub found: Findings<ContactElement>,
    /// Candidates that may come near on the way.
    pub near: Vec<Candidate>,
}

impl Sink for ContactSink<'_> {
    fn take(&mut self, found: &[Candidate]) {
        let started = Instant::now();
        let (surfaces, ahead, rules, own) = (self.surfaces, self.ahead, self.rules, &mut self.found);
        let (let_go, sewn_sides) = (self.let_go, self.sewn_sides);
        for_each_group(
            found,
            |candidate| !let_go.leaves_out(candidate),
            |kind, group, count| {
                let reach = Vec4::from_array(group.each_ref().map(|candidate| rules.reach_m(candidate)));
                let start = gather(surfaces.x, group);
                let mask = match ahead {
                    None => undecided_at_rest(kind, &start, reach),
                    Some(ahead) => undecided(kind, &start, &gather(ahead, group), reach),
                };
                for i in left(mask, count) {
                    own.tested += 1;
                    if ahead.is_some() {
                        self.near.push(group[i]);
                    }
                    let Some(pair) = contact_of(surfaces, ahead, rules, sewn_sides, &group[i]) else { continue };
                    own.smallest_gap_m = own.smallest_gap_m.min(pair.gap_m);
                    own.items.extend(rules.element(&pair));
                }
            },
        );
        own.ns += nanoseconds(started);
    }
}

/// Turns candidates into impacts, on one thread.
pub(super) struct ImpactSink<'a> {
    pub x_t0: &'a [f32],
    pub x_t1: &'a [f32],
    pub separation_m: f32,
    pub touched: Option<&'a [bool]>,
    pub let_go: &'a LetGo,
    pub found: Findings<Impact>,
}

impl Sink for ImpactSink<'_> {
    fn take(&mut self, found: &[Candidate]) {
        let started = Instant::now();
        let (x_t0, x_t1, separation_m, own) = (self.x_t0, self.x_t1, self.separation_m, &mut self.found);
        let (touched, let_go) = (self.touched, self.let_go);
        let wanted = |c: &Candidate| {
            touched.is_none_or(|touched| c.vertices.iter().any(|&v| touched[v as usize])) && !let_go.leaves_out(c)
        };
        let at = |x: &[f32], vertex: u32| Vec3::from_slice(&x[3 * vertex as usize..]);
        for_each_group(found, wanted, |kind, group, count| {
            let (start, end) = (gather(x_t0, group), gather(x_t1, group));
            for i in left(undecided(kind, &start, &end, Vec4::splat(separation_m)), count) {
                own.tested += 1;
                let candidate = group[i];
                let (start, end) = (candidate.vertices.map(|v| at(x_t0, v)), candidate.vertices.map(|v| at(x_t1, v)));
                if let Some(toi) = ccd(kind, start, end, separation_m).toi {
                    own.items.push(Impact { candidate, toi });
                }
            }
        });
        own.ns += nanoseconds(started);
    }
}
