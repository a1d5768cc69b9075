//! Cloth without room between obstacles that overlap.
//!
//! Cloth never crosses an obstacle, so where one obstacle moves into another (an arm into a body) what is between them
//! has nowhere to be. There, and only there, a vertex and one of the two let go of each other: contacts, impacts and
//! zones leave the pair out, with all triangles and edges of the vertex. Which pairs these are is part of the state;
//! they are taken up again as soon as the vertex is on its side of the obstacle and its triangles are clear of it, so
//! at the end of every step all triangles without such a vertex are free of the obstacle.
//!
//! A pair is let go where two obstacles press a vertex from opposite sides and the surface of each is beyond that of
//! the other at the end of the step; and where zones have given up on a step, or on a part of one, and obstacles
//! overlap at that place. Parts of one closed obstacle, as a thigh and a belly, count as two: there the surface that is
//! nearest to a vertex is itself inside, and the vertex lets go of the whole obstacle. Where zones have given up on
//! vertices that follow an obstacle by a pin, they and what they press let go of the obstacle that comes upon them,
//! since nothing else can give way. Every rank comes to the same pairs from the same positions.
//!
//! A vertex inside the obstacle that it has let go of stays on the other one. Where that has gone, a contact leads it
//! to the nearest surface and keeps it from going back in, so that an arm that leaves does not take cloth along within
//! it.

use std::collections::BTreeSet;

use super::Failure;
use super::collisions::Collisions;
use super::let_go_pairs::Pressed;
use super::span::Span;
use super::stats::StepStats;
use crate::collision::LeftOut;
use crate::collision::body::{Body, Crossing, Nearest, is_closed, segment_triangle_m};
use crate::context::RankContext;
use crate::forces::{ContactElement, NO_VERTEX};
use crate::impact_zone::Impossible;
use crate::math::{DVec3, Vec3};
use crate::model::LetGo;
use crate::transport::{TransportError, share_lists};

/// Speeds of two obstacles that differ by less than this share count as equal: then the one that the scene names later
/// moves in.
const EQUAL_SPEEDS: f64 = 0.01;
/// Cosine of the angle between the directions in which two obstacles press a vertex below which it is pinched between
/// them: what they meet at a wider angle slides out.
const OPPOSITE: f32 = -0.7;
/// Gap, in thicknesses, of a contact that leads a vertex out of an obstacle: it gets out by the rest of the thickness
/// in a step at most.
const GAP_OUT: f32 = 0.5;

/// A contact of the cloth with an obstacle.
struct Touch {
    /// The vertex with the largest share in it.
    vertex: u32,
    obstacle: u32,
    /// Of the cloth, meters.
    place: Vec3,
    /// From the obstacle to the cloth.
    normal: Vec3,
    /// At the end of the span if the cloth stays, meters.
    gap_m: f32,
}

/// A place without room between two obstacles.
struct Pinched {
    vertex: u32,
    /// How far the two have moved there, meters.
    ways_m: [f64; 2],
}

impl Collisions {
    /// What is let go of the own rows.
    pub(super) fn let_go_of_rows(&self) -> Vec<LetGo> {
        self.let_go.of_rows(self.partition.rows_of(self.plan.rank))
    }

    /// The state is no longer the end of the step before, but one in which the own rows let go of these.
    pub(super) fn forget_state(&mut self, let_go: &[LetGo]) {
        self.state_known = false;
        self.let_go.set(let_go, self.partition.rows_of(self.plan.rank));
    }

    /// After a state was set, tells all ranks what it has let go.
    pub(super) fn share_let_go(&mut self, rank: &mut RankContext<'_>) -> Result<(), TransportError> {
        let own = std::mem::take(&mut self.let_go.unshared);
        let pairs = &mut self.let_go.pairs;
        pairs.clear();
        share_lists(rank.transport, &own, &mut |_, part: &[LetGo]| pairs.extend_from_slice(part))?;
        pairs.sort_unstable();
        self.leave_out();
        Ok(())
    }

