//! The start-up test of a device: a few values that drivers are known to get wrong, checked before anything is simulated.

use super::array::Binding;
use super::device::GpuExecutor;
use super::error::GpuError;
use super::kernel::KernelSource;
use super::layout::gpu_struct;

/// Loop turns that every kernel may count on (the prelude states the rule).
const SAFE_TURNS: u32 = 60_000;

static SELF_TEST: KernelSource =
    KernelSource::new::<SelfTestParams>("gpu/self_test.wgsl", include_str!("self_test.wgsl"), "self_test");

gpu_struct! {
    struct SelfTestParams { turns: u32, zero: f32 }
}

/// Properties of a device that passed the start-up test.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SelfTest {
    /// Loops of 70,000 turns run to their end too; false on drivers that end them silently at 65,535.
    pub long_loops: bool,
    /// `x != x` finds NaN; WGSL does not promise it and kernels do not use it.
    pub nan_compares_unequal: bool,
}

fn judge(words: [u32; 5]) -> Result<SelfTest, String> {
    let turned = |turns| (0..turns).fold(1u32, |x, _| x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    if words[0] != turned(SAFE_TURNS) {
        return Err(format!("a loop of {SAFE_TURNS} turns gives {:#x}, not {:#x}", words[0], turned(SAFE_TURNS)));
    }
    if words[2] != 0 || words[3] != 1 {
        return Err("the bits of a NaN and of 0 are not told apart".to_string());
    }
    Ok(SelfTest { long_loops: words[1] == turned(SAFE_TURNS + 10_000), nan_compares_unequal: words[4] == 1 })
}

impl GpuExecutor {
    /// Runs the start-up test.
    ///
    /// # Errors
    /// Kernels could compute wrong numbers on this device, or the device stopped.
    pub fn self_test(&self) -> Result<SelfTest, GpuError> {
        const WORDS: usize = 5;
        let out = self.allocate((WORDS * 4) as u64);
        let window = Binding { array: &out, offset: 0, size: (WORDS * 4) as u64, writable: true };
        self.run(&SELF_TEST, &[window], &SelfTestParams { turns: SAFE_TURNS, zero: 0.0 }, 3 * 128);
        let mut words = [0u32; WORDS];
        self.commands().read(&mut [out.read_part(0, bytemuck::cast_slice_mut(&mut words))]);
        if let Some(fault) = self.fault() {
            return Err(fault);
        }
        judge(words).map_err(|reason| GpuError::SelfTest { adapter: self.adapter().describe(), reason })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_answers_are_refused() {
        SELF_TEST.check().unwrap();
        let turned = |turns| (0..turns).fold(1u32, |x, _| x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
        let good = [turned(60_000), turned(70_000), 0, 1, 1];
        assert_eq!(judge(good), Ok(SelfTest { long_loops: true, nan_compares_unequal: true }));
        assert!(judge([7, good[1], 0, 1, 1]).unwrap_err().contains("60000"));
        assert!(judge([good[0], good[1], 1, 1, 1]).is_err());
        let trapped = judge([good[0], 7, 0, 1, 0]);
        assert_eq!(trapped, Ok(SelfTest { long_loops: false, nan_compares_unequal: false }));
    }
}
