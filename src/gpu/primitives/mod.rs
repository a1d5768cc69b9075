//! Kernels that several modules use.

mod scan;
mod scan_cpu;

pub use scan::exclusive_scan;
