//! The first fault of a device, kept until it is asked for.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The first fault, as half a sentence; later ones are ignored.
#[derive(Default)]
pub(super) struct Fault {
    raised: AtomicBool,
    text: Mutex<Option<String>>,
}

impl Fault {
    pub(super) fn raise(&self, text: String) {
        locked(&self.text).get_or_insert(text);
        self.raised.store(true, Ordering::Release);
    }

    /// True if anything went wrong so far.
    pub(super) fn raised(&self) -> bool {
        self.raised.load(Ordering::Acquire)
    }

    pub(super) fn text(&self) -> Option<String> {
        if self.raised() { locked(&self.text).clone() } else { None }
    }
}

/// Locks even after a panic elsewhere: what these locks guard is valid after every statement.
pub(super) fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
