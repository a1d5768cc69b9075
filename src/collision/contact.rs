//! From a stencil to the pair of closest features: which one it is, in one form whatever stencil led to it, and whether
//! it is a contact at all.
//!
//! A vertex inside the reach of a face, or two edges that cross when seen along their normal, are contacts. What is
//! closest at an edge or a vertex of a surface is a contact only if it is a local minimum of the distance between both
//! surfaces: otherwise a vertex above a flat sheet would be pushed sideways by all the edges around. A vertex-edge or
//! vertex-vertex pair is seen by the vertex-face stencils of all faces there, so edge-edge stencils speak for crossing
//! edges only; edges that are nearly parallel fade out and are left to their ends, since the place where they cross is
//! rounding noise. Where both surfaces are flat across their edges, or a border of the cloth runs over a flat edge, the
//! distance changes evenly from crossing to crossing: the ends are closest, and they have contacts of their own. Where
//! one of them has a ridge, as a table's edge under cloth, every crossing counts, because the ends of the ridge may be
//! far away. Edges that cross beside a ridge, not over it, are no minimum: their normal leans, and what slides past
//! would be stopped by it.

use super::Candidate;
use super::around::Around;
use super::broad::CollisionMesh;
use super::elementary::{CandidateKind, Proximity, proximity};
use crate::forces::NO_VERTEX;
use crate::math::Vec3;

/// Squared sine of the angle between edges below which they count as parallel.
const PARALLEL: f32 = 1e-5;
/// The same from which on crossing edges have the whole stiffness of a contact, 10 degrees: the less they cross, the
/// less their normal means, and the nearer the contacts of their ends are.
const SLANTED: f32 = 0.03;
/// Cosine up to which an edge beyond the end of a pair may come closer: above the sine of [`PARALLEL`] edges, so that
/// the ends of those are kept.
const LEVEL: f32 = 4e-3;
/// The same for rounding alone.
const ROUNDING: f32 = 16.0 * f32::EPSILON;
/// Height of a face over the plane of the face beside it, in reaches, up to which both are flat.
const FLAT: f32 = 0.02;
/// The same for crossing edges: such a ridge is at most a tenth of a reach above the straight way between what its
/// faces carry.
const LOW_RIDGE: f32 = 0.4;
/// Share of a corner of a face below which a vertex over the face may lie on the border opposite.
const BORDER: f32 = 1e-4;
/// Cosine up to which a face beside an edge may lead towards the edge that crosses it.
const TILT: f32 = 0.02;
/// Distance over size below which an offset is rounding noise and surfaces give the direction.
const NOISE: f32 = 1e-5;

/// Two closest features.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pair {
    /// As in a contact element.
    pub vertices: [u32; 4],
    /// As in a contact element.
    pub kind: u32,
    /// Signed, as in a contact element.
    pub weights: [f32; 4],
    /// Unit vector from the second feature to the first.
    pub normal: Vec3,
    pub distance_m: f32,
    /// The distance where the pair was formed.
    pub gap_m: f32,
    /// Share of the stiffness of a contact: less than 1 for edges that are nearly parallel.
    pub share: f32,
    /// The most that the thickness may be, meters: see `sewn_sides`.
    pub most_m: f32,
}

impl Pair {
    /// How much farther apart the closest points get along the normal on the way from `x` to `ahead`, metres.
    pub(super) fn parting(&self, x: &[f32], ahead: &[f32]) -> f32 {
        let at = |x: &[f32], v: u32| Vec3::from_slice(&x[3 * v as usize..]);
        let present = self.vertices.iter().zip(self.weights).filter(|(v, _)| **v != NO_VERTEX);
        let parting = present.fold(Vec3::ZERO, |sum, (&v, weight)| sum + weight * (at(ahead, v) - at(x, v)));
        self.normal.dot(parting)
    }
}

/// What pairs are formed from.
pub(super) struct Surfaces<'a> {
    pub mesh: &'a CollisionMesh,
    pub around: &'a Around,
    /// Positions, three values per vertex.
    pub x: &'a [f32],
}

