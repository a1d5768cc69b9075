//! Detection as a step asks for it: contacts at the start of the step, impacts over it. Each query is a broad phase
//! whose threads run the narrow phase on what they find; candidates live in bounded buffers only.
//!
//! What all ranks find together does not depend on the number of ranks or threads, nor on memory limits: lists are
//! sorted, and the same pair of features has the same bits whoever found it. Ranks may find the same contact; merging
//! removes it.

use super::around::Around;
use super::broad::{Broad, BroadError, BroadStats, Choice, CollisionMesh, Filter, Query, Search, Split};
use super::contact::Surfaces;
use super::let_go::{LeftOut, LetGo};
use super::narrow::{ContactSink, Findings, ImpactSink, contact_of};
use super::rules::{ContactParams, DetectorError, Rules, WIDER};
use super::search::{RunsOn, Searches};
use super::sewn_sides::SewnSides;
use super::{Candidate, Impact};
use crate::forces::ContactElement;
use crate::gpu::CpuExecutor;
use crate::math::Vec3;

/// Counts, times and memory of one query on this rank. Counts repeat exactly; times do not.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectionStats {
    /// The broad phase: tests, entries, candidates, batches, memory, time. Its time of tests holds the narrow phase.
    pub broad: BroadStats,
    /// Candidates that the preselection could not rule out.
    pub tested: u64,
    /// Contacts or impacts in the list, each once.
    pub found: u64,
    /// Smallest distance of a contact found, also between features that cannot move, meters; infinite without contacts
    /// and for impacts.
    pub smallest_gap_m: f32,
    /// Time of the narrow phase, nanoseconds, added over threads.
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
    memory_limit_bytes: Option<u64>,
    /// Candidates of this rank's share that may come near on the way that the last query for contacts looked at.
    near: Vec<Candidate>,
    let_go: LetGo,
    sewn_sides: SewnSides,
}

impl Detector {
    /// A detector for `mesh`.
    ///
    /// # Errors
    /// The parameters do not have one value per vertex, or a value is negative or NaN.
    pub fn new(mesh: CollisionMesh, params: ContactParams) -> Result<Detector, DetectorError> {
        let (rules, around) = (Rules::new(&mesh, params)?, Around::new(&mesh));
        Ok(Detector {
            searches: Searches::new(Broad::new(mesh)),
            around,
            rules,
            memory_limit_bytes: None,
            near: Vec::new(),
            let_go: LetGo::default(),
            sewn_sides: SewnSides::default(),
        })
    }

    /// Pairs of cloth and obstacles that later queries leave out, instead of those before.
    pub fn leave_out(&mut self, pairs: Vec<LeftOut>) {
        self.let_go = LetGo::new(pairs, self.mesh().cloth_vertices);
    }

    /// Pairs of vertices that become one: in later queries for contacts both sides keep a distance that grows with the
    /// way along the cloth through the seam. Impacts are found all the same. `near`: pairs of a vertex and one of
    /// `pairs` that it is near along the cloth, ascending; seams are looked for there.
    pub fn sew(&mut self, pairs: &[[u32; 2]], near: &[[u32; 2]]) {
        self.sewn_sides = SewnSides::new(self.searches.native.mesh(), &self.around, pairs, near);
    }

