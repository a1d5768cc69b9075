//! Loomtree: a distributed simulator for very large cloth.
//!
//! A scene is planned for a number of ranks. A session of workers (processes, or threads of this process) is loaded
//! with the plan and advances the cloth step by step; its state has the same bits for any number of workers.
//!
//! ```
//! use loomtree::{Launch, RunOptions, RunPlan, Session, SessionPlace};
//!
//! let options = RunOptions { workers: 2, resolution: Some(200), ..RunOptions::default() };
//! let plan = RunPlan::new("scenes/flag.toml".as_ref(), &options)?;
//! let mut session = Session::assemble(SessionPlace::ALONE, &options.session(), &Launch::Threads)?;
//! session.load(&plan)?;
//! session.advance(3, &mut ())?;
//! println!("state after 3 steps: {}", session.state()?.hash());
//! session.dismiss();
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! What is re-exported by name is the interface. The modules are public for the project's own tests and change without
//! notice. Their order is the flow of the data and the order of imports: a module uses only modules above it
//! (`tests/tidy/` fails on an upward import). `ARCHITECTURE.md` describes each.

// Whether a thread of the page's server may own what it does is decided through all types of wgpu, more than 128 deep.
#![recursion_limit = "256"]

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
pub mod view;
pub mod cli;

pub use collision::broad::{CollisionMesh, Split};
pub use collision::{ContactParams, Detector};
pub use coordinator::session::{Next, StepDone, Watch};
pub use coordinator::solve::{SolveOptions, SolvePlan, solve};
pub use coordinator::{
    Launch, PlanError, RunError, RunOptions, RunPlaces, RunPlan, RunSummary, Session, SessionError, SessionOptions,
    SessionPlace, run,
};
pub use gpu::{CpuExecutor, Executor};
pub use interconnect::{Schedule, ScheduleKind, Topology, plan as plan_schedule};
pub use linear_system::{BlockSystem, SolveParams, SolveStats, parse_matrix_market, read_system};
pub use mesh::TriangleMesh;
pub use model::State;
pub use scene::{Overrides, Scene, load as load_scene};
pub use step::StepStats;

#[cfg(test)]
mod test_support;
#[cfg(test)]
extern crate self as loomtree;
