//! Closest points of a vertex and a face, and of two edges [Ericson 2005, Ch. 5.1], for any shape of them: parallel,
//! collinear and collapsed to a point included.
//!
//! Distances are rounded results with errors of a few roundoffs of the pair's size; nothing here is a decision that
//! must not be wrong. Continuous tests use the vectors found here only as guesses of directions.

use super::real::{Real, V, add, clamp01, cross, dot, of, scale, size, sub};
use crate::collision::CandidateKind;
use crate::math::{DVec3, Vec3};

/// Squared sine (roughly) below which a face or a pair of edges is compared with its borders as well, because the
/// solution in its inside may be noise.
const THIN: f32 = 1e-5;

/// Closest points of a pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Closest {
    /// Squared distance, m^2; rounded.
    pub distance_squared: f32,
    /// The point of the first part (vertex, first edge) minus the point of the second (face, second edge), meters.
    pub offset: Vec3,
    /// Barycentric weights: vertex-face `[1, a, b, c]`, edge-edge `[a0, a1, b0, b1]`; those of each part sum to 1.
    pub weights: [f32; 4],
    /// The closest feature: the vertices whose weight is not zero.
    pub feature: Feature,
}

/// The vertices of a pair that span the closest feature: a face has three, an edge two, a corner one of its part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Feature {
    /// Bit `i` is set for vertex `i` of the pair.
    pub vertices: u8,
}

impl Feature {
    fn of_weights(weights: [f32; 4]) -> Feature {
        Feature { vertices: (0..4).map(|i| u8::from(weights[i] != 0.0) << i).sum() }
    }

    /// The vertex and the inside of the face, or the insides of both edges.
    pub fn is_interior(self) -> bool {
        self.vertices == 0b1111
    }

    /// Number of vertices involved: 2 (two points), 3 (a point and an edge) or 4.
    pub fn count(self) -> u32 {
        self.vertices.count_ones()
    }
}

/// A pair closer than the thickness: what a contact is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Proximity {
    /// Distance, meters; 0 where the parts touch or cross.
    pub distance: f32,
    /// Unit vector from the second part (face, second edge) to the first. Where they touch, the normal of the face or of
    /// both edges with arbitrary sign.
    pub normal: Vec3,
    /// Signed weights: `sum(weights[i] * x[i]) = distance * normal`; they sum to zero.
    pub weights: [f32; 4],
    /// The closest feature.
    pub feature: Feature,
}

/// Closest points of the two parts of a pair.
pub fn closest_points(kind: CandidateKind, x: [Vec3; 4]) -> Closest {
    let x: [V<f32>; 4] = x.map(of);
    let (weights, found) = match kind {
        CandidateKind::VertexFace => {
            let found = point_triangle(sub(x[0], x[1]), sub(x[0], x[2]), sub(x[0], x[3]));
            ([1.0, found.weights[0], found.weights[1], found.weights[2]], found.offset)
        }
        CandidateKind::EdgeEdge => {
            let found = segment_segment(sub(x[0], x[2]), sub(x[1], x[0]), sub(x[3], x[2]));
            let [s, t] = found.parameters;
            ([1.0 - s, s, 1.0 - t, t], found.offset)
        }
    };
    Closest {
        distance_squared: dot(found, found),
        offset: Vec3::from(found),
        weights,
        feature: Feature::of_weights(weights),
    }
}

/// Closest points of a pair in f64: signed weights, which sum to zero, and `sum(weights[i] * x[i])`, the point of the
/// first part minus the point of the second.
pub fn closest_offset(kind: CandidateKind, x: [DVec3; 4]) -> ([f64; 4], DVec3) {
    let x: [V<f64>; 4] = x.map(|p| p.to_array());
    match kind {
        CandidateKind::VertexFace => {
            let found = point_triangle(sub(x[0], x[1]), sub(x[0], x[2]), sub(x[0], x[3]));
            let [a, b, c] = found.weights;
            ([1.0, -a, -b, -c], DVec3::from(found.offset))
        }
        CandidateKind::EdgeEdge => {
            let found = segment_segment(sub(x[0], x[2]), sub(x[1], x[0]), sub(x[3], x[2]));
            let [s, t] = found.parameters;
            ([1.0 - s, s, t - 1.0, -t], DVec3::from(found.offset))
        }
    }
}

