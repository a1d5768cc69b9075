//! Detection as a step asks for it: contacts at the start of the step, impacts over it. Each query is a broad phase whose
//! threads run the narrow phase on what they find; candidates live in bounded buffers only.
//!
//! What all ranks find together does not depend on the number of ranks or threads, nor on memory limits: lists are sorted,
//! and the same pair of features has the same bits whoever found it. Ranks may find the same contact; merging removes it.

use std::time::Instant;

use thiserror::Error;

use super::around::Around;
use super::broad::{Broad, BroadError, BroadStats, Choice, CollisionMesh, Filter, Query, Split};
use super::contact::{Pair, Surfaces};
use super::narrow::{ContactSink, Found, ImpactSink};
use super::search::{RunsOn, Searches};
use super::{Candidate, Impact};
use crate::forces::{ContactElement, NO_VERTEX};
use crate::math::Vec3;

/// Widening of the thickness where stencils are only preselected.
const WIDER: f32 = 1.001;

/// What makes two features a contact, and what the contact is like.
#[derive(Clone, Debug, PartialEq)]
pub struct ContactParams {
    /// Distance below which features repel each other, metres. Features of one piece of cloth repel each other below half
    /// the smallest altitude around their vertices, if that is less: a fine mesh at rest does not repel itself.
    pub thickness_m: f32,
    /// Distance that counts as an impact, metres; 0 asks for touching.
    pub separation_m: f32,
    /// Stiffness of a contact over effective mass / step^2; no unit.
    pub stiffness_ratio: f32,
    /// Length of a step, seconds.
    pub step_s: f32,
    /// Per vertex: Coulomb coefficient. A contact with an obstacle has that of the obstacle's vertices, a contact of
    /// cloth with cloth the mean of both features (each the first of its vertices).
    pub friction: Vec<f32>,
    /// Per vertex: 1/mass, 1/kg; 0 for vertices whose motion is imposed (pins, obstacles).
    pub inverse_masses_per_kg: Vec<f32>,
    /// Per vertex: smallest altitude at rest of the triangles around it, metres: see [`smallest_altitudes`]. Not looked at
    /// for obstacles.
    pub smallest_altitudes_m: Vec<f32>,
}

/// Why parameters do not fit the mesh.
#[derive(Debug, Error, PartialEq)]
pub enum DetectorError {
    /// Not one value per vertex.
    #[error("{what} has {values} values, but the mesh has {vertices} vertices")]
    Count {
        /// The list.
        what: &'static str,
        /// Values given.
        values: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// Negative or no number.
    #[error("{what} is or holds {value}; it must be a number, 0 or more")]
    Value {
        /// The quantity.
        what: &'static str,
        /// What was given.
        value: f32,
    },
    /// A step without length.
    #[error("the step is {step_s} s long; it must be longer than 0")]
    Step {
        /// What was given.
        step_s: f32,
    },
}

/// What a query did on this rank. Counts repeat exactly; times do not.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectionStats {
    /// The broad phase: tests, entries, candidates, batches, memory, time. Its time of tests holds the narrow phase.
    pub broad: BroadStats,
    /// Candidates that the preselection could not rule out.
    pub tested: u64,
    /// Contacts or impacts in the list, each once.
    pub found: u64,
    /// Smallest distance of a contact found, also between features that cannot move, metres; infinite without contacts
    /// and for impacts.
    pub smallest_gap_m: f32,
    /// Time of the narrow phase, added over threads.
    pub narrow_ns: u64,
    /// Largest number of bytes held at once by this rank's share: the broad phase's and the list found.
    pub bytes: u64,
    /// Bytes of what every rank holds whatever its share: mesh, surroundings of vertices, parameters.
    pub replicated_bytes: u64,
}

/// Finds contacts and impacts of one mesh.
pub struct Detector {
    searches: Searches,
    around: Around,
    rules: Rules,
}

/// What the narrow phase must know about pairs.
pub(super) struct Rules {
    params: ContactParams,
    cloth_vertices: usize,
    pieces: Vec<u32>,
    /// Per vertex: the thickness within its piece.
    within_piece_m: Vec<f32>,
    /// The same, wider.
    reach_within_piece_m: Vec<f32>,
    /// The largest of these.
    widest_within_piece_m: f32,
    /// The largest thickness of all pairs: less than that of the parameters where there is one piece only.
    widest_m: f32,
}

/// Since a moment, at most what 64 bits hold.
pub(super) fn nanoseconds(since: Instant) -> u64 {
    u64::try_from(since.elapsed().as_nanos()).unwrap_or(u64::MAX)
}