impl Surfaces<'_> {
    #[inline(always)]
    pub(super) fn at(&self, vertex: u32) -> Vec3 {
        Vec3::from_slice(&self.x[3 * vertex as usize..])
    }

    /// The pair of closest features of a stencil if it is a contact. Beyond `reach_m`, at least what counts as near for
    /// any pair of the stencil's vertices, there may be no answer.
    pub(super) fn closest(&self, candidate: &Candidate, reach_m: f32) -> Option<Pair> {
        let x = candidate.vertices.map(|v| self.at(v));
        if !candidate.is_vertex_face() {
            let (u, v) = (x[1] - x[0], x[3] - x[2]);
            let crossing = u.cross(v).length_squared() > PARALLEL * u.length_squared() * v.length_squared();
            let found = if crossing { proximity(CandidateKind::EdgeEdge, x, f32::MAX) } else { None };
            let [a, b, c, d] = candidate.vertices;
            let found = found.filter(|found| {
                found.feature.is_interior()
                    && found.distance <= reach_m
                    && !self.is_low([a, b], [c, d], reach_m)
                    && self.is_ridge([a, b], -found.normal)
                    && self.is_ridge([c, d], found.normal)
            });
            let squares = u.length_squared() * v.length_squared();
            let share = (u.cross(v).length_squared() / (SLANTED * squares)).min(1.0);
            return found.map(|found| Pair { share, ..whole(candidate, &found) });
        }
        let found = proximity(CandidateKind::VertexFace, x, f32::MAX)?;
        let [vertex, corners @ ..] = candidate.vertices;
        let mut near = (0..3).filter(|k| found.feature.vertices >> (k + 1) & 1 != 0).map(|k| corners[k]);
        match (near.next(), near.next(), near.next()) {
            (Some(_), Some(_), Some(_)) => {
                // On the border of two faces both would have the vertex; it is the edge's.
                let beside = (0..3).find(|&k| found.weights[k + 1] > -BORDER);
                let edge = beside.map(|k| [corners[(k + 1) % 3], corners[(k + 2) % 3]]);
                let on_edge = edge.and_then(|[a, b]| self.vertex_edge(vertex, [a.min(b), a.max(b)], reach_m));
                on_edge.or_else(|| Some(whole(candidate, &found)))
            }
            (Some(a), Some(b), None) => self.vertex_edge(vertex, [a.min(b), a.max(b)], reach_m),
            (Some(a), None, None) => self.vertex_vertex(vertex.min(a), vertex.max(a), reach_m),
            _ => None,
        }
    }

    /// A vertex and the inside of an edge; the nearer end where the vertex is beyond it.
    fn vertex_edge(&self, vertex: u32, [a, b]: [u32; 2], reach_m: f32) -> Option<Pair> {
        let (x, x_a, x_b) = (self.at(vertex), self.at(a), self.at(b));
        let edge = x_b - x_a;
        let (from_a, from_b) = ((x - x_a).dot(edge), (x_b - x).dot(edge));
        if !(from_a > 0.0 && from_b > 0.0) {
            let end = if from_a > 0.0 { b } else { a };
            return self.vertex_vertex(vertex.min(end), vertex.max(end), reach_m);
        }
        let t = from_a / (from_a + from_b);
        // Beside an end, the edges there would all have the vertex; it is the end's.
        let end = if t < BORDER { Some(a) } else { (1.0 - t < BORDER).then_some(b) };
        if let Some(pair) = end.and_then(|end| self.vertex_vertex(vertex.min(end), vertex.max(end), reach_m)) {
            return Some(pair);
        }
        let offset = if t <= 0.5 { (x - x_a) - t * edge } else { (x - x_b) + (1.0 - t) * edge };
        if offset.length() > reach_m {
            return None;
        }
        let length = edge.length();
        let over_faces = self.around.opposite(self.mesh, [a, b]);
        let minimal = over_faces.map(|c| self.at(c) - x_a).all(|side| level(offset, side, ROUNDING, length))
            && (self.is_flat([a, b], FLAT * reach_m) || self.is_end(vertex, -offset, LEVEL, length));
        minimal.then(|| {
            let faces = self.around.faces(self.mesh, a).filter(|face| face.contains(&b));
            let normal = self.direction(offset, length, self.normal_sum(faces));
            Pair {
                vertices: [vertex, a, b, NO_VERTEX],
                kind: 0,
                weights: [1.0, -(1.0 - t), -t, 0.0],
                normal,
                distance_m: offset.length(),
                gap_m: offset.length(),
                share: 1.0,
                most_m: f32::INFINITY,
            }
        })
    }

    /// Two vertices, the smaller first.
    fn vertex_vertex(&self, one: u32, other: u32, reach_m: f32) -> Option<Pair> {
        let offset = self.at(one) - self.at(other);
        if offset.length() > reach_m {
            return None;
        }
        // Wider than what several edges of a vertex would share.
        let longest = |v: u32| {
            self.around.neighbors(self.mesh, v).map(|n| (self.at(n) - self.at(v)).length()).fold(0.0, f32::max)
        };
        let extent = 2.0 * longest(one).max(longest(other));
        let minimal = self.is_end(other, offset, ROUNDING, extent) && self.is_end(one, -offset, ROUNDING, extent);
        minimal.then(|| {
            // Where they coincide, the flatter or finer surface says what is up.
            let [a, b] = [one, other].map(|v| self.normal_sum(self.around.faces(self.mesh, v)));
            let normal = if a.length_squared() > b.length_squared() { a } else { b };
            Pair {
                vertices: [one, other, NO_VERTEX, NO_VERTEX],
                kind: 0,
                weights: [1.0, -1.0, 0.0, 0.0],
                normal: self.direction(offset, 0.0, normal),
                distance_m: offset.length(),
                gap_m: offset.length(),
                share: 1.0,
                most_m: f32::INFINITY,
            }
        })
    }

    /// Whether an edge lies between two faces that are one plane up to `height_m`, one on each side.
    fn is_flat(&self, [a, b]: [u32; 2], height_m: f32) -> bool {
        let mut beside = self.around.opposite(self.mesh, [a, b]);
        let (Some(one), Some(other), None) = (beside.next(), beside.next(), beside.next()) else { return false };
        let (x, edge) = (self.at(a), self.at(b) - self.at(a));
        let [one, other] = [one, other].map(|v| self.at(v) - x);
        let normal = edge.cross(one);
        let far_side = normal.dot(edge.cross(other)) < 0.0;
        far_side && normal.dot(other).abs() <= height_m * normal.length()
    }

    /// Whether crossing edges are no contact because none of them stands out: both flat, or a border of the cloth over
    /// a flat edge.
    fn is_low(&self, one: [u32; 2], other: [u32; 2], reach_m: f32) -> bool {
        [one, other].into_iter().all(|edge| self.is_flat(edge, LOW_RIDGE * reach_m))
            || [(one, other), (other, one)]
                .into_iter()
                .any(|(hem, edge)| self.is_hem(hem) && self.is_flat(edge, FLAT * reach_m))
    }

    /// Whether an edge is a border of the cloth.
    fn is_hem(&self, edge: [u32; 2]) -> bool {
        (edge[0] as usize) < self.mesh.cloth_vertices && self.around.opposite(self.mesh, edge).count() == 1
    }

    /// Whether no face beside an edge leads from it in the unit direction `toward`, which is normal to the edge: if one
    /// does, what lies there is closer to the face than to the edge.
    fn is_ridge(&self, [a, b]: [u32; 2], toward: Vec3) -> bool {
        let (x, edge) = (self.at(a), self.at(b) - self.at(a));
        let along = |side: Vec3| edge * (side.dot(edge) / edge.length_squared());
        let mut sides = self.around.opposite(self.mesh, [a, b]).map(|c| self.at(c) - x).map(|side| side - along(side));
        sides.all(|side| level(toward, side, TILT, 0.0))
    }

    /// Whether a point `offset` away from a vertex has no point of the surface around the vertex that is closer.
    fn is_end(&self, vertex: u32, offset: Vec3, cosine: f32, extent: f32) -> bool {
        let x = self.at(vertex);
        self.around.neighbors(self.mesh, vertex).all(|other| level(offset, self.at(other) - x, cosine, extent))
    }

    /// Sum of the unit normals of faces.
    fn normal_sum(&self, faces: impl Iterator<Item = [u32; 3]>) -> Vec3 {
        let normal = |[a, b, c]: [u32; 3]| (self.at(b) - self.at(a)).cross(self.at(c) - self.at(a));
        faces.map(|face| normal(face).normalize_or_zero()).sum()
    }

    /// The direction of an offset, or the normal of the surface at its foot where the offset says nothing.
    fn direction(&self, offset: Vec3, extent: f32, normal: Vec3) -> Vec3 {
        let distance = offset.length();
        let own = (distance > NOISE * extent).then(|| offset.try_normalize()).flatten();
        own.unwrap_or_else(|| {
            let normal = if normal.dot(offset) < 0.0 { -normal } else { normal };
            normal.try_normalize().or_else(|| offset.try_normalize()).unwrap_or(Vec3::Z)
        })
    }
}

/// The insides of both parts of a stencil.
fn whole(candidate: &Candidate, found: &Proximity) -> Pair {
    Pair {
        vertices: candidate.vertices,
        kind: candidate.kind,
        weights: found.weights,
        normal: found.normal,
        distance_m: found.distance,
        gap_m: found.distance,
        share: 1.0,
        most_m: f32::INFINITY,
    }
}

/// Whether going along `side` from the foot of `offset` leads away from its tip, up to a cosine and the rounding of a
/// foot on an edge of length `extent`.
fn level(offset: Vec3, side: Vec3, cosine: f32, extent: f32) -> bool {
    offset.dot(side) <= (cosine * offset.length() + f32::EPSILON * extent) * side.length()
}
