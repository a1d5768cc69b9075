//! Native twin of `pairs.wgsl`: plain loops, one test after the other.

use glam::Vec3A;

use super::hash_cpu::path_box;
use super::pairs::{BOXES_ONLY, BY_PAIR, PairParams};
use crate::collision::Candidate;
use crate::collision::broad::boxes::Aabb;
use crate::collision::broad::mesh::edge_of;
use crate::math::Vec3;

const ROUNDOFF: f32 = f32::EPSILON / 2.0;

/// Position of a test: its bucket and the two entries.
struct Place {
    load: [u32; 4],
    start: u32,
    end_test: u32,
    row: u32,
    partner: u32,
}

fn before_row(row: u32, all: u32) -> u32 {
    if row == 0 { 0 } else { (row * (2 * all - 1 - row)) / 2 }
}

fn locate(params: &PairParams, test_starts: &[u32], starts: &[u32], counts: &[[u32; 4]], test: u32) -> Place {
    let bucket = test_starts[..params.buckets as usize].partition_point(|&start| start <= test) - 1;
    let load = counts[params.first_bucket as usize + bucket];
    let [cloth, obstacles, visiting_cloth, _] = load;
    let all = load.iter().sum();
    let (mut place, within) = (
        Place { load, start: starts[bucket], end_test: test_starts[bucket + 1], row: 0, partner: 0 },
        test - test_starts[bucket],
    );
    let own = before_row(cloth, all);
    if within >= own {
        place.row = cloth + (within - own) / visiting_cloth;
        place.partner = cloth + obstacles + (within - own) % visiting_cloth;
        return place;
    }
    let (mut low, mut high) = (0, cloth);
    while high - low > 1 {
        let middle = (low + high) / 2;
        if before_row(middle, all) <= within {
            low = middle;
        } else {
            high = middle;
        }
    }
    (place.row, place.partner) = (low, low + 1 + within - before_row(low, all));
    place
}

fn advance(place: &mut Place) {
    let [cloth, obstacles, visiting_cloth, visiting_obstacles] = place.load;
    let residents = cloth + obstacles;
    let end = residents + visiting_cloth + if place.row < cloth { visiting_obstacles } else { 0 };
    place.partner += 1;
    if place.partner >= end {
        place.row += 1;
        place.partner = if place.row < cloth { place.row + 1 } else { residents };
    }
}

fn triangle_box(boxes: &[[u32; 4]], t: u32) -> Aabb {
    let corner = |[a, b, c, _]: [u32; 4]| Vec3A::new(f32::from_bits(a), f32::from_bits(b), f32::from_bits(c));
    Aabb { lo: corner(boxes[2 * t as usize]), hi: corner(boxes[2 * t as usize + 1]) }
}

fn meets(params: &PairParams, boxes: &[[u32; 4]], [one, tag]: [u32; 2], [other, other_tag]: [u32; 2]) -> bool {
    if (tag | other_tag) & 7 != 7 || (tag ^ other_tag) & !7 != 0 {
        return false;
    }
    let (a, b) = (triangle_box(boxes, one), triangle_box(boxes, other));
    if !a.overlaps(&b) {
        return false;
    }
    let same_piece = boxes[2 * one as usize][3] >> 6 == boxes[2 * other as usize][3] >> 6;
    params.shrink_m == 0.0 || !same_piece || a.shrink(Vec3A::splat(params.shrink_m)).overlaps(&b)
}

/// Pairs of triangles whose boxes overlap.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn box_tests(
    params: &PairParams,
    test_starts: &[u32],
    starts: &[u32],
    counts: &[[u32; 4]],
    entries: &[[u32; 2]],
    boxes: &[[u32; 4]],
    pairs: &mut [[u32; 2]],
    found: &mut [u32],
) {
    let mut place: Option<Place> = None;
    for test in params.first_test..params.end_test {
        let place = match &mut place {
            Some(place) if test < place.end_test => {
                advance(place);
                place
            }
            other => other.insert(locate(params, test_starts, starts, counts, test)),
        };
        let one = entries[(place.start + place.row) as usize];
        let other = entries[(place.start + place.partner) as usize];
        if meets(params, boxes, one, other) {
            if let Some(slot) = pairs.get_mut(found[0] as usize) {
                *slot = [one[0], other[0]];
            }
            found[0] += 1;
        }
    }
}

/// Differences of a candidate at both ends of the step.
struct Hull {
    start: [Vec3; 4],
    end: [Vec3; 4],
    largest: Vec3,
    separation_m: f32,
    slack: f32,
}

impl Hull {
    fn of(x_t0: &[f32], x_t1: &[f32], v: [u32; 4], is_edges: bool, separation_m: f32, slack: f32) -> Hull {
        let [a, b, c, d] = v;
        let pairs = if is_edges { [[a, c], [a, d], [b, c], [b, d]] } else { [[a, b], [a, c], [a, d], [a, d]] };
        let at = |x: &[f32], v: u32| Vec3::from_slice(&x[3 * v as usize..]);
        let differences = |x: &[f32]| pairs.map(|[a, b]| at(x, a) - at(x, b));
        let (start, end) = (differences(x_t0), differences(x_t1));
        let largest = start.iter().chain(&end).fold(Vec3::ZERO, |largest, w| largest.max(w.abs()));
        Hull { start, end, largest, separation_m, slack }
    }

