//! Waiting for a thread of the simulation without the lock of the interpreter, in short naps, so that Ctrl-C and the
//! callbacks of the caller get their turn.

use std::sync::Mutex;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use pyo3::prelude::*;

/// Longest time until Ctrl-C is noticed.
const NAP: Duration = Duration::from_millis(50);

/// What a nap brought.
pub(crate) enum News<T> {
    /// A message.
    Message(T),
    /// Nothing yet.
    Nothing,
    /// The other side has ended.
    End,
}

/// Waits for a message for a short time, while other Python threads run.
pub(crate) fn nap<T: Send>(py: Python<'_>, from: &Mutex<Receiver<T>>) -> News<T> {
    py.detach(|| {
        let from = from.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        match from.recv_timeout(NAP) {
            Ok(message) => News::Message(message),
            Err(RecvTimeoutError::Timeout) => News::Nothing,
            Err(RecvTimeoutError::Disconnected) => News::End,
        }
    })
}