    /// Tells the detector.
    fn leave_out(&mut self) {
        let rows = self.partition.rows();
        let pairs = self.let_go.pairs.iter().map(|one| {
            let [vertices, _] = self.let_go.ranges[one.obstacle as usize].clone();
            let obstacle = (rows + vertices.start) as u32..(rows + vertices.end) as u32;
            LeftOut { vertex: one.vertex, obstacle }
        });
        self.detector.leave_out(pairs.collect());
    }

    /// Lets go where obstacles that overlap leave the vertices that could not be freed no room at the end of `span`;
    /// with `at_last`, a step later counts as well, and so do places that only the crossing of the two surfaces tells.
    /// Returns the number of pairs; 0: there is no such place.
    pub(super) fn let_go_of(
        &mut self,
        impossible: &Impossible,
        span: Span,
        at_last: bool,
        stats: &mut StepStats,
    ) -> usize {
        let rows = self.partition.rows();
        let faces: BTreeSet<[u32; 3]> =
            impossible.vertices.iter().flat_map(|&v| self.detector.triangles_around(v)).collect();
        let named: BTreeSet<usize> = impossible
            .imposed
            .iter()
            .filter_map(|&v| Some(self.obstacles.obstacle_of_vertex((v as usize).checked_sub(rows)?)))
            .collect();
        let mut times = vec![self.x_t1[3 * rows..].to_vec()];
        if at_last {
            let mut later = Vec::new();
            self.obstacles.positions_at(span.end_s + self.let_go.step_s, &mut later);
            times.push(later);
        }
        let mut fresh = Vec::new();
        let count = self.obstacles.len();
        for x in &times {
            let boxes: Vec<[DVec3; 2]> = (0..count).map(|obstacle| self.body(obstacle, x).bounds()).collect();
            for (a, b) in (0..count).flat_map(|b| (0..=b).map(move |a| (a, b))) {
                let [low, high] = [boxes[a][0].max(boxes[b][0]), boxes[a][1].min(boxes[b][1])];
                if (named.contains(&a) || named.contains(&b)) && low.cmple(high).all() {
                    fresh.extend(self.let_go_between([a, b], x, &faces, at_last));
                }
            }
            if !fresh.is_empty() {
                break;
            }
        }
        if fresh.is_empty() && (at_last || impossible.vertices.is_empty()) {
            fresh = self.let_go_followers(impossible, &named);
        }
        self.let_go_more(fresh, stats)
    }

    /// Pairs to let go of vertices that follow an obstacle by a pin, and of those that they press, with the obstacles
    /// `named` that have come upon them.
    fn let_go_followers(&mut self, impossible: &Impossible, named: &BTreeSet<usize>) -> Vec<LetGo> {
        let follows = |v: &u32| self.model.pins.iter().any(|pin| pin.row == *v && pin.follows);
        let followers: Vec<u32> = impossible.imposed.iter().copied().filter(follows).collect();
        if followers.is_empty() {
            return Vec::new();
        }
        let closed: Vec<usize> = named.iter().copied().filter(|&obstacle| self.is_closed(obstacle)).collect();
        let vertices = || followers.iter().chain(&impossible.vertices);
        let pairs = closed.iter().flat_map(|&obstacle| vertices().map(move |&vertex| (vertex, obstacle)));
        let pairs = pairs.filter(|&(vertex, obstacle)| !self.let_go.holds(vertex, [obstacle; 2]));
        pairs.map(|(vertex, obstacle)| self.pair(vertex, obstacle)).collect()
    }

    /// Number of the pairs, each once.
    fn let_go_more(&mut self, mut fresh: Vec<LetGo>, stats: &mut StepStats) -> usize {
        fresh.sort_unstable();
        fresh.dedup();
        if !fresh.is_empty() {
            stats.let_go.new += fresh.len() as u64;
            self.let_go.pairs.extend(&fresh);
            self.let_go.pairs.sort_unstable();
            self.leave_out();
        }
        fresh.len()
    }

