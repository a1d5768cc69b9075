//! Separation over time by planes: the mathematics that both the f32 filter and the f64 fallback run.
//!
//! Let `w_i(t)` be the differences (vertex of the first part) - (vertex of the second part): 3 for a vertex and a face, 4
//! for two edges. At time t the parts are at most `s` apart iff the convex hull of the `w_i(t)` is within `s` of the
//! origin. So one direction `d` with `d . w_i(t) > s |d|` for all `i` proves them apart at `t`. With linear trajectories
//! `d . w_i(t) = (1-t) d . w_i(0) + t d . w_i(1)`: for a fixed `d` the times proven are an interval with closed form, from
//! products of the inputs alone. [`advance`] starts at t = 0, asks the closest points at `t` for a direction, moves `t` to
//! the end of the interval, and so on: a Newton iteration for the first contact that only ever steps over proven times.
//! Where the parts turn about each other its steps get short; a plane that turns with time (`d` linear in `t`, the
//! products quadratic, bounded by their Bernstein coefficients) takes longer ones and ends as fast.
//!
//! How a direction is found does not matter for correctness, so only the products carry error bounds. Contracting a
//! product and a sum to one rounding only lowers the errors; flushing subnormal numbers is covered by `UNDERFLOW`.

use super::closest::{above_triangle, across_segments, segment_ends, triangle_border, unit_size};
use super::real::{Real, V, add, dot, of, scale, sub};
use crate::collision::CandidateKind;
use crate::math::Vec3;

/// Advances below this many roundoffs of the step's length count as short.
const SHORT_STEP: f32 = 512.0;
/// This many short advances in a row are a contact: a true contact ends in them, because rounding leaves no better
/// plane.
const SHORT_STEPS: u32 = 2;

/// The differences of a pair at both ends of the step.
#[derive(Clone, Copy)]
pub(super) struct Differences<T> {
    kind: CandidateKind,
    len: usize,
    w_t0: [V<T>; 4],
    w_t1: [V<T>; 4],
    separation: T,
}

/// Time up to which the parts are proven apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Advance<T> {
    /// Over the whole step.
    Apart,
    /// Up to and including this time; the next plane found proves nothing (the parts touch, up to rounding).
    Until(T),
    /// Up to and including this time; stopped by the limit on planes.
    Limited(T),
    /// Not even at the start.
    Never,
}

impl<T: Real> Differences<T> {
    pub(super) fn new(kind: CandidateKind, x_t0: [Vec3; 4], x_t1: [Vec3; 4], separation: f32) -> Differences<T> {
        let differences = |x: [Vec3; 4]| {
            let x: [V<T>; 4] = x.map(of);
            match kind {
                CandidateKind::VertexFace => [sub(x[0], x[1]), sub(x[0], x[2]), sub(x[0], x[3]), [T::ZERO; 3]],
                CandidateKind::EdgeEdge => [sub(x[0], x[2]), sub(x[0], x[3]), sub(x[1], x[2]), sub(x[1], x[3])],
            }
        };
        let (w_t0, w_t1) = (differences(x_t0), differences(x_t1));
        let len = if kind == CandidateKind::VertexFace { 3 } else { 4 };
        Differences { kind, len, w_t0, w_t1, separation: T::of(separation) }
    }

    /// Differences at time `t`; each component is within 8 roundoffs of the sum of its values at the ends of
    /// the step, without signs.
    fn at(&self, t: T) -> [V<T>; 4] {
        let mut w = self.w_t0;
        for i in 0..self.len {
            w[i] = add(self.w_t0[i], scale(t, sub(self.w_t1[i], self.w_t0[i])));
        }
        w
    }

    /// The bound that an exact product with `direction` must exceed, so that the distance exceeds the separation.
    fn gap(&self, direction: V<T>) -> T {
        self.separation * dot(direction, direction).sqrt() * (T::ONE + T::of(16.0) * T::ROUNDOFF) + T::UNDERFLOW
    }

    /// The end of the open interval around `t` over which `direction` proves separation, if `t` is in it; more than 1 if
    /// the interval goes on beyond.
    ///
    /// Errors of a product, in roundoffs of `sum |d_k| |w_k|`: 1 for the differences, 3 for the products and sums, 1 for
    /// subtracting the bound; 8 leaves room for the rounding of the bound itself.
    fn proven_until(&self, direction: V<T>, t: T) -> Option<T> {
        let gap = self.gap(direction);
        let slack = T::of(8.0) * T::ROUNDOFF;
        let bound = |w: V<T>| {
            let error = slack * dot(direction.map(T::abs), w.map(T::abs));
            dot(direction, w) - (error + gap)
        };
        let mut end = T::of(2.0);
        for i in 0..self.len {
            let (start_bound, end_bound) = (bound(self.w_t0[i]), bound(self.w_t1[i]));
            if start_bound > T::ZERO && end_bound > T::ZERO {
                continue;
            }
            if start_bound > T::ZERO && end_bound <= T::ZERO {
                end = end.least(start_bound / (start_bound - end_bound) * (T::ONE - slack));
            } else if end_bound > T::ZERO && start_bound <= T::ZERO {
                let begin = start_bound / (start_bound - end_bound) * (T::ONE + slack) + T::UNDERFLOW;
                // The negation makes NaN prove nothing.
                if !(begin < t) {
                    return None;
                }
            } else {
                return None;
            }
        }
        (t < end).then_some(end)
    }

