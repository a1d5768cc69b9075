//! The transport of a run with one rank: there is nobody to talk to, only the run's hook to call.

use std::time::Duration;

use super::wait::{Patience, Stopped, WaitHook};
use super::{ALL_GATHER_MAX, Transport, TransportError};

/// Rank 0 of 1.
pub struct SoloTransport {
    patience: Patience,
    bytes_published: u64,
}

impl SoloTransport {
    /// `on_wait`: see [`WaitHook`].
    pub fn new(on_wait: WaitHook) -> SoloTransport {
        SoloTransport { patience: Patience::new(Duration::MAX, 1, on_wait), bytes_published: 0 }
    }

    fn nobody(&self, source: usize) -> TransportError {
        TransportError::Mechanism { rank: 0, message: format!("cannot receive from rank {source} of 1 rank") }
    }
}

impl Transport for SoloTransport {
    fn rank(&self) -> usize {
        0
    }

    fn ranks(&self) -> usize {
        1
    }

    fn publish(&mut self, len: usize, fill: &mut dyn FnMut(&mut [f32])) -> Result<(), TransportError> {
        fill(&mut vec![0.0; len]);
        self.bytes_published += (len * size_of::<f32>()) as u64;
        Ok(())
    }

    fn receive(&mut self, source: usize, _read: &mut dyn FnMut(&[f32])) -> Result<(), TransportError> {
        Err(self.nobody(source))
    }

    fn ready(&mut self, _source: usize) -> bool {
        false
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        Err(self.nobody(source))
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
        match self.patience.breathe() {
            Err(Stopped::Aborted) => Err(TransportError::Aborted { rank: 0, source_rank: 0, what: "its own work" }),
            _ => Ok(()),
        }
    }

    fn max_message_values(&self) -> usize {
        usize::MAX
    }

    fn bytes_published(&self) -> u64 {
        self.bytes_published
    }

    fn bytes_received(&self) -> u64 {
        0
    }
}
