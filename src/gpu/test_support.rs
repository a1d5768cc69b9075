//! Help for tests that need a device.

use super::{Executor, GpuExecutor};

/// A device for a test, or None (after a line on standard output) on a machine without adapters.
/// Panics without an adapter where `LOOMTREE_REQUIRE_GPU=1`, and wherever an adapter exists but gives no device.
pub fn executor() -> Option<Executor> {
    if super::adapters().is_empty() {
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

/// As [`executor`], on a device that pretends to bind at most `bytes` bytes of an array, so that small arrays are split as
/// large ones are.
pub fn executor_binding(bytes: u64) -> Option<Executor> {
    executor()?;
    match GpuExecutor::open(None, 0, bytes) {
        Ok(gpu) => Some(Executor::Gpu(Box::new(gpu))),
        Err(error) => panic!("{error}"),
    }
}

/// Numbers for seeded tests; the same for the same seed everywhere.
pub struct Seeded(u64);

impl Seeded {
    /// Starts from `seed`.
    pub fn new(seed: u64) -> Seeded {
        Seeded(seed)
    }

    /// 32 bits of the SplitMix64 sequence [Steele et al. 2014].
    pub fn bits(&mut self) -> u32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 32) as u32
    }

    /// A number below `limit`.
    pub fn below(&mut self, limit: u32) -> u32 {
        ((u64::from(self.bits()) * u64::from(limit)) >> 32) as u32
    }

    /// A number of `low..high`.
    pub fn uniform(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * (self.bits() >> 8) as f32 / (1u32 << 24) as f32
    }
}
