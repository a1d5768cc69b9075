//! Arrays that live where the executor's kernels can reach them.

use std::borrow::Cow;

use bytemuck::Pod;

use super::Executor;
use super::array::{Binding, GpuArray, LEAST_BYTES};
use super::commands::ReadPart;
use super::host_memory;

/// An array on an executor. Plain data only; the length changes only by [`DeviceVec::resize`]. Items are whole 32-bit words,
/// as devices copy nothing smaller. Empty arrays are allowed everywhere.
pub struct DeviceVec<T> {
    storage: Storage<T>,
}

enum Storage<T> {
    Cpu(Vec<T>),
    Gpu(GpuArray, usize),
}

impl<T: Pod> DeviceVec<T> {
    /// An array of `len` zeros.
    pub fn zeros(executor: &Executor, len: usize) -> DeviceVec<T> {
        const { assert!(size_of::<T>().is_multiple_of(4) && size_of::<T>() > 0, "items must be whole 32-bit words") };
        let storage = match executor {
            Executor::Cpu(_) => Storage::Cpu(host_memory::zeroed(len)),
            Executor::Gpu(gpu) => Storage::Gpu(gpu.allocate((len * size_of::<T>()) as u64), len),
        };
        DeviceVec { storage }
    }

    /// An array holding `values`.
    pub fn upload(executor: &Executor, values: &[T]) -> DeviceVec<T> {
        if let Executor::Cpu(_) = executor {
            return DeviceVec { storage: Storage::Cpu(host_memory::copied(values)) };
        }
        let mut made = DeviceVec::zeros(executor, values.len());
        made.write_range(executor, 0, values);
        made
    }

    /// Changes the number of items. The first ones are kept, further ones hold anything. Memory is made anew only for more
    /// items than ever before, then with an eighth to spare, so that an array that varies from step to step soon rests.
    pub fn resize(&mut self, executor: &Executor, len: usize) {
        let (kept, roomy) = (self.len().min(len), len + len / 8);
        match (&mut self.storage, executor) {
            (Storage::Cpu(values), Executor::Cpu(_)) => {
                if len > values.capacity() {
                    let mut larger = host_memory::zeroed(roomy);
                    larger[..kept].copy_from_slice(&values[..kept]);
                    *values = larger;
                }
                values.resize(len, T::zeroed());
            }
            (Storage::Gpu(array, own), Executor::Gpu(gpu)) => {
                let bytes = |items: usize| (items * size_of::<T>()) as u64;
                if bytes(len) > array.buffer.size() {
                    let larger = gpu.allocate(bytes(roomy));
                    if kept > 0 && larger.buffer.size() >= bytes(kept) {
                        gpu.commands().copy(&array.buffer, 0, &larger.buffer, 0, bytes(kept));
                    }
                    *array = larger;
                }
                *own = len;
            }
            _ => panic!("{WRONG_EXECUTOR}"),
        }
    }

    /// Becomes a copy of `values`, as [`DeviceVec::upload`] but in the memory that is already there.
    pub fn assign(&mut self, executor: &Executor, values: &[T]) {
        self.resize(executor, values.len());
        self.write_range(executor, 0, values);
    }

