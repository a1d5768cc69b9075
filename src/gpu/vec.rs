//! Arrays that live where the executor's kernels can reach them.

use bytemuck::Pod;

use super::Executor;

/// An array on an executor. Plain data only; length fixed at creation.
pub struct DeviceVec<T> {
    storage: Storage<T>,
}

enum Storage<T> {
    Cpu(Vec<T>),
}

impl<T: Pod> DeviceVec<T> {
    /// An array of `len` zeros.
    pub fn zeros(executor: &Executor, len: usize) -> DeviceVec<T> {
        match executor {
            Executor::Cpu(_) => DeviceVec { storage: Storage::Cpu(vec![T::zeroed(); len]) },
        }
    }

    /// An array holding `values`.
    pub fn upload(executor: &Executor, values: &[T]) -> DeviceVec<T> {
        match executor {
            Executor::Cpu(_) => DeviceVec { storage: Storage::Cpu(values.to_vec()) },
        }
    }

    /// Number of items.
    pub fn len(&self) -> usize {
        match &self.storage {
            Storage::Cpu(values) => values.len(),
        }
    }

    /// True if there are no items.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes of device memory.
    pub fn bytes(&self) -> u64 {
        (self.len() * size_of::<T>()) as u64
    }

    /// Copies items `start..start + out.len()` to the host; on a device this waits for all work submitted so far.
    pub fn read_range(&self, _executor: &Executor, start: usize, out: &mut [T]) {
        match &self.storage {
            Storage::Cpu(values) => out.copy_from_slice(&values[start..start + out.len()]),
        }
    }

    /// Copies everything to the host.
    pub fn read(&self, executor: &Executor) -> Vec<T> {
        let mut out = vec![T::zeroed(); self.len()];
        self.read_range(executor, 0, &mut out);
        out
    }

    /// Copies `values` to items `start..`; ordered with the kernels submitted before and after.
    pub fn write_range(&mut self, _executor: &Executor, start: usize, values: &[T]) {
        match &mut self.storage {
            Storage::Cpu(own) => own[start..start + values.len()].copy_from_slice(values),
        }
    }

    /// Sets every item to zero; ordered with the kernels submitted before and after.
    pub fn fill_zero(&mut self, _executor: &Executor) {
        match &mut self.storage {
            Storage::Cpu(own) => own.fill(T::zeroed()),
        }
    }

    /// The items, for CPU twins. Panics on a device array: a wrapper that gets here has matched on the wrong executor.
    pub fn as_slice(&self) -> &[T] {
        match &self.storage {
            Storage::Cpu(values) => values,
        }
    }

    /// The items, for CPU twins. Panics on a device array.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        match &mut self.storage {
            Storage::Cpu(values) => values,
        }
    }
}