impl Rules {
    fn new(mesh: &CollisionMesh, params: ContactParams) -> Rules {
        let limit = |&altitude_m: &f32| params.thickness_m.min(0.5 * altitude_m.max(0.0));
        let within_piece_m: Vec<f32> = params.smallest_altitudes_m.iter().map(limit).collect();
        let widest_within_piece_m = within_piece_m[..mesh.cloth_vertices].iter().fold(0.0, |a: f32, &b| a.max(b));
        let reach_within_piece_m = within_piece_m.iter().map(|thickness_m| thickness_m * WIDER).collect();
        let mut pieces = mesh.triangles.iter().map(|face| mesh.pieces[face[0] as usize]);
        let first = pieces.next();
        let one_piece = pieces.all(|piece| Some(piece) == first);
        let widest_m = if one_piece { widest_within_piece_m } else { params.thickness_m };
        let (pieces, cloth_vertices) = (mesh.pieces.clone(), mesh.cloth_vertices);
        Rules { params, cloth_vertices, pieces, within_piece_m, reach_within_piece_m, widest_within_piece_m, widest_m }
    }

    fn bytes(&self) -> u64 {
        4 * (self.params.friction.len() + self.params.inverse_masses_per_kg.len() + self.pieces.len()) as u64
            + 12 * self.within_piece_m.len() as u64
    }

    /// A distance that no contact of a stencil exceeds; somewhat more than exact, for rounded tests to decide.
    #[inline(always)]
    pub fn reach_m(&self, candidate: &Candidate) -> f32 {
        let [a, b, c, d] = candidate.vertices.map(|v| v as usize);
        let limit = |v: usize| self.within_piece_m[v];
        let reach_m = match candidate.is_vertex_face() {
            true if self.pieces[a] == self.pieces[b] => limit(a),
            false if self.pieces[a] == self.pieces[c] => limit(a).min(limit(b)).min(limit(c)).min(limit(d)),
            _ => self.params.thickness_m,
        };
        reach_m * WIDER
    }

    /// The thickness of a pair.
    fn thickness_m(&self, pair: &Pair) -> f32 {
        let vertices = || pair.vertices.into_iter().filter(|&v| v != NO_VERTEX).map(|v| v as usize);
        let mut pieces = vertices().map(|v| self.pieces[v]);
        let first = pieces.next();
        if pieces.any(|piece| Some(piece) != first) {
            return self.params.thickness_m;
        }
        vertices().fold(self.params.thickness_m, |least, v| least.min(self.within_piece_m[v]))
    }

    /// Whether a pair is closer than its thickness, or will be once it has come closer by `approach_m`.
    pub fn is_near(&self, pair: &Pair, approach_m: f32) -> bool {
        pair.distance_m - approach_m.max(0.0) < self.thickness_m(pair)
    }

    /// The element of a contact; none if nothing in it can move.
    pub fn element(&self, pair: &Pair) -> Option<ContactElement> {
        let mut mobility = 0.0;
        for (&vertex, weight) in pair.vertices.iter().zip(pair.weights) {
            if vertex != NO_VERTEX {
                mobility += weight * weight * self.params.inverse_masses_per_kg[vertex as usize];
            }
        }
        // Written so that what is no number makes no contact.
        if !(mobility > 0.0) {
            return None;
        }
        let step_s = self.params.step_s;
        Some(ContactElement {
            vertices: pair.vertices,
            weights: pair.weights,
            normal: pair.normal.to_array(),
            distance_m: pair.distance_m,
            thickness_m: self.thickness_m(pair),
            stiffness_n_m: self.params.stiffness_ratio / (mobility * step_s * step_s),
            friction: self.friction(pair),
            kind: pair.kind,
        })
    }

    fn friction(&self, pair: &Pair) -> f32 {
        let [a, b, c, _] = pair.vertices;
        let other = if pair.kind == 0 { b } else { c };
        let friction = |v: u32| self.params.friction[v as usize];
        let obstacle = [a, other].into_iter().find(|&v| v as usize >= self.cloth_vertices);
        obstacle.map_or_else(|| 0.5 * (friction(a) + friction(other)), friction)
    }
}

/// Checks lists and numbers.
fn check(mesh: &CollisionMesh, params: &ContactParams) -> Result<(), DetectorError> {
    let lists = [
        ("the list of friction coefficients", &params.friction),
        ("the list of inverse masses", &params.inverse_masses_per_kg),
        ("the list of altitudes", &params.smallest_altitudes_m),
    ];
    for (what, list) in lists {
        if list.len() != mesh.vertices {
            return Err(DetectorError::Count { what, values: list.len(), vertices: mesh.vertices });
        }
        if let Some(&value) = list.iter().find(|&&value| !(value >= 0.0)) {
            return Err(DetectorError::Value { what, value });
        }
    }
    let numbers = [
        ("the thickness", params.thickness_m),
        ("the separation", params.separation_m),
        ("the stiffness ratio", params.stiffness_ratio),
    ];
    for (what, value) in numbers {
        if !(value >= 0.0 && value.is_finite()) {
            return Err(DetectorError::Value { what, value });
        }
    }
    if !(params.step_s > 0.0) {
        return Err(DetectorError::Step { step_s: params.step_s });
    }
    Ok(())
}