    /// Places of the cloth that two obstacles, or two parts of one, press from opposite sides, each beyond the other
    /// one at the end of the step unless the cloth moves. `elements` are the contacts of the own rows; what is found
    /// belongs to own vertices.
    pub(super) fn pressed_from_both_sides(&self, elements: &[ContactElement]) -> Vec<Pressed> {
        if self.obstacles.is_empty() {
            return Vec::new();
        }
        let own = self.partition.rows_of(self.plan.rank);
        let touches = elements.iter().filter_map(|element| self.touch(element));
        let mut touches: Vec<Touch> = touches.filter(|touch| own.contains(&(touch.vertex as usize))).collect();
        touches.sort_by_key(|touch| touch.vertex);
        let mut found = Vec::new();
        for of_vertex in touches.chunk_by(|one, other| one.vertex == other.vertex) {
            for (i, one) in of_vertex.iter().enumerate() {
                for other in &of_vertex[i + 1..] {
                    let cosine = one.normal.dot(other.normal);
                    let no_room = one.gap_m < cosine * other.gap_m && other.gap_m < cosine * one.gap_m;
                    if cosine < OPPOSITE && no_room {
                        let obstacles = [one.obstacle.min(other.obstacle), one.obstacle.max(other.obstacle)];
                        found.extend([one, other].map(|touch| Pressed {
                            obstacles,
                            vertex: touch.vertex,
                            place: touch.place.to_array(),
                        }));
                    }
                }
            }
        }
        found
    }

    /// A contact of the cloth with an obstacle; none if it is one of cloth with cloth.
    fn touch(&self, element: &ContactElement) -> Option<Touch> {
        let rows = self.partition.rows() as u32;
        let present = || element.vertices.into_iter().zip(element.weights).filter(|(v, _)| *v != NO_VERTEX);
        let (of_obstacle, _) = present().find(|(v, _)| *v >= rows)?;
        let at = |x: &[f32], v: u32| Vec3::from_slice(&x[3 * v as usize..]);
        let (mut place, mut way, mut main, mut sign) = (Vec3::ZERO, Vec3::ZERO, (0, 0.0), 0.0);
        for (v, weight) in present() {
            if v >= rows {
                way += weight * (at(&self.x_t1, v) - at(&self.x_t0, v));
                continue;
            }
            place += weight.abs() * at(&self.x_t0, v);
            sign += weight;
            if weight.abs() > main.1 {
                main = (v, weight.abs());
            }
        }
        let normal = Vec3::from(element.normal);
        Some(Touch {
            vertex: main.0,
            obstacle: self.obstacles.obstacle_of_vertex((of_obstacle - rows) as usize) as u32,
            place,
            // From the obstacle to the cloth.
            normal: if sign < 0.0 { -normal } else { normal },
            gap_m: element.distance_m + way.dot(normal),
        })
    }

    /// Lets go where those of [`Collisions::pressed_from_both_sides`] of all ranks have no room. Returns the number of
    /// pairs.
    pub(super) fn let_go_pressed(
        &mut self,
        rank: &mut RankContext<'_>,
        own: &[Pressed],
        stats: &mut StepStats,
    ) -> Result<usize, TransportError> {
        let mut all: Vec<Pressed> = Vec::new();
        share_lists(rank.transport, own, &mut |_, part: &[Pressed]| all.extend_from_slice(part))?;
        all.sort_by_key(|one| (one.obstacles, one.vertex, one.place.map(f32::to_bits)));
        let ends = self.x_t1[3 * self.partition.rows()..].to_vec();
        let mut fresh = Vec::new();
        for same in all.chunk_by(|one, other| one.obstacles == other.obstacles) {
            let two = same[0].obstacles.map(|obstacle| obstacle as usize);
            let closed = two.map(|obstacle| self.is_closed(obstacle));
            if closed != [false; 2] {
                let held = same.iter().filter(|one| !self.let_go.holds(one.vertex, two));
                let places: Vec<_> = held.map(|one| (one.vertex, Vec3::from(one.place).as_dvec3())).collect();
                let pinched = self.pinched_at(two, closed, &ends, &places);
                fresh.extend(self.pairs_of(two, closed, &pinched));
            }
        }
        Ok(self.let_go_more(fresh, stats))
    }

    fn body<'a>(&'a self, obstacle: usize, x: &'a [f32]) -> Body<'a> {
        let [_, triangles] = self.let_go.ranges[obstacle].clone();
        Body { x, triangles: &self.obstacles.triangles()[triangles] }
    }

