//! A shot split in time [Liang and Lin 2018]: pure functions on states and costs. No process, no clock, no transport.
//! How a coarse state becomes a fine one, how far two states are apart, where a shot is cut, and what that gains on a
//! virtual clock.

mod distance;
pub mod partition;
mod upsample;
mod virtual_run;

pub use distance::{Comparison, Distance, rms};
pub use upsample::Upsampling;
pub use virtual_run::{Costs, Cut, Method, Partition, Played};