impl Detector {
    /// A detector for `mesh`.
    ///
    /// # Errors
    /// The parameters do not have one value per vertex, or a value is negative or no number.
    pub fn new(mesh: CollisionMesh, params: ContactParams) -> Result<Detector, DetectorError> {
        check(&mesh, &params)?;
        let (around, rules) = (Around::new(&mesh), Rules::new(&mesh, params));
        Ok(Detector { searches: Searches::new(Broad::new(mesh)), around, rules })
    }

    /// The mesh.
    pub fn mesh(&self) -> &CollisionMesh {
        self.searches.native.mesh()
    }

    /// The parameters.
    pub fn params(&self) -> &ContactParams {
        &self.rules.params
    }

    /// Other parameters from now on, as when a pin opens or the step changes.
    ///
    /// # Errors
    /// As [`Detector::new`]; then the old ones stay.
    pub fn set_params(&mut self, params: ContactParams) -> Result<(), DetectorError> {
        check(self.searches.native.mesh(), &params)?;
        self.rules = Rules::new(self.searches.native.mesh(), params);
        Ok(())
    }

    /// The contact that a stencil of the mesh leads to at positions `x`, if there is one: what [`Detector::contacts`] does
    /// with every candidate.
    pub fn contact(&self, x: &[f32], stencil: &Candidate) -> Option<ContactElement> {
        let surfaces = Surfaces { mesh: self.searches.native.mesh(), around: &self.around, x };
        let pair =
            surfaces.closest(stencil, self.rules.reach_m(stencil)).filter(|pair| self.rules.is_near(pair, 0.0))?;
        self.rules.element(&pair)
    }

