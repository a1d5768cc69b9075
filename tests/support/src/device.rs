//! Devices for tests, and what a test does on a machine without one. The unit tests of the library include this file
//! too.

use loomtree::gpu::{Executor, adapters};

/// A device for a test, or none (after a line on standard output) on a machine without adapters.
///
/// # Panics
/// Without an adapter where `LOOMTREE_REQUIRE_GPU=1`, and wherever an adapter exists but gives no device.
pub fn executor() -> Option<Executor> {
    if adapters().is_empty() {
        let required = std::env::var("LOOMTREE_REQUIRE_GPU").is_ok_and(|value| value == "1");
        assert!(!required, "LOOMTREE_REQUIRE_GPU=1, but this machine has no adapter");
        println!("skipped: no adapter");
        return None;
    }
    match Executor::gpu(None, 0) {
        Ok(executor) => Some(executor),
        Err(error) => panic!("{error}"),
    }
}

/// As [`executor`], on a device that pretends to bind at most `bytes` bytes of an array, so that small arrays are split
/// as large ones are.
pub fn executor_binding(bytes: u64) -> Option<Executor> {
    executor()?;
    match Executor::gpu_binding(None, 0, bytes) {
        Ok(executor) => Some(executor),
        Err(error) => panic!("{error}"),
    }
}