    /// True if a direction, either sign, proves the parts more than the separation apart; bounds as in the shader.
    fn splits(&self, d: Vec3) -> bool {
        let underflow = 7.523_164e-37;
        let sum = d.x.abs() + d.y.abs() + d.z.abs();
        let (size, square) = (d.abs().dot(self.largest), d.dot(d));
        let length = if square < 1e-28 { sum } else { square.sqrt() * (1.0 + 32.0 * ROUNDOFF) };
        let bound = size * self.slack + self.separation_m * length * (1.0 + 8.0 * ROUNDOFF) + underflow * (1.0 + sum);
        if !(size.is_finite() && square.is_finite() && bound.is_finite()) {
            return false;
        }
        let products = || self.start.iter().chain(&self.end).map(|w| d.dot(*w));
        products().all(|product| product > bound) || products().all(|product| product < -bound)
    }

    fn is_apart(&self, is_edges: bool) -> bool {
        let [w0, w1, w2, _] = self.start;
        let (one, other) = if is_edges { (w2 - w0, w0 - w1) } else { (w0 - w1, w1 - w2) };
        let normal = one.cross(other);
        if self.splits(normal) || self.splits(one.cross(normal)) || self.splits(other.cross(normal)) {
            return true;
        }
        if is_edges {
            return self.splits(one.cross(w0.cross(one))) || self.splits(one);
        }
        self.splits((w2 - w0).cross(normal))
    }
}

/// Candidates of the pairs of triangles that were found.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn feature_pairs(
    params: &PairParams,
    boxes: &[[u32; 4]],
    pairs: &[[u32; 2]],
    faces: &[[u32; 4]],
    x_t0: &[f32],
    x_t1: &[f32],
    reach_m: &[f32],
    candidates: &mut [Candidate],
    found: &mut [u32],
) {
    let pad = Vec3A::splat(params.pad_m);
    let mut report = |candidate: Candidate, same_piece: bool| {
        let is_edges = !candidate.is_vertex_face();
        if params.filter_kind != BOXES_ONLY {
            let by_pair = params.filter_kind == BY_PAIR;
            let slack = ROUNDOFF * if by_pair { 128.0 } else { 24.0 };
            let reach = candidate.vertices.map(|v| if by_pair { reach_m[v as usize] } else { 0.0 });
            let separation_m = match (by_pair && same_piece, is_edges) {
                (false, _) => params.separation_m,
                (true, false) => reach[0],
                (true, true) => reach.into_iter().fold(f32::MAX, f32::min),
            };
            if Hull::of(x_t0, x_t1, candidate.vertices, is_edges, separation_m, slack).is_apart(is_edges) {
                return;
            }
        }
        if let Some(slot) = candidates.get_mut(found[1] as usize) {
            *slot = candidate;
        }
        found[1] += 1;
    };
    let edge_box = |[a, b]: [u32; 2]| path_box(x_t0, x_t1, a).join(path_box(x_t0, x_t1, b)).inflated(pad);
    for &[one, other] in &pairs[params.first_pair as usize..params.end_pair as usize] {
        let ([a0, a1, a2, a_owned], [b0, b1, b2, b_owned]) = (faces[one as usize], faces[other as usize]);
        let (a, b) = ([a0, a1, a2], [b0, b1, b2]);
        let same_piece = a_owned >> 6 == b_owned >> 6;
        let by = Vec3A::splat(if same_piece { params.shrink_m } else { 0.0 });
        let box_of = |t: u32| triangle_box(boxes, t).shrink(by);
        let (a_box, b_box) = (box_of(one), box_of(other));
        for (corners, owned, face, face_box) in [(a, a_owned, b, &b_box), (b, b_owned, a, &a_box)] {
            for (k, v) in corners.into_iter().enumerate() {
                let own = path_box(x_t0, x_t1, v).inflated(pad);
                if owned >> k & 1 != 0 && !face.contains(&v) && own.overlaps(face_box) {
                    report(Candidate::vertex_face(v, face), same_piece);
                }
            }
        }
        for edge in (0..3).filter(|k| a_owned >> (3 + k) & 1 != 0).map(|k| edge_of(a, k)) {
            let own = edge_box(edge);
            if !own.overlaps(&b_box) {
                continue;
            }
            for other in (0..3).filter(|l| b_owned >> (3 + l) & 1 != 0).map(|l| edge_of(b, l)) {
                let shared = edge.contains(&other[0]) || edge.contains(&other[1]);
                if !shared && own.shrink(by).overlaps(&edge_box(other)) {
                    report(Candidate::edge_edge(edge, other), same_piece);
                }
            }
        }
    }
}