    /// The contacts at positions `x` (x, y, z of every vertex, metres: cloth, then obstacles) that fall to `rank`, sorted,
    /// each once; see [`merge_contacts`] for those of all ranks. Clears `out` first. All ranks must run on executors of one
    /// kind; what they find together has the same bits on every kind, as native code decides in the end.
    ///
    /// # Errors
    /// As [`Broad::candidates`].
    pub fn contacts<'a>(
        &mut self,
        on: impl Into<RunsOn<'a>>,
        x: &[f32],
        rank: usize,
        ranks: usize,
        memory_limit_bytes: Option<u64>,
        out: &mut Vec<ContactElement>,
    ) -> Result<DetectionStats, BroadError> {
        self.contacts_ahead(on, x, x, &mut Split::alone(rank, ranks), memory_limit_bytes, out)
    }

    /// As [`Detector::contacts`], with those pairs, too, that are farther apart at `x` and come closer than their thickness
    /// on the straight way to `ahead`, as their closest points at `x` see it: fast cloth then meets a repulsion before it
    /// meets cloth. Of those that only come closer, kinds of executors may find a few others: a direction that keeps a pair
    /// apart may be found by one and not by the other.
    ///
    /// # Errors
    /// As [`Broad::candidates`].
    pub fn contacts_ahead<'a>(
        &mut self,
        on: impl Into<RunsOn<'a>>,
        x: &[f32],
        ahead: &[f32],
        split: &mut Split,
        memory_limit_bytes: Option<u64>,
        out: &mut Vec<ContactElement>,
    ) -> Result<DetectionStats, BroadError> {
        out.clear();
        let Detector { searches, around, rules } = self;
        let mesh = searches.native.mesh().clone();
        let surfaces = Surfaces { mesh: &mesh, around, x };
        let wide = |thickness_m: f32| thickness_m * WIDER;
        let query = Query { x_t0: x, x_t1: ahead, radius_m: wide(rules.widest_m) };
        let ahead = (!std::ptr::eq(x, ahead)).then_some(ahead);
        let choice = Choice { touched: None, piece_radius_m: Some(wide(rules.widest_within_piece_m)), cull: true };
        let reach_m = wide(rules.params.thickness_m);
        let filter = Filter::ByStencil { reach_m, within_piece_m: &rules.reach_within_piece_m };
        let start = || ContactSink { surfaces: &surfaces, ahead, rules, found: Found::new() };
        let mut all = Found { items: std::mem::take(out), ..Found::new() };
        let finish = &mut |sink: ContactSink| all.append(sink.found);
        let stats = searches.search(on.into(), &query, &choice, &filter, split, memory_limit_bytes, &start, finish)?;
        let stats = self.stats(stats, &all);
        *out = all.items;
        sort_contacts(out);
        Ok(DetectionStats { found: out.len() as u64, ..stats })
    }

    /// The pairs of features that touch on the straight way from `x_t0` to `x_t1` and fall to `rank`, sorted; each is found
    /// by exactly one rank. Executors as in [`Detector::contacts`]. With `touched` (one mark per vertex) only pairs with a marked vertex: a search after a few
    /// vertices have been moved, which costs one look at every triangle's box and the work near those vertices. Clears `out`
    /// first.
    ///
    /// # Errors
    /// As [`Broad::candidates`].
    pub fn impacts<'a>(
        &mut self,
        on: impl Into<RunsOn<'a>>,
        x_t0: &[f32],
        x_t1: &[f32],
        touched: Option<&[bool]>,
        rank: usize,
        ranks: usize,
        memory_limit_bytes: Option<u64>,
        out: &mut Vec<Impact>,
    ) -> Result<DetectionStats, BroadError> {
        let split = &mut Split::alone(rank, ranks);
        self.impacts_split(on, x_t0, x_t1, touched, split, memory_limit_bytes, out)
    }

    /// As [`Detector::impacts`], by ranks that may work together.
    ///
    /// # Errors
    /// As [`Broad::search`].
    pub fn impacts_split<'a>(
        &mut self,
        on: impl Into<RunsOn<'a>>,
        x_t0: &[f32],
        x_t1: &[f32],
        touched: Option<&[bool]>,
        split: &mut Split,
        memory_limit_bytes: Option<u64>,
        out: &mut Vec<Impact>,
    ) -> Result<DetectionStats, BroadError> {
        out.clear();
        let separation_m = self.rules.params.separation_m;
        let query = Query { x_t0, x_t1, radius_m: separation_m * WIDER };
        let choice = Choice { touched, piece_radius_m: None, cull: true };
        let start = || ImpactSink { x_t0, x_t1, separation_m, touched, found: Found::new() };
        let mut all = Found { items: std::mem::take(out), ..Found::new() };
        let finish = &mut |sink: ImpactSink| all.append(sink.found);
        let (on, filter) = (on.into(), Filter::Separation { separation_m });
        let stats = self.searches.search(on, &query, &choice, &filter, split, memory_limit_bytes, &start, finish)?;
        let stats = self.stats(stats, &all);
        *out = all.items;
        sort_impacts(out);
        Ok(DetectionStats { found: out.len() as u64, ..stats })
    }

    fn stats<T>(&self, broad: BroadStats, all: &Found<T>) -> DetectionStats {
        DetectionStats {
            broad,
            tested: all.tested,
            found: 0,
            smallest_gap_m: all.smallest_gap_m,
            narrow_ns: all.ns,
            bytes: broad.bytes + size_of_val(&all.items[..]) as u64,
            replicated_bytes: self.searches.mesh_bytes() + self.around.bytes() + self.rules.bytes(),
        }
    }
}

fn sort_contacts(contacts: &mut Vec<ContactElement>) {
    contacts.sort_unstable_by_key(ContactElement::key);
    contacts.dedup_by_key(|contact| contact.key());
}

fn sort_impacts(impacts: &mut Vec<Impact>) {
    impacts.sort_unstable_by_key(|impact| impact.candidate);
    impacts.dedup_by_key(|impact| impact.candidate);
}

/// The contacts of all ranks as one sorted list, each once. Equal keys have equal bits, so the order of the lists does not
/// matter.
pub fn merge_contacts(lists: &[&[ContactElement]]) -> Vec<ContactElement> {
    let mut all = lists.concat();
    sort_contacts(&mut all);
    all
}

/// The impacts of all ranks as one sorted list.
pub fn merge_impacts(lists: &[&[Impact]]) -> Vec<Impact> {
    let mut all = lists.concat();
    sort_impacts(&mut all);
    all
}

/// Per vertex the smallest altitude, metres, of the `triangles` around it in their rest shapes (three corners each, material
/// coordinates in metres with any third component); infinite for a vertex in no triangle.
pub fn smallest_altitudes(vertices: usize, triangles: &[[u32; 3]], rest: impl Fn(usize) -> [Vec3; 3]) -> Vec<f32> {
    let mut smallest = vec![f32::INFINITY; vertices];
    for (triangle, corners) in triangles.iter().enumerate() {
        let [a, b, c] = rest(triangle);
        let longest = (b - a).length().max((c - b).length()).max((a - c).length());
        let area = (b - a).cross(c - a).length();
        let altitude = if longest > 0.0 { area / longest } else { 0.0 };
        for &vertex in corners {
            smallest[vertex as usize] = smallest[vertex as usize].min(altitude);
        }
    }
    smallest
}