/// The contact of a pair whose parts are at most `thickness_m` apart (rounded); none otherwise.
pub fn proximity(kind: CandidateKind, x: [Vec3; 4], thickness_m: f32) -> Option<Proximity> {
    let closest = closest_points(kind, x);
    let distance = closest.distance_squared.sqrt();
    // The negation makes NaN no contact.
    if !(distance <= thickness_m) {
        return None;
    }
    let [w0, w1, w2, w3] = closest.weights;
    let weights = match kind {
        CandidateKind::VertexFace => [w0, -w1, -w2, -w3],
        CandidateKind::EdgeEdge => [w0, w1, -w2, -w3],
    };
    let plane_normal = match kind {
        CandidateKind::VertexFace => (x[2] - x[1]).cross(x[3] - x[1]),
        CandidateKind::EdgeEdge => (x[1] - x[0]).cross(x[3] - x[2]),
    };
    // An offset far below the size of the pair is rounding noise; the plane of the parts is not.
    let extent = x.iter().map(|v| (*v - x[0]).abs().max_element()).fold(0.0, f32::max);
    let noise = distance <= 1e-4 * extent && closest.feature.is_interior();
    let along = if closest.offset.dot(plane_normal) < 0.0 { -plane_normal } else { plane_normal };
    let normal = (if noise { along.try_normalize() } else { closest.offset.try_normalize() })
        .or_else(|| along.try_normalize())
        .or_else(|| (x[1] - x[0]).try_normalize().map(|edge| edge.any_orthonormal_vector()))
        .unwrap_or(Vec3::X);
    Some(Proximity { distance, normal, weights, feature: closest.feature })
}

/// Closest point of a triangle.
#[derive(Clone, Copy)]
pub(super) struct OnTriangle<T> {
    pub weights: [T; 3],
    /// Point minus closest point of the triangle.
    pub offset: V<T>,
}

/// Closest points of two segments.
#[derive(Clone, Copy)]
pub(super) struct OnSegments<T> {
    pub parameters: [T; 2],
    /// Point on the first minus point on the second.
    pub offset: V<T>,
}

/// Normal of the triangle and whether the point projects into it; from the point minus each of the corners.
pub(super) fn above_triangle<T: Real>(ap: V<T>, bp: V<T>, cp: V<T>) -> (V<T>, bool) {
    let (normal, areas) = face_areas(ap, bp, cp);
    (normal, dot(normal, normal) > T::ZERO && areas.iter().all(|&a| a >= T::ZERO))
}

/// Normal of the triangle and the areas opposite to its corners, seen from the projected point, times a common factor.
fn face_areas<T: Real>(ap: V<T>, bp: V<T>, cp: V<T>) -> (V<T>, [T; 3]) {
    let (ab, bc, ca) = (sub(ap, bp), sub(bp, cp), sub(cp, ap));
    let normal = cross(ab, bc);
    (normal, [dot(cross(bc, bp), normal), dot(cross(ca, cp), normal), dot(cross(ab, ap), normal)])
}

/// Closest point of a triangle to a point, from the point minus each of the corners.
pub(super) fn point_triangle<T: Real>(ap: V<T>, bp: V<T>, cp: V<T>) -> OnTriangle<T> {
    let (normal, areas) = face_areas(ap, bp, cp);
    let mut best = None;
    if dot(normal, normal) > T::ZERO && areas.iter().all(|&a| a >= T::ZERO) {
        let total = areas[0] + areas[1] + areas[2];
        let weights = areas.map(|a| a / total);
        let offset = scale(dot(ap, normal) / dot(normal, normal), normal);
        let (ab, ac) = (sub(ap, bp), sub(ap, cp));
        if total > T::ZERO && dot(normal, normal) > T::of(THIN) * dot(ab, ab) * dot(ac, ac) {
            return OnTriangle { weights, offset };
        }
        if total > T::ZERO {
            // The plane of a needle is noise; the combination of its corners is not.
            let offset = add(scale(weights[0], ap), add(scale(weights[1], bp), scale(weights[2], cp)));
            best = Some(OnTriangle { weights, offset });
        }
    }
    let border = triangle_border(ap, bp, cp);
    match best {
        Some(best) if dot(best.offset, best.offset) < dot(border.offset, border.offset) => best,
        _ => border,
    }
}

