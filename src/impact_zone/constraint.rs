//! Constraints: the direction in which the two parts of a pair must stay apart, from their motion just before the
//! impact.

use crate::collision::elementary::{CandidateKind, closest_offset};
use crate::collision::{Candidate, Impact};
use crate::math::DVec3;

/// Fractions of the time of impact at which the side is looked for, latest first.
const LOOK_BACK: [f64; 6] = [1.0, 1.0 - 1.0 / 1024.0, 1.0 - 1.0 / 64.0, 0.875, 0.5, 0.0];
/// Relative to the size of the pair and to its coordinates: the distance above which rounding does not turn the offset.
const SURE: [f64; 2] = [1e-9, 1e-14];

/// `normal . sum(weights[i] * x[i])` must not be less than the margin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Constraint {
    pub candidate: Candidate,
    /// Unit vector from the second part to the first.
    pub normal: DVec3,
    /// Signed weights of the closest points; they sum to zero.
    pub weights: [f64; 4],
}

/// Largest distance that a constraint asks for, in margins.
const MARGINS_MOST: usize = 10;
/// Error of a constraint that counts as not met, in margins.
const UNMET: f64 = 0.5;

/// The distance, in margins, that a pair's constraint number `before` (from 0) asks for. It grows with every further
/// impact of the pair, because the normals so far were not good enough. Other pairs keep their distance, because in a
/// pile every wider gap is taken from the layers around it.
pub(super) fn margins(before: usize) -> f64 {
    (1 + before).min(MARGINS_MOST) as f64
}

/// True if positions `x` meet all constraints of a pair; only then can one more help. The constraints come in the order
/// of their impacts. Those for which `moves` is false do not count.
pub(super) fn all_met<'a>(
    of_pair: impl IntoIterator<Item = &'a Constraint>,
    x: [DVec3; 4],
    margin_m: f64,
    moves: impl Fn(&Constraint) -> bool,
) -> bool {
    let met = |(before, c): (usize, &Constraint)| !moves(c) || c.gap_m(x) > margin_m * (margins(before) - UNMET);
    of_pair.into_iter().enumerate().all(met)
}

impl Constraint {
    /// Distance of the parts at positions `x`, as the constraint sees it.
    pub(super) fn gap_m(&self, x: [DVec3; 4]) -> f64 {
        self.normal.dot((0..4).map(|i| x[i] * self.weights[i]).sum())
    }

    /// The constraint of an impact whose vertices move from `x_t0` to `x_t1`.
    ///
    /// Up to the time of impact the parts are apart, so the offset of their closest points there points to the side they
    /// came from, however they turned since the start. It is taken as late as it exceeds rounding.
    pub(super) fn of_impact(impact: &Impact, x_t0: [DVec3; 4], x_t1: [DVec3; 4]) -> Constraint {
        let (candidate, kind) = (impact.candidate, impact.candidate.kind());
        let toi = f64::from(impact.toi).clamp(0.0, 1.0);
        for part in LOOK_BACK {
            let x: [DVec3; 4] = std::array::from_fn(|i| x_t0[i] + (x_t1[i] - x_t0[i]) * (part * toi));
            let (weights, offset) = closest_offset(kind, x);
            let distance = offset.length();
            let extent = x.iter().map(|p| (*p - x[0]).abs().max_element()).fold(0.0, f64::max);
            let reach = x.iter().map(|p| p.abs().max_element()).fold(0.0, f64::max);
            if distance > SURE[0] * extent + SURE[1] * reach {
                return Constraint { candidate, normal: offset / distance, weights };
            }
        }
        Constraint::of_touching(candidate, kind, x_t0, x_t1)
    }

