//! Communication of a step: exchanges along patterns, exchanges with all ranks, all-gathers. The identity and the start
//! of the ranks lie in other modules.
//!
//! **Deadlock freedom.** Exchanges are numbered, and a rank that starts exchange m has finished all up to m - 2
//! (`Pending` of `pattern.rs` refuses anything else). Take the rank that has advanced least in the common sequence of
//! calls. It waits for one of three things: a message, which its source publishes in an earlier call of the sequence; a
//! contribution to an all-gather, likewise; or room for its own message of exchange m, that is, for the readers of its
//! message before the last. That message belongs to exchange m - 2 or an earlier one. Its readers finish it before they
//! start exchange m, which again is earlier in the sequence. All other ranks have advanced further, so none of them
//! waits in these earlier calls. So the rank continues.

use super::{Counts, Message, Pattern, TransportError};

/// One rank's connection to all others.
///
/// An exchange is started along a [`Pattern`] and finished source by source, in any order, with other work in between:
/// `start(pattern) .. finish(source) .. finish(another source)`. All ranks start the same exchanges in the same order,
/// each with its own part of the same pattern. Before a rank starts an exchange it must have finished the one before
/// the last.
pub trait Transport {
    /// Own rank.
    fn rank(&self) -> usize;
    /// Number of ranks.
    fn ranks(&self) -> usize;
    /// Starts an exchange: publishes the own message, `width` values per row, if it has readers. `fill` writes the
    /// message in place (the buffer holds unspecified values). Returns as soon as the message is published; waits only
    /// for readers of the own message before the last.
    fn start(
        &mut self,
        pattern: &Pattern,
        width: usize,
        fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError>;
    /// True if the next message of `source` for this rank can be received without waiting.
    fn ready(&mut self, source: usize) -> bool;
    /// Waits until [`Transport::ready`], so that a trace can separate waiting from reading.
    fn wait(&mut self, source: usize) -> Result<(), TransportError>;
    /// Waits for the message of `source` in the oldest exchange that has not been finished with it, and passes it to
    /// `read` in place. It is an error if no pattern of a started exchange names this source.
    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError>;
    /// Passes the values of every rank to every rank: first the own ones, as soon as they are published, then those of
    /// the others that have any, in any order. `lengths[r]`: number of values of rank r, at most
    /// [`Transport::max_message_values`]. The default is an exchange along [`Pattern::whole`]; an implementation may
    /// replace it.
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
        // Each rank has another order, so that not all read the same message at once.
        for source in (1..ranks).map(|step| (rank + step) % ranks).filter(|&source| lengths[source] > 0) {
            self.finish(source, &mut |message| read(source, message.values()))?;
        }
        Ok(())
    }
    /// Gathers up to `ALL_GATHER_MAX` values of every rank: `out[r]` = contribution of rank r (also the own rank). It
    /// takes one latency. An all-reduce is built on it (`solver::reduction` adds in a fixed order).
    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError>;
    /// Calls the run's hook if it is due. Long computations between two waiting calls use it as a sign of life.
    fn alive(&mut self) -> Result<(), TransportError> {
        Ok(())
    }
    /// Returns after every rank has called it.
    fn barrier(&mut self) -> Result<(), TransportError> {
        let mut out = Vec::new();
        self.all_gather(&[], &mut out)
    }
    /// Maximum number of values of a message.
    fn max_message_values(&self) -> usize;
    /// Total traffic of the exchanges so far.
    fn counts(&self) -> Counts;
}
