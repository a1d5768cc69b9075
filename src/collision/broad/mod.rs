//! Broad phase: pairs of features whose swept, inflated boxes overlap, found with a triangle hash table and split evenly
//! over the ranks by a workload table [Li et al. 2020, Sec. 4.2 and 4.4].
//!
//! A native search makes these passes, each a loop over flat arrays (a layer is a slab of space, a bucket a cell's
//! place in the hash table; see docs/glossary.md):
//!
//! 1. `active`: boxes of patches of triangles, and which patches take part;
//! 2. `table`: triangles per bucket of the layers that this rank expects to be its own;
//! 3. `workload`: tests per bucket and layer, and this rank's share of them;
//! 4. per batch of buckets `fill` (entries) and `pairs` (tests).
//!
//! Ranks that work together look at an even part of the patches each and count a part of the layers each; see
//! [`Split`]. Promises the same *set* of pairs for any number of ranks, threads and batches, each pair once over all
//! ranks. Promises no order and does not say whether anything touches.

mod active;
mod boxes;
mod brute;
mod cone;
mod contour;
mod cull;
mod cut;
mod device;
mod features;
mod fill;
mod grid;
mod input;
mod layers;
mod mesh;
mod native;
mod pairs;
mod patches;
mod query;
mod split;
mod table;
mod workload;

pub use brute::brute_force;
pub use device::DeviceBroad;
pub use mesh::{CollisionMesh, CollisionMeshError};
pub use native::Broad;
pub(super) use query::nanoseconds;
pub use query::{BroadError, BroadStats, Choice, Filter, Query, Search, Sink};
pub use split::Split;