    /// The constraint of parts that touch at the start: they have no side, so it only stops their approach.
    fn of_touching(candidate: Candidate, kind: CandidateKind, x_t0: [DVec3; 4], x_t1: [DVec3; 4]) -> Constraint {
        let (weights, offset) = closest_offset(kind, x_t0);
        let plane = match kind {
            CandidateKind::VertexFace => (x_t0[2] - x_t0[1]).cross(x_t0[3] - x_t0[1]),
            CandidateKind::EdgeEdge => (x_t0[1] - x_t0[0]).cross(x_t0[3] - x_t0[2]),
        };
        let approach: DVec3 = (0..4).map(|i| (x_t1[i] - x_t0[i]) * weights[i]).sum();
        let side = if offset.dot(plane) == 0.0 { -approach.dot(plane) } else { offset.dot(plane) };
        let along = if side < 0.0 { -plane } else { plane };
        let normal = along.try_normalize().or_else(|| (-approach).try_normalize()).unwrap_or(DVec3::X);
        Constraint { candidate, normal, weights }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::collision::elementary::ccd;
    use crate::math::Vec3;

    fn constraint(candidate: Candidate, x_t0: [[f32; 3]; 4], x_t1: [[f32; 3]; 4]) -> Constraint {
        let kind = candidate.kind();
        let toi = ccd(kind, x_t0.map(Vec3::from), x_t1.map(Vec3::from), 0.0).toi.expect("the pair hits");
        let wide = |x: [[f32; 3]; 4]| x.map(|p| Vec3::from(p).as_dvec3());
        Constraint::of_impact(&Impact { candidate, toi }, wide(x_t0), wide(x_t1))
    }

    const FACE: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];

    #[test]
    fn a_vertex_is_kept_on_its_side_of_a_face() {
        for side in [1.0, -1.0] {
            let [a, b, c] = FACE;
            let found = constraint(
                Candidate::vertex_face(0, [1, 2, 3]),
                [[0.25, 0.25, side * 1e-3], a, b, c],
                [[0.25, 0.25, -side], a, b, c],
            );
            assert!((found.normal - DVec3::Z * f64::from(side)).length() < 1e-9, "{found:?}");
            for (w, expected) in found.weights.iter().zip([1.0, -0.5, -0.25, -0.25]) {
                assert!((w - expected).abs() < 1e-6, "{found:?}");
            }
        }
    }

    #[test]
    fn the_side_is_that_of_the_impact_where_a_face_turns_over() {
        // The face turns by half a turn about the x axis while the vertex, first above it, is swept down by it: seen from
        // the face at the impact the vertex is still on the face's upper side.
        let x_t0 = [[0.2, 0.4, 0.1], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        let x_t1 = [[0.2, 0.4, 0.1], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.2, 0.9]];
        let found = constraint(Candidate::vertex_face(0, [1, 2, 3]), x_t0, x_t1);
        assert!(found.normal.z > 0.0 && found.normal.y < 0.0, "{found:?}");
    }

    #[test]
    fn crossing_edges_keep_their_order() {
        let found = constraint(
            Candidate::edge_edge([0, 1], [2, 3]),
            [[-1.0, 0.0, 0.1], [1.0, 0.0, 0.1], [0.0, -1.0, 0.0], [0.0, 3.0, 0.0]],
            [[-1.0, 0.0, -0.1], [1.0, 0.0, -0.1], [0.0, -1.0, 0.0], [0.0, 3.0, 0.0]],
        );
        assert!((found.normal - DVec3::Z).length() < 1e-9, "{found:?}");
        for (w, expected) in found.weights.iter().zip([0.5, 0.5, -0.75, -0.25]) {
            assert!((w - expected).abs() < 1e-6, "{found:?}");
        }
    }

    #[test]
    fn parts_that_touch_at_the_start_are_kept_from_going_on() {
        let [a, b, c] = FACE;
        let found = constraint(
            Candidate::vertex_face(0, [1, 2, 3]),
            [[0.25, 0.25, 0.0], a, b, c],
            [[0.25, 0.25, -1.0], a, b, c],
        );
        assert_eq!(found.normal, DVec3::Z);
    }
}
