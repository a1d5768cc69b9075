//! Distributed preconditioned conjugate gradients on a rank's rows: SpMV in both exchange modes, vector kernels,
//! reductions in a fixed order.

mod coarse;
mod colored;
mod colored_cpu;
pub mod comparison;
mod double;
pub mod exchange;
mod gather;
mod gather_cpu;
pub mod linear_solver;
pub mod operator;
pub mod pcg;
pub mod pipelined;
pub mod preconditioner;
mod rank_pattern;
pub mod reduction;
pub mod schwarz;
pub mod spmv;
mod spmv_cpu;
mod sweep;
mod sweep_cpu;
mod two_level;
pub mod vector;
mod vector_cpu;

pub use crate::scene::PreconditionerKind;
pub use double::{DoubleEnd, DoubleInfo, DoubleOperator, DoublePcg};
pub use exchange::{ExchangeMode, HaloExchange, TrafficCounter};
pub use linear_solver::{LinearSolver, LinearSystem};
pub use operator::{Operator, StoredMatrix};
pub use pcg::{Pcg, PcgError, PcgInfo, PcgParams};
pub use pipelined::PipelinedSpmv;
pub use preconditioner::{Jacobi, Preconditioner};
pub use rank_pattern::RankPattern;
pub use reduction::ReductionTree;
pub use schwarz::Schwarz;
pub use vector::PcgVectors;
