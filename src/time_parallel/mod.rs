//! A shot split in time [Liang and Lin 2018]: pure functions on states and costs. No process, no clock, no transport.
//! So far: how far two states are apart, where a shot is cut, and what that gains on a virtual clock.

mod distance;
pub mod partition;
mod virtual_run;

pub use distance::{Comparison, Distance, rms};
pub use virtual_run::{Costs, Method, Partition, Played};
