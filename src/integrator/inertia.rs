//! What inertia asks of a second solve: the momentum that the first one has given already.

use super::inertia_cpu;
use crate::gpu::{DeviceVec, Executor, KernelSource, gpu_struct};

static INERTIA: KernelSource =
    KernelSource::new::<InertiaParams>("integrator/inertia.wgsl", include_str!("inertia.wgsl"), "inertia");

gpu_struct! {
    struct InertiaParams { rows: u32 }
}

/// The kernel on one executor.
pub struct Inertia {}

impl Inertia {
    /// Prepares the kernel.
    pub fn new(_executor: &Executor) -> Inertia {
        Inertia {}
    }

    /// rhs -= m dv over the own rows: masses (kg), velocity changes (m/s) and impulses (N s) of these.
    pub fn apply(&self, executor: &Executor, masses: &DeviceVec<f32>, dv: &DeviceVec<f32>, rhs: &mut DeviceVec<f32>) {
        match executor {
            Executor::Cpu(cpu) => inertia_cpu::inertia(cpu, masses.as_slice(), dv.as_slice(), rhs.as_mut_slice()),
            Executor::Gpu(gpu) => {
                let rows = dv.len() / 3;
                let params = InertiaParams { rows: rows as u32 };
                gpu.run(&INERTIA, &[masses.binding(), dv.binding(), rhs.binding_mut()], &params, rows as u64);
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
    fn shader_and_structs_agree() {
        INERTIA.check().unwrap();
    }

    #[test]
    fn the_momentum_given_is_taken_from_the_right_hand_side() {
        let cpu = Executor::cpu(1);
        let masses = DeviceVec::upload(&cpu, &[2.0f32, 0.5]);
        let dv = DeviceVec::upload(&cpu, &[1.0f32, 0.0, -1.0, 4.0, 2.0, 0.0]);
        let mut rhs = DeviceVec::upload(&cpu, &[1.0f32; 6]);
        Inertia::new(&cpu).apply(&cpu, &masses, &dv, &mut rhs);
        assert_eq!(rhs.read(&cpu), [-1.0, 1.0, 3.0, -1.0, 0.0, 1.0]);
    }

    #[test]
    fn device_equals_the_native_twin() {
        let Some(gpu) = device::executor_binding(1 << 16) else { return };
        let mut seeded = Seeded::new(3);
        let rows = 777;
        let mut random = |count: usize| (0..count).map(|_| seeded.uniform(-1.0, 1.0)).collect::<Vec<f32>>();
        let (masses, dv, rhs) = (random(rows), random(rows * 3), random(rows * 3));
        let run = |executor: &Executor| {
            let [masses, dv, mut rhs] = [&masses, &dv, &rhs].map(|values| DeviceVec::upload(executor, values));
            Inertia::new(executor).apply(executor, &masses, &dv, &mut rhs);
            rhs.read(executor)
        };
        let (device, native) = (run(&gpu), run(&Executor::cpu(2)));
        assert!(device.iter().zip(&native).all(|(d, n)| (d - n).abs() <= 1e-6), "within a rounding or two");
    }
}
