//! From a scene to what the ranks hold: the global order of vertices, elements and masses ([`GlobalModel`], on the
//! coordinator), one rank's part of it ([`RankModel`], which travels to a worker), and what every rank needs of all of it
//! for collisions ([`CollisionModel`]); and the state that steps advance ([`State`]).

mod collision;
mod global;
mod rank;
mod state;

pub use collision::{CollisionArrays, CollisionModel, PinSpan};
pub use global::GlobalModel;
pub use rank::{RankArrays, RankModel, RankModelError};
pub use state::{NotFinite, RankState, RankStateError, State, hash_words};
