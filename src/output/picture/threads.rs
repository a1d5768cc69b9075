//! The frames of a sequence over threads.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::error::PictureError;

/// Calls `f` with the place and the number of every frame on up to `threads` threads, in the order of their places; the
/// first error in that order wins.
pub(super) fn for_each(
    numbers: &[u32],
    threads: usize,
    f: impl Fn(usize, u32) -> Result<(), PictureError> + Sync,
) -> Result<(), PictureError> {
    let next = AtomicUsize::new(0);
    let failure: Mutex<Option<(usize, PictureError)>> = Mutex::new(None);
    std::thread::scope(|scope| {
        for _ in 0..threads.clamp(1, numbers.len().max(1)) {
            scope.spawn(|| {
                loop {
                    let at = next.fetch_add(1, Ordering::Relaxed);
                    let Some(frame) = numbers.get(at) else { break };
                    let Err(error) = f(at, *frame) else { continue };
                    next.store(numbers.len(), Ordering::Relaxed);
                    if let Ok(mut failure) = failure.lock()
                        && failure.as_ref().is_none_or(|(earlier, _)| at < *earlier)
                    {
                        *failure = Some((at, error));
                    }
                    break;
                }
            });
        }
    });
    match failure.into_inner() {
        Ok(Some((_, error))) => Err(error),
        _ => Ok(()),
    }
}