    /// Number of items in use.
    pub fn len(&self) -> usize {
        match &self.storage {
            Storage::Cpu(values) => values.len(),
            Storage::Gpu(_, len) => *len,
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

    /// Bytes of device memory, those kept for later growth included.
    pub fn held_bytes(&self) -> u64 {
        match &self.storage {
            Storage::Cpu(values) => (values.capacity() * size_of::<T>()) as u64,
            Storage::Gpu(array, _) => array.buffer.size(),
        }
    }

    /// Copies items `start..start + out.len()` to the host; on a device this waits for all work submitted so far. After a
    /// fault of the device ([`Executor::take_fault`]) the items are zeros.
    pub fn read_range(&self, executor: &Executor, start: usize, out: &mut [T]) {
        let mut batch = ReadBatch::new();
        batch.add(self, start, out);
        batch.finish(executor);
    }

    /// Copies everything to the host.
    pub fn read(&self, executor: &Executor) -> Vec<T> {
        let mut out = vec![T::zeroed(); self.len()];
        self.read_range(executor, 0, &mut out);
        out
    }

    /// Everything, for the host: in place on the native executor, copied from a device.
    pub fn host(&self, executor: &Executor) -> Cow<'_, [T]> {
        match &self.storage {
            Storage::Cpu(values) => Cow::Borrowed(values),
            Storage::Gpu(..) => Cow::Owned(self.read(executor)),
        }
    }

    /// Copies `values` to items `start..`; ordered with the kernels submitted before and after.
    pub fn write_range(&mut self, executor: &Executor, start: usize, values: &[T]) {
        self.assert_within(start, values.len());
        match (&mut self.storage, executor) {
            (Storage::Cpu(own), Executor::Cpu(_)) => own[start..start + values.len()].copy_from_slice(values),
            (Storage::Gpu(array, _), Executor::Gpu(gpu)) => {
                gpu.commands().write(&array.buffer, (start * size_of::<T>()) as u64, bytemuck::cast_slice(values));
            }
            _ => panic!("{WRONG_EXECUTOR}"),
        }
    }

    /// Copies `len` items of `source` from `source_start` on to items `start..` of this array, without the host.
    pub fn copy_range(
        &mut self,
        executor: &Executor,
        start: usize,
        source: &DeviceVec<T>,
        source_start: usize,
        len: usize,
    ) {
        self.assert_within(start, len);
        source.assert_within(source_start, len);
        let bytes = |items: usize| (items * size_of::<T>()) as u64;
        match (&mut self.storage, &source.storage, executor) {
            (Storage::Cpu(own), Storage::Cpu(other), Executor::Cpu(_)) => {
                own[start..start + len].copy_from_slice(&other[source_start..source_start + len]);
            }
            (Storage::Gpu(own, _), Storage::Gpu(other, _), Executor::Gpu(gpu)) => {
                gpu.commands().copy(&other.buffer, bytes(source_start), &own.buffer, bytes(start), bytes(len));
            }
            _ => panic!("{WRONG_EXECUTOR}"),
        }
    }

    /// Sets items `start..start + len` to zero.
    pub fn clear_range(&mut self, executor: &Executor, start: usize, len: usize) {
        self.assert_within(start, len);
        match (&mut self.storage, executor) {
            (Storage::Cpu(own), Executor::Cpu(_)) => own[start..start + len].fill(T::zeroed()),
            (Storage::Gpu(array, _), Executor::Gpu(gpu)) => {
                gpu.commands().clear(&array.buffer, (start * size_of::<T>()) as u64, (len * size_of::<T>()) as u64);
            }
            _ => panic!("{WRONG_EXECUTOR}"),
        }
    }

    /// Sets every item to zero; ordered with the kernels submitted before and after.
    pub fn fill_zero(&mut self, executor: &Executor) {
        self.clear_range(executor, 0, self.len());
    }

    /// The items, for CPU twins. Panics on a device array: a wrapper that gets here has matched on the wrong executor.
    pub fn as_slice(&self) -> &[T] {
        match &self.storage {
            Storage::Cpu(values) => values,
            Storage::Gpu(..) => panic!("{WRONG_EXECUTOR}"),
        }
    }

    /// The items, for CPU twins. Panics on a device array.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        match &mut self.storage {
            Storage::Cpu(values) => values,
            Storage::Gpu(..) => panic!("{WRONG_EXECUTOR}"),
        }
    }

    /// The whole array, for a kernel that reads it. Panics on a host array, as do the other bindings.
    pub fn binding(&self) -> Binding<'_> {
        self.window(0, self.len())
    }

    /// The whole array, for a kernel that writes it.
    pub fn binding_mut(&mut self) -> Binding<'_> {
        self.window_mut(0, self.len())
    }

    /// Items `start..start + len`, for a kernel that reads them; `start` is a multiple of
    /// [`super::WINDOW_STEP`]. An array larger than the adapter can bind is seen through several.
    pub fn window(&self, start: usize, len: usize) -> Binding<'_> {
        self.assert_within(start, len);
        let Storage::Gpu(array, _) = &self.storage else { panic!("{WRONG_EXECUTOR}") };
        let (offset, size) = ((start * size_of::<T>()) as u64, (len * size_of::<T>()) as u64);
        // An empty window shows the start of the array, which is never without memory.
        let (offset, size) = if size == 0 { (0, LEAST_BYTES) } else { (offset, size) };
        Binding { array, offset, size, writable: false }
    }

    /// As [`DeviceVec::window`], for a kernel that writes them.
    pub fn window_mut(&mut self, start: usize, len: usize) -> Binding<'_> {
        Binding { writable: true, ..self.window(start, len) }
    }

    fn assert_within(&self, start: usize, len: usize) {
        let end = start.checked_add(len).expect("range end overflows");
        assert!(end <= self.len(), "items {start}..{end} of an array of {}", self.len());
    }
}

const WRONG_EXECUTOR: &str = "the array lives on another executor";

/// Several reads with one wait.
#[derive(Default)]
pub struct ReadBatch<'a> {
    parts: Vec<ReadPart<'a>>,
}