    fn is_closed(&mut self, obstacle: usize) -> bool {
        let [_, triangles] = self.let_go.ranges[obstacle].clone();
        let triangles = &self.obstacles.triangles()[triangles];
        *self.let_go.closed[obstacle].get_or_insert_with(|| is_closed(triangles))
    }

    /// Pairs to let go around `faces` between two obstacles, which are at `x`.
    fn let_go_between(&mut self, two: [usize; 2], x: &[f32], faces: &BTreeSet<[u32; 3]>, at_last: bool) -> Vec<LetGo> {
        let closed = two.map(|obstacle| self.is_closed(obstacle));
        if closed == [false; 2] {
            return Vec::new();
        }
        let still_held = |face: &&[u32; 3]| !face.iter().any(|&v| self.let_go.holds(v, two));
        let faces: Vec<[u32; 3]> = faces.iter().filter(still_held).copied().collect();
        let mut pinched = self.without_room(two, closed, x, &faces);
        if pinched.is_empty() && at_last {
            pinched = self.at_crossings(two, x, &faces);
        }
        self.pairs_of(two, closed, &pinched)
    }

    /// The pairs of pinched vertices and the one of two obstacles that moves in.
    fn pairs_of(&self, two: [usize; 2], closed: [bool; 2], pinched: &[Pinched]) -> Vec<LetGo> {
        let moves_in = two[self.moves_in(two, closed, pinched)];
        pinched.iter().map(|one| self.pair(one.vertex, moves_in)).collect()
    }

    /// A vertex that lets go of an obstacle, on its side of it at the start of the span.
    fn pair(&self, vertex: u32, obstacle: usize) -> LetGo {
        let start = self.body(obstacle, &self.x_t0[3 * self.partition.rows()..]);
        let inside = u32::from(start.holds(self.cloth_at(vertex).as_dvec3()));
        LetGo { vertex, obstacle: obstacle as u32, inside }
    }

    /// Position of a vertex of the cloth at the start of the span.
    fn cloth_at(&self, vertex: u32) -> Vec3 {
        Vec3::from_slice(&self.x_t0[3 * vertex as usize..])
    }

    /// Corners of `faces` that have no room: the surface of either obstacle is nearest where it is on the far side of
    /// the other one, as the vertex sees it; that of one obstacle where it is inside of it. Where only the middle of a
    /// face has none, its nearest corner.
    fn without_room(&self, two: [usize; 2], closed: [bool; 2], x: &[f32], faces: &[[u32; 3]]) -> Vec<Pinched> {
        let corners: BTreeSet<u32> = faces.iter().flatten().copied().collect();
        let places: Vec<(u32, DVec3)> = corners.iter().map(|&v| (v, self.cloth_at(v).as_dvec3())).collect();
        let pinched = self.pinched_at(two, closed, x, &places);
        if !pinched.is_empty() {
            return pinched;
        }
        let middle = |face: &[u32; 3]| {
            let corners = face.map(|v| self.cloth_at(v).as_dvec3());
            (face[0], (corners[0] + corners[1] + corners[2]) / 3.0)
        };
        self.pinched_at(two, closed, x, &faces.iter().map(middle).collect::<Vec<_>>())
    }

    /// The places that have no room.
    fn pinched_at(&self, two: [usize; 2], closed: [bool; 2], x: &[f32], places: &[(u32, DVec3)]) -> Vec<Pinched> {
        let starts = &self.x_t0[3 * self.partition.rows()..];
        let ends = two.map(|obstacle| self.body(obstacle, x));
        let at_start = two.map(|obstacle| self.body(obstacle, starts));
        let look = |&(vertex, place): &(u32, DVec3)| -> Option<Pinched> {
            if two[0] == two[1] {
                let nearest = ends[0].nearest(place)?;
                let way_m = self.way_m(nearest.corners, nearest.weights);
                return ends[0].buries(place, &nearest).then_some(Pinched { vertex, ways_m: [way_m; 2] });
            }
            let [Some(one), Some(other)] = ends.map(|body| body.nearest(place)) else { return None };
            let start = self.cloth_at(vertex).as_dvec3();
            let beyond = |of: usize, nearest: &Nearest| {
                !closed[of] || ends[of].holds(nearest.point) != at_start[of].holds(start)
            };
            (beyond(0, &other) && beyond(1, &one)).then(|| {
                let ways_m = [&one, &other].map(|nearest| self.way_m(nearest.corners, nearest.weights));
                Pinched { vertex, ways_m }
            })
        };
        let mut found: Vec<Option<Pinched>> = places.iter().map(|_| None).collect();
        self.cpu.for_ranges_mut(&mut found, 1, 1, |range, found| {
            found.iter_mut().zip(&places[range]).for_each(|(found, place)| *found = look(place));
        });
        found.into_iter().flatten().collect()
    }

