//! Arrays of the native executor. Large ones ask the system for huge pages before they are first touched: matrix tables are
//! streamed every iteration, and 4 KiB pages cost them about a tenth of the read bandwidth. A hint only: where the system
//! does not give huge pages, everything works as with small ones.

use bytemuck::Pod;

/// Arrays below this gain nothing, bytes.
const LARGE: usize = 8 << 20;
/// Size of a huge page on the systems that take the hint, bytes.
const HUGE_PAGE: usize = 2 << 20;

/// A vector of `len` zeros.
pub(super) fn zeroed<T: Pod>(len: usize) -> Vec<T> {
    // Fresh zeros come untouched from the system, so the hint is in time.
    let mut values: Vec<T> = bytemuck::zeroed_vec(len);
    advise(values.as_mut_ptr().cast(), len * size_of::<T>());
    values
}

/// A copy of `source`.
pub(super) fn copied<T: Pod>(source: &[T]) -> Vec<T> {
    let mut values: Vec<T> = Vec::with_capacity(source.len());
    advise(values.as_mut_ptr().cast(), size_of_val(source));
    values.extend_from_slice(source);
    values
}

/// Asks for huge pages for the whole pages among `bytes` bytes at `start`.
fn advise(start: *mut u8, bytes: usize) {
    if bytes < LARGE {
        return;
    }
    let skip = start.align_offset(HUGE_PAGE);
    let whole = bytes.saturating_sub(skip) / HUGE_PAGE * HUGE_PAGE;
    #[cfg(target_os = "linux")]
    if whole > 0 {
        // SAFETY: the range lies within one live allocation, and the hint changes how it is backed, never what it holds.
        let _ = unsafe { rustix::mm::madvise(start.add(skip).cast(), whole, rustix::mm::Advice::LinuxHugepage) };
    }
    #[cfg(not(target_os = "linux"))]
    let _ = whole;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_arrays_hold_what_they_should() {
        let source: Vec<u32> = (0..5_000_000).collect();
        assert_eq!(copied(&source), source);
        assert!(zeroed::<f32>(5_000_000).iter().all(|&v| v == 0.0));
        assert_eq!(zeroed::<f32>(0).len(), 0);
    }
}
