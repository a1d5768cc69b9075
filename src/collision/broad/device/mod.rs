//! Broad phase on a device [Li et al. 2020, Sec. 4.2 and 4.4], with the first part of the narrow phase: what comes back is what
//! a separating-axis test in f32 with error bounds could not prove apart.
//!
//! Finds what the native search finds, less what is proven apart, each pair once over all ranks. The host looks at patches of
//! triangles as in a native search, which leaves out what culling proves free and says which layers of space a rank counts
//! (`space`); then come passes of `hash` (the table of these layers), the host's split of the tests over ranks and batches
//! from loads of chunks of buckets, and passes of `pairs` into bounded buffers, which are read back. A buffer that is too
//! small makes the pass be done again with a larger one or for fewer tests; nothing is left out.
//!
//! Entries of a bucket are in no order, so ranks number its tests differently. Only a bucket that a rank shares with
//! another one, at most two per rank, must have an order: the host sorts its entries.

mod batches;
mod count;
mod hash;
mod hash_cpu;
mod levels;
mod pairs;
mod pairs_cpu;
mod search;
mod space;
#[cfg(test)]
mod tests;

pub use search::DeviceBroad;
