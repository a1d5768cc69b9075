//! Loomtree: a distributed simulator for very large cloth.
//!
//! The order of the modules below is the flow of the data and the order of imports: a module uses only modules above
//! it (`tests/tidy/` fails on an upward import). `ARCHITECTURE.md` draws the house.

pub mod math;
pub mod os;
pub mod telemetry;
pub mod input;
pub mod gpu;
pub mod interconnect;
pub mod transport;
pub mod context;
pub mod mesh;
pub mod scene;
pub mod partition;
pub mod forces;
pub mod assembly;
pub mod solver;
pub mod integrator;
pub mod model;
pub mod linear_system;
pub mod collision;
pub mod impact_zone;
pub mod step;
pub mod output;
pub mod time_parallel;
pub mod protocol;
pub mod worker;
pub mod coordinator;
pub mod cli;

#[cfg(test)]
mod test_support;
#[cfg(test)]
extern crate self as loomtree;
