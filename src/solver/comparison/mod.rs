//! Ways to multiply that the stored, pipelined product is compared with: from element records without a matrix, and with all
//! sub-vectors gathered before anything is multiplied. For benchmarks; no run takes them.

mod diagonal;
mod diagonal_cpu;
mod element_matrix;
mod gather_first;
mod matrix_free;
mod matrix_free_cpu;

pub use diagonal::fill_diagonal;
pub use element_matrix::ElementMatrix;
pub use gather_first::GatherFirst;
pub use matrix_free::{MatrixFree, MatrixFreeProduct};
