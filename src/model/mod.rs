//! Data of the ranks, built from a scene: the global order of vertices, elements and masses ([`GlobalModel`], on the
//! coordinator), one rank's part of it ([`RankModel`], sent to a worker), the data of the whole scene that every rank
//! needs for collisions ([`CollisionModel`]), and the state that steps advance ([`State`]).

mod collision;
mod cut;
mod folds;
mod global;
mod grips;
mod rank;
mod seam_reach;
mod sewn;
mod state;

pub use collision::{CollisionArrays, CollisionModel, PinSpan};
pub use cut::Cut;
pub use global::{GlobalModel, stiffness_ratio};
pub use rank::{RankArrays, RankModel, RankModelError};
pub use sewn::Sewn;
pub use state::{
    Crease, LetGo, NotFinite, PlasticCounts, PlasticElements, RankState, RankStateError, RestStretch, State,
    UNSTRETCHED, hash_words,
};
