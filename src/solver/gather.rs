//! Packs the rows that other ranks read into a message. A device runs one kernel per vector, then one read.

use super::gather_cpu;
use crate::gpu::{DeviceVec, Executor, KernelSource, gpu_struct};

static GATHER: KernelSource =
    KernelSource::new::<GatherParams>("solver/gather.wgsl", include_str!("gather.wgsl"), "gather");

gpu_struct! {
    struct GatherParams { count: u32, first: u32, planes: u32, plane: u32 }
}

/// The gather kernel on one executor, for fixed rows.
#[derive(Default)]
pub(super) struct Gather {
    /// Rows and message on a device. They are created on first use and grow to the size needed.
    device: Option<(DeviceVec<u32>, DeviceVec<f32>)>,
}

impl Gather {
    /// message[row of `rows`][vector] = the row's three values. Own rows begin at row `first` of the vectors; the rows must be
    /// the same in every call.
    pub(super) fn apply(
        &mut self,
        executor: &Executor,
        rows: &[u32],
        first: usize,
        vectors: &[&DeviceVec<f32>],
        message: &mut [f32],
    ) {
        let planes = vectors.len();
        assert_eq!(message.len(), rows.len() * planes * 3);
        match executor {
            Executor::Cpu(_) => {
                let slices: Vec<&[f32]> = vectors.iter().map(|v| v.as_slice()).collect();
                gather_cpu::gather(rows, first, &slices, message);
            }
            Executor::Gpu(gpu) => {
                if self.device.as_ref().is_none_or(|(_, packed)| packed.len() < message.len()) {
                    self.device = Some((DeviceVec::upload(executor, rows), DeviceVec::zeros(executor, message.len())));
                }
                let Some((device_rows, packed)) = &mut self.device else { return };
                for (plane, vector) in vectors.iter().enumerate() {
                    let params = GatherParams {
                        count: rows.len() as u32,
                        first: first as u32,
                        planes: planes as u32,
                        plane: plane as u32,
                    };
                    gpu.run(
                        &GATHER,
                        &[device_rows.binding(), vector.binding(), packed.binding_mut()],
                        &params,
                        rows.len() as u64,
                    );
                }
                packed.read_range(executor, 0, message);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::device;
    use crate::test_support::seeded::Seeded;

    #[test]
    fn device_equals_the_native_twin() {
        let Some(gpu) = device::executor() else { return };
        let mut seeded = Seeded::new(3);
        let (a, b): (Vec<f32>, Vec<f32>) =
            (0..1500).map(|_| (seeded.uniform(-1.0, 1.0), seeded.uniform(-1.0, 1.0))).unzip();
        let rows: Vec<u32> = (0..400).filter(|r| r % 3 != 1).collect();
        let run = |executor: &Executor| {
            let (a, b) = (DeviceVec::upload(executor, &a), DeviceVec::upload(executor, &b));
            let mut gather = Gather::default();
            let (mut one, mut two) = (vec![0.0; rows.len() * 3], vec![0.0; rows.len() * 6]);
            gather.apply(executor, &rows, 55, &[&b], &mut one);
            gather.apply(executor, &rows, 55, &[&a, &b], &mut two);
            gather.apply(executor, &[], 55, &[&a], &mut []);
            (one, two)
        };
        assert!(run(&gpu) == run(&Executor::cpu(1)));
    }
}
