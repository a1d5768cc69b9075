//! Distributed preconditioned conjugate gradients on a rank's rows: SpMV in both exchange modes, vector kernels,
//! reductions in a fixed order.

pub mod exchange;
mod gather;
mod gather_cpu;
pub mod pcg;
pub mod pipelined;
pub mod reduction;
pub mod spmv;
mod spmv_cpu;
pub mod vector;
mod vector_cpu;

pub use exchange::{ExchangeMode, HaloExchange, TrafficCounter};
pub use pcg::{Pcg, PcgError, PcgInfo, PcgParams, PcgVectors};
pub use pipelined::PipelinedSpmv;
pub use reduction::ReductionTree;