    /// How far a point of an obstacle's triangle moves in the span, meters.
    fn way_m(&self, corners: [u32; 3], weights: [f64; 3]) -> f64 {
        let first = self.partition.rows() as u32;
        let at = |x: &[f32], v: u32| Vec3::from_slice(&x[3 * (first + v) as usize..]).as_dvec3();
        let ways = corners.map(|v| at(&self.x_t1, v) - at(&self.x_t0, v));
        (0..3).map(|k| ways[k] * weights[k]).sum::<DVec3>().length()
    }

    /// Faces within the thickness of a crossing of the two surfaces, by their corner nearest to it.
    fn at_crossings(&self, two: [usize; 2], x: &[f32], faces: &[[u32; 3]]) -> Vec<Pinched> {
        let thickness_m = self.model.thickness_m;
        let corners = |face: &[u32; 3]| face.map(|v| self.cloth_at(v).as_dvec3());
        let all = faces.iter().flat_map(corners);
        let [low, high] = all.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[low, high], p| [low.min(p), high.max(p)]);
        let region = [low - thickness_m, high + thickness_m];
        let crossings = match two.map(|obstacle| self.body(obstacle, x)) {
            [one, _] if two[0] == two[1] => one.crossings_with_itself(region),
            [one, other] => one.crossings(&other, region),
        };
        let look = |face: &[u32; 3]| -> Option<Pinched> {
            let x = corners(face);
            let near = |crossing: &&Crossing| segment_triangle_m(crossing.ends, x) <= thickness_m;
            let crossing = crossings.iter().find(near)?;
            let middle = 0.5 * (crossing.ends[0] + crossing.ends[1]);
            let nearest = (0..3).min_by(|&i, &j| x[i].distance(middle).total_cmp(&x[j].distance(middle)))?;
            let ways_m = crossing.corners.map(|corners| self.way_m(corners, [1.0 / 3.0; 3]));
            Some(Pinched { vertex: face[nearest], ways_m })
        };
        faces.iter().filter_map(look).collect()
    }

    /// Which of two obstacles lets go: the one that moves in. One choice for all places, and the same as for vertices
    /// beside them that have let go before.
    fn moves_in(&self, two: [usize; 2], closed: [bool; 2], pinched: &[Pinched]) -> usize {
        if closed != [true; 2] {
            return usize::from(closed[1]);
        }
        let around: BTreeSet<u32> =
            pinched.iter().flat_map(|one| self.detector.triangles_around(one.vertex)).flatten().collect();
        let before = two.map(|obstacle| around.iter().any(|&v| self.let_go.holds(v, [obstacle; 2])));
        if before[0] != before[1] {
            return usize::from(before[1]);
        }
        let ways_m = [0, 1].map(|of| pinched.iter().map(|one| one.ways_m[of]).sum::<f64>());
        usize::from(ways_m[0] <= ways_m[1] * (1.0 + EQUAL_SPEEDS))
    }

    /// Finds the contacts of this span that lead own vertices out of the obstacles that they have let go of, or keep
    /// them out: for those that no other obstacle holds, by the contacts `elements` of the own rows.
    pub(super) fn find_ways_out(&mut self, elements: &[ContactElement]) {
        self.let_go.ways_out.clear();
        if self.let_go.pairs.is_empty() {
            return;
        }
        let (rows, own) = (self.partition.rows() as u32, self.partition.rows_of(self.plan.rank));
        let on_obstacles =
            elements.iter().filter(|element| element.vertices.iter().any(|&v| v >= rows && v != NO_VERTEX));
        let held: BTreeSet<u32> = on_obstacles.flat_map(|element| element.vertices).collect();
        let params = self.detector.params();
        let is_free = |one: &&LetGo| {
            let mobile = params.inverse_masses_per_kg[one.vertex as usize] > 0.0;
            own.contains(&(one.vertex as usize)) && !held.contains(&one.vertex) && mobile
        };
        let free: Vec<LetGo> = self.let_go.pairs.iter().filter(is_free).copied().collect();
        let obstacles = &self.x_t0[3 * rows as usize..];
        let way_out = |one: &LetGo| -> Option<ContactElement> {
            let body = self.body(one.obstacle as usize, obstacles);
            let place = self.cloth_at(one.vertex).as_dvec3();
            let nearest = body.nearest(place)?;
            let outward = (place - nearest.point).try_normalize()?.as_vec3();
            let is_back = u32::from(body.holds(place)) == one.inside;
            let gap_m = if is_back { nearest.distance_m as f32 } else { GAP_OUT * params.thickness_m };
            if gap_m >= params.thickness_m {
                return None;
            }
            let normal = if is_back { outward } else { -outward }.to_array();
            let ([a, b, c], [wa, wb, wc]) = (nearest.corners, nearest.weights.map(|weight| -weight as f32));
            let inverse_mass = params.inverse_masses_per_kg[one.vertex as usize];
            Some(ContactElement {
                vertices: [one.vertex, rows + a, rows + b, rows + c],
                weights: [1.0, wa, wb, wc],
                normal,
                distance_m: gap_m,
                thickness_m: params.thickness_m,
                stiffness_n_m: params.stiffness_ratio / (inverse_mass * params.step_s * params.step_s),
                friction: 0.0,
                kind: 0,
            })
        };
        let mut found = vec![None; free.len()];
        self.cpu.for_ranges_mut(&mut found, 1, 1, |range, found| {
            found.iter_mut().zip(&free[range]).for_each(|(found, one)| *found = way_out(one));
        });
        self.let_go.ways_out = found.into_iter().flatten().collect();
    }

    /// Adds them to the contacts of the own rows.
    pub(super) fn add_ways_out(&self, elements: &mut Vec<ContactElement>) {
        if !self.let_go.ways_out.is_empty() {
            elements.extend_from_slice(&self.let_go.ways_out);
            elements.sort_by_key(ContactElement::key);
        }
    }

    /// At the end of a step, takes up what is back on its side and clear of the obstacle.
    pub(super) fn take_up(&mut self, rank: &mut RankContext<'_>, stats: &mut StepStats) -> Result<(), Failure> {
        if self.let_go.pairs.is_empty() {
            return Ok(());
        }
        let (place, ranks) = (rank.transport.rank(), rank.transport.ranks());
        let own: Vec<LetGo> = self.let_go.pairs.iter().skip(place).step_by(ranks).copied().collect();
        let obstacles = &self.x_t0[3 * self.partition.rows()..];
        let is_clear = |one: &LetGo| {
            let body = self.body(one.obstacle as usize, obstacles);
            let mut faces = self.detector.triangles_around(one.vertex);
            !faces.any(|face| body.crosses(face.map(|v| self.cloth_at(v))))
                && u32::from(body.holds(self.cloth_at(one.vertex).as_dvec3())) == one.inside
        };
        let mut clear = vec![false; own.len()];
        self.cpu.for_ranges_mut(&mut clear, 1, 1, |range, clear| {
            clear.iter_mut().zip(&own[range]).for_each(|(clear, one)| *clear = is_clear(one));
        });
        let own: Vec<LetGo> = own.into_iter().zip(clear).filter(|(_, clear)| *clear).map(|(one, _)| one).collect();
        let mut taken: BTreeSet<LetGo> = BTreeSet::new();
        share_lists(rank.transport, &own, &mut |_, part: &[LetGo]| taken.extend(part.iter().copied()))?;
        if !taken.is_empty() {
            self.let_go.pairs.retain(|one| !taken.contains(one));
            self.leave_out();
        }
        stats.let_go.taken_up += taken.len() as u64;
        stats.let_go.pairs = self.let_go.pairs.len() as u64;
        Ok(())
    }
}
