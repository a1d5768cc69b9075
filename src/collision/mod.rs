//! Collision detection [Li et al. 2020, Sec. 4.2]: triangle hash table, workload table, proximity, continuous collision
//! detection. [`Detector`] is what a step asks; `broad` and `elementary` are its stages. Stages pass [`Candidate`]s:
//! pairs of features that may touch, not pairs that do.

mod around;
pub mod body;
pub mod broad;
mod candidate;
mod contact;
mod detector;
pub mod elementary;
mod let_go;
mod narrow;
// Conditions are negated where NaN must fail them.
#[allow(clippy::neg_cmp_op_on_partial_ord)]
mod rules;
mod search;
mod sewn_sides;
mod way;

pub use candidate::{Candidate, CandidateKind, Impact};
pub use detector::{DetectionStats, Detector, merge_contacts, merge_impacts, smallest_altitudes};
pub use let_go::LeftOut;
pub use rules::{ContactParams, DetectorError};
pub use search::RunsOn;
pub use way::StraightWay;
