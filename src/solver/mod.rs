//! Distributed preconditioned conjugate gradients on a rank's rows: SpMV in both exchange modes, vector kernels,
//! reductions in a fixed order.

mod coarse;
mod colored;
mod colored_cpu;
pub mod exchange;
mod gather;
mod gather_cpu;
pub mod matrix_free;
mod matrix_free_cpu;
pub mod pcg;
pub mod pipelined;
pub mod reduction;
pub mod schwarz;
pub mod spmv;
mod spmv_cpu;
mod sweep;
mod sweep_cpu;
pub mod vector;
mod vector_cpu;

pub use crate::scene::PreconditionerKind;
pub use exchange::{ExchangeMode, HaloExchange, TrafficCounter};
pub use pcg::{Pcg, PcgError, PcgInfo, PcgParams, PcgVectors};
pub use pipelined::PipelinedSpmv;
pub use reduction::ReductionTree;
pub use schwarz::{RankPattern, Schwarz};
