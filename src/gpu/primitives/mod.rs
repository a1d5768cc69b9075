//! Building blocks that several rooms use.

mod scan;
mod scan_cpu;

pub use scan::exclusive_scan;
