//! Continuous collision test of one pair over one step with linear trajectories.
//!
//! Never a miss: "apart" is answered only if planes prove it for every time of the step, for the exact real-number
//! question on the given f32 coordinates (see `planes`). Touching counts as a hit. False hits are possible where the
//! parts come closer than a few 1e-16 of the pair's size without touching, or where the limit on planes is reached;
//! they are not told apart from true ones.
//!
//! No additive or conservative-advancement scheme in plain floating point decides here (as [Li et al. 2021, Sec. 5] does):
//! without error bounds they step through contacts.

use super::planes::{Advance, Differences, advance};
use crate::collision::CandidateKind;
use crate::math::Vec3;

/// Planes tried in f32: most pairs of a broad phase are proven apart by the first.
const FILTER_PLANES: u32 = 4;
/// Planes tried in f64 before the pair is called a hit. Plain hits take 2 to 8, grazing ones about 30.
const FALLBACK_PLANES: u32 = 160;

/// The test that decided a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum DecidedBy {
    /// The boxes swept by the parts are apart along a coordinate axis (compared exactly).
    Boxes,
    /// Planes with f32 error bounds.
    Planes,
    /// Planes with f64 error bounds: apart, or touching up to rounding.
    Fallback,
    /// The limit on planes was reached; the pair is reported as a hit.
    PlaneLimit,
}

/// Answer of the continuous test of one pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ccd {
    /// A lower bound of the first time in [0, 1] at which the parts touch (or come within the separation); none if they
    /// are apart during the whole step. 0 if they touch at the start.
    pub toi: Option<f32>,
    /// The test that gave the answer.
    pub decided_by: DecidedBy,
}

/// Answer of [`ccd_filter`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Filtered {
    /// Proven apart during the whole step.
    Apart(DecidedBy),
    /// The fallback must decide. The pair is proven apart up to and including this time (0: nothing is known).
    Undecided(f32),
}

/// First contact of a pair whose vertices move on straight lines from `x_t0` to `x_t1` while time goes from 0 to 1.
///
/// Vertex order as in [`crate::collision::Candidate`]. Contact means a distance of at most `separation_m`; 0 asks for
/// touching. NaN or infinite coordinates and a negative separation give a hit at 0.
pub fn ccd(kind: CandidateKind, x_t0: [Vec3; 4], x_t1: [Vec3; 4], separation_m: f32) -> Ccd {
    match ccd_filter(kind, x_t0, x_t1, separation_m) {
        Filtered::Apart(decided_by) => Ccd { toi: None, decided_by },
        Filtered::Undecided(start) => ccd_fallback(kind, x_t0, x_t1, separation_m, start),
    }
}

/// The f32 part of [`ccd`]: rejects, never accepts. Only f32 additions, products, quotients and square roots.
pub fn ccd_filter(kind: CandidateKind, x_t0: [Vec3; 4], x_t1: [Vec3; 4], separation_m: f32) -> Filtered {
    if !(separation_m >= 0.0) {
        return Filtered::Undecided(0.0);
    }
    if boxes_apart(kind, x_t0, x_t1, separation_m) {
        return Filtered::Apart(DecidedBy::Boxes);
    }
    match advance(&Differences::<f32>::new(kind, x_t0, x_t1, separation_m), 0.0, FILTER_PLANES) {
        Advance::Apart => Filtered::Apart(DecidedBy::Planes),
        Advance::Until(t) | Advance::Limited(t) => Filtered::Undecided(t),
        Advance::Never => Filtered::Undecided(0.0),
    }
}

/// The f64 part of [`ccd`]: decides. `apart_until` is what the filter answered.
pub fn ccd_fallback(kind: CandidateKind, x_t0: [Vec3; 4], x_t1: [Vec3; 4], separation_m: f32, apart_until: f32) -> Ccd {
    if !(separation_m >= 0.0) {
        return Ccd { toi: Some(0.0), decided_by: DecidedBy::Fallback };
    }
    match advance(&Differences::<f64>::new(kind, x_t0, x_t1, separation_m), f64::from(apart_until), FALLBACK_PLANES) {
        Advance::Apart => Ccd { toi: None, decided_by: DecidedBy::Fallback },
        Advance::Until(t) => Ccd { toi: Some(round_down(t)), decided_by: DecidedBy::Fallback },
        Advance::Limited(t) => Ccd { toi: Some(round_down(t)), decided_by: DecidedBy::PlaneLimit },
        Advance::Never => Ccd { toi: Some(0.0), decided_by: DecidedBy::Fallback },
    }
}

/// Exact comparison: a rounded difference exceeds the separation only if the true one does.
fn boxes_apart(kind: CandidateKind, x_t0: [Vec3; 4], x_t1: [Vec3; 4], separation_m: f32) -> bool {
    let low = |i: usize| x_t0[i].min(x_t1[i]);
    let high = |i: usize| x_t0[i].max(x_t1[i]);
    let (low_a, high_a, low_b, high_b) = match kind {
        CandidateKind::VertexFace => {
            (low(0), high(0), low(1).min(low(2)).min(low(3)), high(1).max(high(2)).max(high(3)))
        }
        CandidateKind::EdgeEdge => (low(0).min(low(1)), high(0).max(high(1)), low(2).min(low(3)), high(2).max(high(3))),
    };
    let separation = Vec3::splat(separation_m);
    // Minima hide NaN; the sum does not.
    let total: Vec3 = x_t0.iter().chain(&x_t1).sum();
    total.is_finite() && ((low_a - high_b).cmpgt(separation).any() || (low_b - high_a).cmpgt(separation).any())
}

/// The largest f32 not above `t`, for `t` in [0, 1].
fn round_down(t: f64) -> f32 {
    let nearest = t as f32;
    if f64::from(nearest) > t { nearest.next_down() } else { nearest }
}
