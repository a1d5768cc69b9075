//! What a step needs from the interconnect: exchanges along patterns, shares, all-gathers. Not who the ranks are or how they
//! are started.
//!
//! **Nobody waits in a circle.** Exchanges are numbered, and a rank that starts exchange m has finished all up to m - 2
//! (`Pending` of `pattern.rs` refuses anything else). Take the rank that is least far in the common sequence of calls. It
//! waits for one of three things: a message, which its source hands over in a call that stands earlier in the sequence; a
//! contribution to an all-gather, likewise; or room for its own message of exchange m, that is, for the readers of its message
//! before the last. That one belongs to exchange m - 2 or an earlier one, so its readers finish it before they start exchange
//! m, which again stands earlier. No other rank waits in these calls, because all are further. So the rank goes on.

use super::{Counts, Message, Pattern, TransportError};

/// One rank's connection to all others.
///
/// An exchange is started along a [`Pattern`] and finished source by source, in any order, with other work in between:
/// `start(pattern) .. finish(source) .. finish(another source)`. All ranks start the same exchanges in the same order, each
/// with its own part of the same pattern. Before a rank starts an exchange it must have finished the one before the last.
pub trait Transport {
    /// Own rank.
    fn rank(&self) -> usize;
    /// Number of ranks.
    fn ranks(&self) -> usize;
    /// Starts an exchange: hands the own message, `width` values per row, to its readers, if it has any. `fill` then writes
    /// the message in place (the buffer holds unspecified values). Returns as soon as the message is handed over; waits only
    /// for readers of the own message before the last.
    fn start(
        &mut self,
        pattern: &Pattern,
        width: usize,
        fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError>;
    /// True if the next message of `source` that this rank reads can be received without waiting.
    fn ready(&mut self, source: usize) -> bool;
    /// Waits until [`Transport::ready`]; lets a trace tell waiting from reading.
    fn wait(&mut self, source: usize) -> Result<(), TransportError>;
    /// Waits for the message of `source` in the oldest exchange that has not been finished with it, and shows it to `read` in
    /// place. An error if no pattern of an exchange under way names this source.
    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError>;
    /// Shows the values of every rank to every rank: first the own ones, as soon as they are handed over, then those of the
    /// others that have any, in any order. `lengths[r]`: number of values of rank r, at most
    /// [`Transport::max_message_values`]. An exchange along [`Pattern::whole`] unless a mechanism has something better.
    fn share(
        &mut self,
        lengths: &[usize],
        own: &[f32],
        read: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<(), TransportError> {
        let (rank, ranks) = (self.rank(), self.ranks());
        if lengths.len() != ranks || lengths[rank] != own.len() {
            let message = format!("{} values of rank {rank} to share where {lengths:?} were announced", own.len());
            return Err(TransportError::Mechanism { rank, message });
        }
        self.start(&Pattern::whole(rank, lengths), 1, &mut |out| out.copy_from_slice(own))?;
        read(rank, own);
        // In another order on every rank, so that not all read the same message at once.
        for source in (1..ranks).map(|step| (rank + step) % ranks).filter(|&source| lengths[source] > 0) {
            self.finish(source, &mut |message| read(source, message.values()))?;
        }
        Ok(())
    }
    /// Gathers up to [`ALL_GATHER_MAX`] values of every rank: `out[r]` = what rank r contributed (the own rank too).
    /// One latency; this is what an all-reduce is built on (`solver::reduction` adds in a fixed order).
    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError>;
    /// A sign of life between two calls that may wait, for long stretches of work: gives the run's hook its turn.
    fn alive(&mut self) -> Result<(), TransportError> {
        Ok(())
    }
    /// Returns after every rank has called it.
    fn barrier(&mut self) -> Result<(), TransportError> {
        let mut out = Vec::new();
        self.all_gather(&[], &mut out)
    }
    /// Most values that a message may hold.
    fn max_message_values(&self) -> usize;
    /// What exchanges have moved so far.
    fn counts(&self) -> Counts;
}