    /// Corners of the triangles around a vertex, in the order of the mesh.
    pub fn triangles_around(&self, vertex: u32) -> impl Iterator<Item = [u32; 3]> + '_ {
        self.around.faces(self.mesh(), vertex)
    }

    /// Bounds the tables of later queries, bytes; a search that does not fit is done in batches. None, the default: no
    /// bound.
    pub fn limit_memory(&mut self, bytes: Option<u64>) {
        self.memory_limit_bytes = bytes;
    }

    /// Cloth and obstacles; the same for every query.
    pub fn mesh(&self) -> &CollisionMesh {
        self.searches.native.mesh()
    }

    /// Parameters of the next query: those of [`Detector::new`] or of the last [`Detector::set_params`].
    pub fn params(&self) -> &ContactParams {
        &self.rules.params
    }

    /// Other parameters from now on, as when a pin opens or the step changes.
    ///
    /// # Errors
    /// As [`Detector::new`]; then the old ones stay.
    pub fn set_params(&mut self, params: ContactParams) -> Result<(), DetectorError> {
        self.rules = Rules::new(self.searches.native.mesh(), params)?;
        Ok(())
    }

    /// The contact that a candidate of the mesh leads to at positions `x`, if there is one: what [`Detector::contacts`]
    /// does with every candidate.
    pub fn contact(&self, x: &[f32], candidate: &Candidate) -> Option<ContactElement> {
        let surfaces = Surfaces { mesh: self.searches.native.mesh(), around: &self.around, x };
        self.rules.element(&contact_of(&surfaces, None, &self.rules, &self.sewn_sides, candidate)?)
    }

    /// The contacts at positions `x` (x, y, z of every vertex, meters: cloth, then obstacles) that fall to this rank,
    /// sorted, each once; see [`merge_contacts`] for those of all ranks. Clears `out` first. All ranks must run on
    /// executors of one kind; what they find together has the same bits on every kind, as native code decides in the
    /// end.
    ///
    /// # Errors
    /// As [`Broad::candidates`].
    pub fn contacts<'a>(
        &mut self,
        on: impl Into<RunsOn<'a>>,
        x: &[f32],
        split: &mut Split,
        out: &mut Vec<ContactElement>,
    ) -> Result<DetectionStats, BroadError> {
        self.contacts_ahead(on, x, x, split, out)
    }

    /// As [`Detector::contacts`] for a step from `x` to about `ahead`: contacts of features as they are `ahead`, or at
    /// `x` where the way leads through; fast cloth then meets a repulsion before it meets cloth. Their distance is that
    /// at `x` along the contact's normal. Candidates that may come near on the way are kept for
    /// [`Detector::contacts_again`]. Two kinds of executors may differ in a few of the pairs that only come closer,
    /// because one may find a separating direction that the other misses.
    ///
    /// # Errors
    /// As [`Broad::candidates`].
    pub fn contacts_ahead<'a>(
        &mut self,
        on: impl Into<RunsOn<'a>>,
        x: &[f32],
        ahead: &[f32],
        split: &mut Split,
        out: &mut Vec<ContactElement>,
    ) -> Result<DetectionStats, BroadError> {
        out.clear();
        let Detector { searches, around, rules, memory_limit_bytes, near, let_go, sewn_sides } = self;
        near.clear();
        let mesh = searches.native.mesh().clone();
        let surfaces = Surfaces { mesh: &mesh, around, x };
        let wide = |thickness_m: f32| thickness_m * WIDER;
        let search = Search {
            query: Query { x_t0: x, x_t1: ahead, radius_m: wide(rules.widest_m) },
            choice: Choice { touched: None, piece_radius_m: Some(wide(rules.widest_within_piece_m)), cull: true },
            filter: Filter::ByPair {
                reach_m: wide(rules.params.thickness_m),
                within_piece_m: &rules.reach_within_piece_m,
            },
            memory_limit_bytes: *memory_limit_bytes,
        };
        let ahead = (!std::ptr::eq(x, ahead)).then_some(ahead);
        let (surfaces, let_go, sewn_sides) = (&surfaces, &*let_go, &*sewn_sides);
        let start = || {
            let (found, near) = (Findings::new(), Vec::new());
            ContactSink { surfaces, ahead, rules, let_go, sewn_sides, found, near }
        };
        let mut all = Findings { items: std::mem::take(out), ..Findings::new() };
        let finish = &mut |mut sink: ContactSink| {
            all.append(sink.found);
            near.append(&mut sink.near);
        };
        let stats = searches.search(on.into(), &search, split, &start, finish)?;
        let stats = self.stats(stats, &all);
        *out = all.items;
        sort_contacts(out);
        Ok(DetectionStats { found: out.len() as u64, ..stats })
    }

    /// The contacts of the candidates that the last [`Detector::contacts_ahead`] from `x` has kept, for another guess
    /// of the end of the step. Clears `out` first.
    pub fn contacts_again(&self, host: &CpuExecutor, x: &[f32], ahead: &[f32], out: &mut Vec<ContactElement>) {
        let surfaces = Surfaces { mesh: self.searches.native.mesh(), around: &self.around, x };
        let mut found: Vec<Option<ContactElement>> = vec![None; self.near.len()];
        host.for_ranges_mut(&mut found, 1, 64, |range, found| {
            for (candidate, found) in self.near[range].iter().zip(found) {
                let pair = contact_of(&surfaces, Some(ahead), &self.rules, &self.sewn_sides, candidate);
                *found = pair.and_then(|pair| self.rules.element(&pair));
            }
        });
        out.clear();
        out.extend(found.into_iter().flatten());
        sort_contacts(out);
    }

    /// The pairs of features that touch on the straight way from `x_t0` to `x_t1` and fall to this rank, sorted; each
    /// is found by exactly one rank. Executors as in [`Detector::contacts`]. With `touched` (one mark per vertex) only
    /// pairs with a marked vertex: a search after a few vertices have been moved, which costs one look at every
    /// triangle's box and the work near those vertices. Clears `out` first.
    ///
    /// # Errors
    /// As [`Broad::candidates`].
    pub fn impacts<'a>(
        &mut self,
        on: impl Into<RunsOn<'a>>,
        x_t0: &[f32],
        x_t1: &[f32],
        touched: Option<&[bool]>,
        split: &mut Split,
        out: &mut Vec<Impact>,
    ) -> Result<DetectionStats, BroadError> {
        out.clear();
        let separation_m = self.rules.params.separation_m;
        let search = Search {
            query: Query { x_t0, x_t1, radius_m: separation_m * WIDER },
            choice: Choice { touched, piece_radius_m: None, cull: true },
            filter: Filter::Separation { separation_m },
            memory_limit_bytes: self.memory_limit_bytes,
        };
        let let_go = &self.let_go;
        let start = || ImpactSink { x_t0, x_t1, separation_m, touched, let_go, found: Findings::new() };
        let mut all = Findings { items: std::mem::take(out), ..Findings::new() };
        let finish = &mut |sink: ImpactSink| all.append(sink.found);
        let stats = self.searches.search(on.into(), &search, split, &start, finish)?;
        let stats = self.stats(stats, &all);
        *out = all.items;
        sort_impacts(out);
        Ok(DetectionStats { found: out.len() as u64, ..stats })
    }

    fn stats<T>(&self, broad: BroadStats, all: &Findings<T>) -> DetectionStats {
        DetectionStats {
            broad,
            tested: all.tested,
            found: 0,
            smallest_gap_m: all.smallest_gap_m,
            narrow_ns: all.ns,
            bytes: broad.bytes + size_of_val(&all.items[..]) as u64,
            replicated_bytes: self.searches.mesh_bytes()
                + self.around.bytes()
                + self.rules.bytes()
                + self.sewn_sides.bytes(),
        }
    }
}

fn sort_contacts(contacts: &mut Vec<ContactElement>) {
    // A pair that several candidates lead to may be one of the start for some of them and one of the end for others.
    let bits = |contact: &ContactElement| (contact.distance_m.to_bits(), contact.weights.map(f32::to_bits));
    contacts.sort_unstable_by_key(|contact| (contact.key(), bits(contact)));
    contacts.dedup_by_key(|contact| contact.key());
}

fn sort_impacts(impacts: &mut Vec<Impact>) {
    impacts.sort_unstable_by_key(|impact| impact.candidate);
    impacts.dedup_by_key(|impact| impact.candidate);
}

/// The contacts of all ranks as one sorted list, each once. The order of the lists does not matter.
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

/// Per vertex the smallest altitude, meters, of the `triangles` around it in their rest shapes (three corners each,
/// material coordinates in meters with any third component); infinite for a vertex in no triangle.
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
