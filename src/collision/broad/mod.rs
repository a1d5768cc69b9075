//! Broad phase: pairs of features whose swept, inflated boxes overlap, found with a triangle hash table and split evenly
//! over the ranks by a workload table [Li et al. 2020, Sec. 4.2 and 4.4].
//!
//! Passes: look (boxes of patches of triangles, which of them take part), count (triangles per bucket of the layers that
//! this rank guesses to be its own), scan (tests per bucket and layer, share of this rank), then per batch of buckets fill
//! and test. Each is loops over flat arrays. Ranks that work together look at an even part of the patches each and count a
//! part of the layers each; see [`Split`]. Promises the same *set* of pairs for any number of ranks, threads and batches,
//! each pair once over all ranks; not an order. Does not say whether anything touches.

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