/// Closest point of the border of a triangle.
pub(super) fn triangle_border<T: Real>(ap: V<T>, bp: V<T>, cp: V<T>) -> OnTriangle<T> {
    let corners = [ap, bp, cp];
    let mut best = OnTriangle { weights: [T::ONE, T::ZERO, T::ZERO], offset: ap };
    for i in 0..3 {
        let j = (i + 1) % 3;
        let (s, offset) = point_segment(corners[i], sub(corners[i], corners[j]));
        if dot(offset, offset) < dot(best.offset, best.offset) {
            best.weights = [T::ZERO; 3];
            best.weights[i] = T::ONE - s;
            best.weights[j] = s;
            best.offset = offset;
        }
    }
    best
}

/// Closest point of the segment from the origin to `edge`, to `p`: parameter, and `p` minus the closest point.
fn point_segment<T: Real>(p: V<T>, edge: V<T>) -> (T, V<T>) {
    let length_squared = dot(edge, edge);
    let s = if length_squared > T::ZERO { clamp01(dot(p, edge) / length_squared) } else { T::ZERO };
    // Measured from the far end where that is the closest point, so that no cancellation remains.
    (s, if s == T::ONE { sub(p, edge) } else { sub(p, scale(s, edge)) })
}

/// Common normal of the segments `a + s u` and `b + t v`, `between = a - b`, and whether the closest points of their lines
/// are on both.
pub(super) fn across_segments<T: Real>(between: V<T>, u: V<T>, v: V<T>) -> (V<T>, bool) {
    let (normal, [s, t], sine) = line_parameters(between, u, v);
    (normal, sine > T::ZERO && s >= T::ZERO && s <= sine && t >= T::ZERO && t <= sine)
}

/// Common normal of two lines, the parameters of their closest points times a common factor, and that factor.
fn line_parameters<T: Real>(between: V<T>, u: V<T>, v: V<T>) -> (V<T>, [T; 2], T) {
    let normal = cross(u, v);
    (normal, [dot(cross(v, between), normal), dot(cross(u, between), normal)], dot(normal, normal))
}

/// Closest points of the segments `a + s u` and `b + t v`, `between = a - b`.
pub(super) fn segment_segment<T: Real>(between: V<T>, u: V<T>, v: V<T>) -> OnSegments<T> {
    let (normal, [s, t], sine) = line_parameters(between, u, v);
    let mut best = None;
    if sine > T::ZERO && s >= T::ZERO && s <= sine && t >= T::ZERO && t <= sine {
        let parameters = [s / sine, t / sine];
        if sine > T::of(THIN) * dot(u, u) * dot(v, v) {
            return OnSegments { parameters, offset: scale(dot(between, normal) / sine, normal) };
        }
        let offset = sub(add(between, scale(parameters[0], u)), scale(parameters[1], v));
        best = Some(OnSegments { parameters, offset });
    }
    let ends = segment_ends(between, u, v);
    match best {
        Some(best) if dot(best.offset, best.offset) < dot(ends.offset, ends.offset) => best,
        _ => ends,
    }
}

/// Closest points of two segments among those where one is an end.
pub(super) fn segment_ends<T: Real>(between: V<T>, u: V<T>, v: V<T>) -> OnSegments<T> {
    let negative = |a: V<T>| sub([T::ZERO; 3], a);
    let (a0, a1) = (between, add(between, u));
    let (t, offset) = point_segment(a0, v);
    let mut best = OnSegments { parameters: [T::ZERO, t], offset };
    let mut keep = |parameters: [T; 2], offset: V<T>| {
        if dot(offset, offset) < dot(best.offset, best.offset) {
            best = OnSegments { parameters, offset };
        }
    };
    let (t, offset) = point_segment(a1, v);
    keep([T::ONE, t], offset);
    let (s, offset) = point_segment(negative(a0), u);
    keep([s, T::ZERO], negative(offset));
    let (s, offset) = point_segment(sub(v, a0), u);
    keep([s, T::ONE], negative(offset));
    best
}

/// A multiple of `direction` with largest component 1, or none if it has no direction.
pub(super) fn unit_size<T: Real>(direction: V<T>) -> Option<V<T>> {
    let largest = size(direction);
    (largest > T::UNDERFLOW).then(|| direction.map(|c| c / largest))
}
