//! From a scene to what the ranks hold: the global order of vertices, elements and masses ([`GlobalModel`], on the
//! coordinator), and one rank's part of it ([`RankModel`], which travels to a worker).

mod global;
mod rank;

pub use global::GlobalModel;
pub use rank::{RankArrays, RankModel, RankModelError};