    /// The time until which, ends included, the direction that goes linearly from `d_a` at `t_a` to `d_b` at `t_b` proves
    /// separation: `t_b` or less, `t_a` if there is nothing to gain. Both directions have largest component 1.
    ///
    /// Errors as above, and 8 for the differences at the ends.
    fn proven_turning(&self, d_a: V<T>, t_a: T, d_b: V<T>, t_b: T) -> T {
        // |d| between the ends is at most the larger one of both: |.| is convex.
        let gap = self.gap(d_a).most(self.gap(d_b));
        let slack = T::of(16.0) * T::ROUNDOFF;
        let (w_a, w_b) = (self.at(t_a), self.at(t_b));
        let half = T::ONE / T::of(2.0);
        let mut reached = T::ONE;
        for i in 0..self.len {
            // If anything below overflows, so does this, and proves nothing.
            let mut size = T::ZERO;
            for k in 0..3 {
                size = size + d_a[k].abs().most(d_b[k].abs()) * (self.w_t0[i][k].abs() + self.w_t1[i][k].abs());
            }
            let bound = slack * size + gap;
            let first = dot(d_a, w_a[i]) - bound;
            let middle = (dot(d_a, w_b[i]) + dot(d_b, w_a[i])) * half - bound;
            let last = dot(d_b, w_b[i]) - bound;
            if !(first > T::ZERO) {
                return t_a;
            }
            // The quadratic lies in the hull of its control points (0, first), (1/2, middle), (1, last); the hull first
            // meets zero on a line from one above to one below.
            if !(middle > T::ZERO) {
                reached = reached.least(half * (first / (first - middle)));
            }
            if !(last > T::ZERO) {
                reached = reached.least(first / (first - last));
                if middle > T::ZERO {
                    reached = reached.least(half + half * (middle / (middle - last)));
                }
            }
        }
        if !(reached < T::ONE) {
            return if reached >= T::ONE { t_b } else { t_a };
        }
        let time = (t_a + (t_b - t_a) * reached * (T::ONE - slack)) * (T::ONE - slack);
        if time > t_a { time } else { t_a }
    }

    /// Guess of a separating direction from differences at one time, second part to first, and whether it is the better
    /// one: the normal of the face or of both edges. Exact to rounding however small the distance.
    fn normal(&self, w: &[V<T>; 4]) -> (Option<V<T>>, bool) {
        let (normal, inside) = match self.kind {
            CandidateKind::VertexFace => above_triangle(w[0], w[1], w[2]),
            CandidateKind::EdgeEdge => across_segments(w[0], sub(w[2], w[0]), sub(w[0], w[1])),
        };
        (unit_size(if dot(normal, w[0]) < T::ZERO { negative(normal) } else { normal }), inside)
    }

    /// The other guess: the offset between the closest points where one is on a border.
    fn border(&self, w: &[V<T>; 4]) -> Option<V<T>> {
        unit_size(match self.kind {
            CandidateKind::VertexFace => triangle_border(w[0], w[1], w[2]).offset,
            CandidateKind::EdgeEdge => segment_ends(w[0], sub(w[2], w[0]), sub(w[0], w[1])).offset,
        })
    }

    /// A direction that proves separation at `t`, whether it is a normal, and the end of the interval it proves.
    fn plane_at(&self, t: T) -> Option<(V<T>, bool, T)> {
        let w = self.at(t);
        let (normal, inside) = self.normal(&w);
        let proven = |direction: Option<V<T>>, is_normal: bool| {
            let direction = direction?;
            Some((direction, is_normal, self.proven_until(direction, t)?))
        };
        if inside {
            proven(normal, true).or_else(|| proven(self.border(&w), false))
        } else {
            proven(self.border(&w), false).or_else(|| proven(normal, true))
        }
    }
}

fn negative<T: Real>(v: V<T>) -> V<T> {
    sub([T::ZERO; 3], v)
}

/// Proves separation from `start` on, with at most `planes` planes. The parts must be known to be apart up to `start`
/// (0 if nothing is known).
pub(super) fn advance<T: Real>(differences: &Differences<T>, start: T, planes: u32) -> Advance<T> {
    let mut t = start;
    let mut begun = start > T::ZERO;
    // How far ahead the next turning plane aims: a few times what the last step reached.
    let mut stride = T::ONE;
    let mut short_steps = 0;
    for count in 0..planes {
        let Some((direction, is_normal, end)) = differences.plane_at(t) else {
            return if begun { Advance::Until(t) } else { Advance::Never };
        };
        if end > T::ONE {
            return Advance::Apart;
        }
        begun = true;
        let mut reached = end;
        if count > 0 {
            let target = (t + stride).least(T::ONE);
            let w = differences.at(target);
            if let Some(ahead) = if is_normal { differences.normal(&w).0 } else { differences.border(&w) } {
                // Behind a contact the parts have changed sides.
                let ahead = if dot(ahead, direction) < T::ZERO { negative(ahead) } else { ahead };
                let turned = differences.proven_turning(direction, t, ahead, target);
                if turned >= T::ONE {
                    return Advance::Apart;
                }
                reached = reached.most(turned);
            }
        }
        stride = T::of(4.0) * (reached - t);
        short_steps = if reached - t < T::of(SHORT_STEP) * T::ROUNDOFF { short_steps + 1 } else { 0 };
        t = reached;
        if short_steps == SHORT_STEPS {
            return Advance::Until(t);
        }
    }
    Advance::Limited(t)
}