impl<'a> ReadBatch<'a> {
    /// A batch without reads.
    pub fn new() -> ReadBatch<'a> {
        ReadBatch::default()
    }

    /// Adds items `start..start + out.len()` of `source`. What arrives is what [`ReadBatch::finish`] finds there.
    pub fn add<T: Pod>(&mut self, source: &'a DeviceVec<T>, start: usize, out: &'a mut [T]) {
        source.assert_within(start, out.len());
        match &source.storage {
            // Borrowed until the end, so nothing changes in between.
            Storage::Cpu(values) => out.copy_from_slice(&values[start..start + out.len()]),
            Storage::Gpu(array, _) => {
                let offset = (start * size_of::<T>()) as u64;
                self.parts.push(array.read_part(offset, bytemuck::cast_slice_mut(out)));
            }
        }
    }

    /// Waits for the device, once, and fills all outputs.
    pub fn finish(mut self, executor: &Executor) {
        match executor {
            Executor::Gpu(gpu) => gpu.commands().read(&mut self.parts),
            Executor::Cpu(_) => assert!(self.parts.is_empty(), "{WRONG_EXECUTOR}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::device;

    fn executors() -> impl Iterator<Item = Executor> {
        std::iter::once(Executor::cpu(2)).chain(device::executor())
    }

    #[test]
    fn what_is_written_is_read() {
        for executor in executors() {
            let mut a = DeviceVec::upload(&executor, &[1u32, 2, 3, 4, 5]);
            a.write_range(&executor, 3, &[40, 50]);
            let mut b = DeviceVec::<u32>::zeros(&executor, 7);
            b.copy_range(&executor, 1, &a, 2, 3);
            a.clear_range(&executor, 0, 2);
            // Writes after a copy do not show in it.
            a.write_range(&executor, 2, &[99]);
            assert_eq!(b.read(&executor), [0, 3, 40, 50, 0, 0, 0]);
            assert_eq!(a.read(&executor), [0, 0, 99, 40, 50]);
            assert_eq!((a.len(), a.bytes(), a.is_empty()), (5, 20, false));
            assert_eq!(executor.take_fault(), None);
        }
    }

    #[test]
    fn large_writes_keep_their_place_in_the_order() {
        for executor in executors() {
            // 12-byte items, more than one piece of a read and of a write.
            let items: Vec<[f32; 3]> = (0..3_000_001).map(|i| [i as f32, 0.5, -1.0]).collect();
            let mut a = DeviceVec::upload(&executor, &items[..items.len() / 2]);
            let mut b = DeviceVec::<[f32; 3]>::zeros(&executor, items.len());
            b.copy_range(&executor, 0, &a, 0, 10);
            a.write_range(&executor, 0, &items[5..100_000]);
            b.copy_range(&executor, 10, &a, 0, 10);
            b.write_range(&executor, 20, &items[20..]);
            let found = b.read(&executor);
            assert!(found[..10] == items[..10] && found[10..20] == items[5..15] && found[20..] == items[20..]);
        }
    }

    #[test]
    fn one_wait_fills_several_outputs() {
        for executor in executors() {
            let a = DeviceVec::upload(&executor, &[1.0f32, 2.0, 3.0]);
            let b = DeviceVec::upload(&executor, &[7u32, 8]);
            let (mut from_a, mut from_b, mut nothing) = ([0.0f32; 2], [0u32; 1], [0u32; 0]);
            let mut batch = ReadBatch::new();
            batch.add(&a, 1, &mut from_a);
            batch.add(&b, 0, &mut nothing);
            batch.add(&b, 1, &mut from_b);
            batch.finish(&executor);
            assert_eq!((from_a, from_b), ([2.0, 3.0], [8]));
        }
    }

    #[test]
    fn a_resized_array_keeps_its_first_items_and_its_memory() {
        for executor in executors() {
            let items: Vec<u32> = (0..1000).collect();
            let mut a = DeviceVec::upload(&executor, &items);
            a.resize(&executor, 3000);
            assert!(a.len() == 3000 && a.read(&executor)[..1000] == items);
            let held = a.held_bytes();
            a.resize(&executor, 10);
            a.assign(&executor, &[7; 3001]);
            assert_eq!((a.held_bytes(), a.read(&executor)), (held, vec![7; 3001]));
            a.assign(&executor, &[]);
            assert!(a.is_empty() && a.read(&executor).is_empty());
            assert_eq!(executor.take_fault(), None);
        }
    }

    #[test]
    fn empty_arrays_work() {
        for executor in executors() {
            let mut empty = DeviceVec::<u32>::upload(&executor, &[]);
            empty.write_range(&executor, 0, &[]);
            empty.clear_range(&executor, 0, 0);
            assert!(empty.is_empty() && empty.read(&executor).is_empty());
            assert_eq!(executor.take_fault(), None);
        }
    }

    #[test]
    #[should_panic(expected = "items 2..4 of an array of 3")]
    fn ranges_are_checked() {
        let executor = Executor::cpu(1);
        DeviceVec::<u32>::zeros(&executor, 3).read_range(&executor, 2, &mut [0, 0]);
    }
}
