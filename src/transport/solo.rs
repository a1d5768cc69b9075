//! The transport of a run with one rank. It only calls the run's hook.

use std::time::Duration;

use super::wait::{Patience, Stopped, WaitHook};
use super::{ALL_GATHER_MAX, Counts, Message, Pattern, Transport, TransportError};

/// Rank 0 of 1.
pub struct SoloTransport {
    patience: Patience,
}

impl SoloTransport {
    /// `on_wait`: see [`WaitHook`].
    pub fn new(on_wait: WaitHook) -> SoloTransport {
        SoloTransport { patience: Patience::new(Duration::MAX, 1, on_wait) }
    }

    fn nobody<T>(&self) -> Result<T, TransportError> {
        Err(TransportError::Mechanism { rank: 0, message: "there is only one rank".into() })
    }
}

impl Transport for SoloTransport {
    fn rank(&self) -> usize {
        0
    }

    fn ranks(&self) -> usize {
        1
    }

    fn start(
        &mut self,
        pattern: &Pattern,
        _width: usize,
        _fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError> {
        if pattern.readers().is_empty() && pattern.sources().is_empty() { Ok(()) } else { self.nobody() }
    }

    fn ready(&mut self, _source: usize) -> bool {
        false
    }

    fn wait(&mut self, _source: usize) -> Result<(), TransportError> {
        self.nobody()
    }

    fn finish(&mut self, _source: usize, _read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        self.nobody()
    }

    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        if own.len() > ALL_GATHER_MAX {
            return Err(TransportError::Mechanism {
                rank: 0,
                message: format!("all-gather of {} values, at most {ALL_GATHER_MAX}", own.len()),
            });
        }
        out.resize_with(1, Vec::new);
        out[0].clear();
        out[0].extend_from_slice(own);
        Ok(())
    }

    fn alive(&mut self) -> Result<(), TransportError> {
        match self.patience.call_hook_if_due() {
            Err(Stopped::Aborted) => Err(TransportError::Aborted { rank: 0, source_rank: 0, what: "its own work" }),
            _ => Ok(()),
        }
    }

    fn max_message_values(&self) -> usize {
        usize::MAX
    }

    fn counts(&self) -> Counts {
        Counts::default()
    }
}
