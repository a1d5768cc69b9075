//! Products to compare the stored, pipelined product with: from element records without a matrix, and after a gather of
//! all sub-vectors. Only benchmarks use them.

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
