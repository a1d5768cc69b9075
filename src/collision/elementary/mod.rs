//! Elementary tests between the two parts of a pair, a vertex and a face or two edges: closest points, proximity,
//! continuous collision, and the exact static test of an edge against a triangle.
//!
//! Functions of a few vectors, without allocation and without state; nothing here uses a mesh. Pairs whose parts
//! share a vertex always touch, so the broad phase must not report them.

// Conditions are negated so that NaN compares as "proves nothing".
#[allow(clippy::neg_cmp_op_on_partial_ord)]
mod ccd;
#[allow(clippy::neg_cmp_op_on_partial_ord)]
mod closest;
pub mod lanes;
#[allow(clippy::neg_cmp_op_on_partial_ord)]
mod planes;
mod real;

pub use super::candidate::CandidateKind;
pub use ccd::{Ccd, DecidedBy, Filtered, ccd, ccd_fallback, ccd_filter};
pub use closest::{Closest, Feature, Proximity, closest_offset, closest_points, proximity};
// Defined in `mesh`, because the check of start states uses it too.
pub use crate::mesh::edge_crosses_triangle;
