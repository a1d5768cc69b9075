//! Four pairs at once: a separating-axis test that rejects most pairs of a broad phase before the tests proper look at
//! them one by one. Rejects only what is proven apart, by the argument of `planes`: one direction whose products with all
//! differences exceed the separation, at the start and at the end of the step, errors of rounding included.
//!
//! The directions are those that decide at the start in exact arithmetic: normals of the face (of both edges) and, within
//! that plane, of their borders. Nothing is answered about pairs that none of them separates.

use glam::{BVec4A, Vec4};

use crate::collision::CandidateKind;

/// Three components, each of four pairs.
pub type Lanes = [Vec4; 3];

/// Exceeds the errors of a product (5 roundoffs of the sum of absolute products) and of its bound.
const SLACK: f32 = 12.0 * (f32::EPSILON / 2.0);
/// Exceeds the errors of closest points computed in f32, in the same unit.
const ROUNDED: f32 = 64.0 * (f32::EPSILON / 2.0);
/// Exceeds the absolute error of underflow: 2^-120.
const UNDERFLOW: f32 = 7.523_164e-37;

#[inline(always)]
fn sub(a: &Lanes, b: &Lanes) -> Lanes {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn dot(a: &Lanes, b: &Lanes) -> Vec4 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: &Lanes, b: &Lanes) -> Lanes {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Bit i is set if pair i may come within `separation_m[i]` while its vertices move from `x_t0` to `x_t1`; the others
/// are proven apart. Vertices as in [`crate::collision::Candidate`]; coordinates must be finite.
#[inline]
pub fn undecided(kind: CandidateKind, x_t0: &[Lanes; 4], x_t1: &[Lanes; 4], separation_m: Vec4) -> u32 {
    match kind {
        CandidateKind::VertexFace => {
            let [a, b, c] = corners(x_t0);
            let [d, e, f] = corners(x_t1);
            vertex_face(&[a, b, c, d, e, f], separation_m, SLACK)
        }
        CandidateKind::EdgeEdge => {
            let [a, b, c, d] = ends(x_t0);
            let [e, f, g, h] = ends(x_t1);
            edge_edge(&[a, b, c, d, e, f, g, h], separation_m, SLACK)
        }
    }
}

/// As [`undecided`] for pairs at rest. Also sets the bits of pairs that rounded closest points might find within the
/// separation.
#[inline]
pub fn undecided_at_rest(kind: CandidateKind, x: &[Lanes; 4], separation_m: Vec4) -> u32 {
    match kind {
        CandidateKind::VertexFace => vertex_face(&corners(x), separation_m, ROUNDED),
        CandidateKind::EdgeEdge => edge_edge(&ends(x), separation_m, ROUNDED),
    }
}

/// Differences of a vertex and the corners of a face.
#[inline(always)]
fn corners(x: &[Lanes; 4]) -> [Lanes; 3] {
    [sub(&x[0], &x[1]), sub(&x[0], &x[2]), sub(&x[0], &x[3])]
}

/// Differences of the ends of two edges.
#[inline(always)]
fn ends(x: &[Lanes; 4]) -> [Lanes; 4] {
    [sub(&x[0], &x[2]), sub(&x[0], &x[3]), sub(&x[1], &x[2]), sub(&x[1], &x[3])]
}

/// The differences of four pairs, and what bounds the errors of their products.
struct Hull<'a> {
    w: &'a [Lanes],
    largest: Lanes,
    separation_m: Vec4,
    slack: f32,
    apart: BVec4A,
}

impl<'a> Hull<'a> {
    #[inline(always)]
    fn new(w: &'a [Lanes], separation_m: Vec4, slack: f32) -> Hull<'a> {
        let mut largest = w[0].map(Vec4::abs);
        for w in &w[1..] {
            for k in 0..3 {
                largest[k] = largest[k].max(w[k].abs());
            }
        }
        Hull { w, largest, separation_m, slack, apart: BVec4A::splat(false) }
    }

    /// Tries a direction, either sign. True once all four are apart.
    #[inline(always)]
    fn split_by(&mut self, direction: &Lanes) -> bool {
        let first = dot(direction, &self.w[0]);
        let (mut lo, mut hi) = (first, first);
        for w in &self.w[1..] {
            let product = dot(direction, w);
            (lo, hi) = (lo.min(product), hi.max(product));
        }
        let error = dot(&direction.map(Vec4::abs), &self.largest) * self.slack;
        let length = lane_sqrt(dot(direction, direction));
        let bound = error + self.separation_m * length * (1.0 + SLACK) + UNDERFLOW;
        self.apart |= lo.cmpgt(bound) | hi.cmplt(-bound);
        self.apart.all()
    }
}

#[inline(always)]
fn lane_sqrt(v: Vec4) -> Vec4 {
    Vec4::from_array(v.to_array().map(f32::sqrt))
}

#[inline(always)]
fn vertex_face(w: &[Lanes], separation_m: Vec4, slack: f32) -> u32 {
    let mut hull = Hull::new(w, separation_m, slack);
    let (ab, bc, ca) = (sub(&w[0], &w[1]), sub(&w[1], &w[2]), sub(&w[2], &w[0]));
    let normal = cross(&ab, &bc);
    let decided = hull.split_by(&normal)
        || hull.split_by(&cross(&ab, &normal))
        || hull.split_by(&cross(&bc, &normal))
        || hull.split_by(&cross(&ca, &normal));
    if decided { 0 } else { !hull.apart.bitmask() & 15 }
}

#[inline(always)]
fn edge_edge(w: &[Lanes], separation_m: Vec4, slack: f32) -> u32 {
    let mut hull = Hull::new(w, separation_m, slack);
    let (u, v) = (sub(&w[2], &w[0]), sub(&w[0], &w[1]));
    let normal = cross(&u, &v);
    let decided = hull.split_by(&normal)
        || hull.split_by(&cross(&u, &normal))
        || hull.split_by(&cross(&v, &normal))
        // Parallel edges have no common plane of this kind: try the direction between them and their own direction.
        || hull.split_by(&cross(&u, &cross(&w[0], &u)))
        || hull.split_by(&u);
    if decided { 0 } else { !hull.apart.bitmask() & 15 }
}
