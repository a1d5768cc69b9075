//! The tests on the device: pairs of triangles whose boxes overlap, then candidates. The kernels count results even
//! where the buffer is full, so that the host can repeat the pass with a larger buffer.
//!
//! The set of pairs does not depend on the device's timing; their order does.

use super::hash::{DeviceEntries, DeviceTable, Shapes};
use super::pairs_cpu;
use crate::collision::Candidate;
use crate::gpu::{DeviceVec, Executor, KernelSource, gpu_struct};

const TEXT: &str = include_str!("pairs.wgsl");
const LIBRARIES: &[&str] = &[include_str!("boxes.wgsl")];
static BOX_TESTS: KernelSource =
    KernelSource::new::<PairParams>("collision/broad/device/pairs.wgsl", TEXT, "box_tests").with_libraries(LIBRARIES);
static FEATURE_PAIRS: KernelSource =
    KernelSource::new::<PairParams>("collision/broad/device/pairs.wgsl", TEXT, "feature_pairs")
        .with_libraries(LIBRARIES);

/// Tests that one invocation makes, as in the shader.
const SHARE: u32 = 32;
/// Values of [`PairParams::filter_kind`], as in the shader.
pub(super) const BOXES_ONLY: u32 = 0;
pub(super) const BY_PAIR: u32 = 1;
pub(super) const SEPARATION: u32 = 2;

gpu_struct! {
    pub(super) struct PairParams {
        pub first_bucket: u32,
        pub buckets: u32,
        pub first_test: u32,
        pub end_test: u32,
        pub pair_room: u32,
        pub first_pair: u32,
        pub end_pair: u32,
        pub candidate_room: u32,
        pub filter_kind: u32,
        pub pad_m: f32,
        pub shrink_m: f32,
        pub separation_m: f32,
    }
}

/// Bounded buffers of pairs of triangles and of candidates, and how many of each there were.
pub(super) struct FoundPairs {
    pub pairs: DeviceVec<[u32; 2]>,
    pub candidates: DeviceVec<Candidate>,
    counters: DeviceVec<u32>,
}

impl FoundPairs {
    pub(super) fn new(executor: &Executor) -> FoundPairs {
        FoundPairs {
            pairs: DeviceVec::zeros(executor, 0),
            candidates: DeviceVec::zeros(executor, 0),
            counters: DeviceVec::zeros(executor, 2),
        }
    }

    /// Bytes of both buffers, unused capacity included.
    pub(super) fn bytes(&self) -> u64 {
        self.pairs.held_bytes() + self.candidates.held_bytes() + self.counters.held_bytes()
    }

    /// Pairs of triangles with overlapping boxes among the tests `params.first_test..params.end_test`; how many there are.
    pub(super) fn box_tests(
        &mut self,
        executor: &Executor,
        params: &PairParams,
        table: &DeviceTable,
        of: &DeviceEntries,
    ) -> usize {
        let params = PairParams { pair_room: self.pairs.len() as u32, ..*params };
        self.counters.fill_zero(executor);
        match executor {
            Executor::Cpu(_) => pairs_cpu::box_tests(
                &params,
                of.test_starts.as_slice(),
                of.starts.as_slice(),
                table.counts.as_slice(),
                of.entries.as_slice(),
                table.boxes.as_slice(),
                self.pairs.as_mut_slice(),
                self.counters.as_mut_slice(),
            ),
            Executor::Gpu(gpu) => {
                let bindings = [
                    of.test_starts.binding(),
                    of.starts.binding(),
                    table.counts.binding(),
                    of.entries.binding(),
                    table.boxes.binding(),
                    self.pairs.binding_mut(),
                    self.counters.binding_mut(),
                ];
                let invocations = (params.end_test - params.first_test).div_ceil(SHARE);
                gpu.run(&BOX_TESTS, &bindings, &params, u64::from(invocations));
            }
        }
        self.counters.read(executor)[0] as usize
    }

    /// Candidates of the pairs `params.first_pair..params.end_pair`; how many there are.
    pub(super) fn feature_pairs(
        &mut self,
        executor: &Executor,
        params: &PairParams,
        table: &DeviceTable,
        shapes: &Shapes,
        reach_m: &DeviceVec<f32>,
    ) -> usize {
        let params = PairParams { candidate_room: self.candidates.len() as u32, ..*params };
        self.counters.fill_zero(executor);
        match executor {
            Executor::Cpu(_) => pairs_cpu::feature_pairs(
                &params,
                table.boxes.as_slice(),
                self.pairs.as_slice(),
                shapes.faces.as_slice(),
                shapes.x_t0.as_slice(),
                shapes.end().as_slice(),
                reach_m.as_slice(),
                self.candidates.as_mut_slice(),
                self.counters.as_mut_slice(),
            ),
            Executor::Gpu(gpu) => {
                let bindings = [
                    table.boxes.binding(),
                    self.pairs.binding_mut(),
                    self.counters.binding_mut(),
                    shapes.faces.binding(),
                    shapes.x_t0.binding(),
                    shapes.end().binding(),
                    reach_m.binding(),
                    self.candidates.binding_mut(),
                ];
                gpu.run(&FEATURE_PAIRS, &bindings, &params, u64::from(params.end_pair - params.first_pair));
            }
        }
        self.counters.read(executor)[1] as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shader_and_wrapper_agree() {
        for kernel in [&BOX_TESTS, &FEATURE_PAIRS] {
            // Every adapter binds eight arrays.
            assert!(kernel.check().unwrap().arrays.len() <= 8);
        }
        assert!(TEXT.contains(&format!("const SHARE: u32 = {SHARE}u;")));
        for (name, value) in [("BOXES_ONLY", BOXES_ONLY), ("BY_PAIR", BY_PAIR)] {
            assert!(TEXT.contains(&format!("const {name}: u32 = {value}u;")), "{name}");
        }
    }
}
