//! Who does which part of a query: ranks alone, each doing by itself what all need, or together, each doing a part of that
//! and telling the others. Both find the same.

use std::ops::Range;

use bytemuck::Pod;

use crate::transport::{Transport, TransportError, share_lists};

/// One rank among others.
pub struct Split<'a> {
    rank: usize,
    ranks: usize,
    transport: Option<&'a mut dyn Transport>,
}

impl<'a> Split<'a> {
    /// A rank that hears nothing of the others, which may not even run.
    pub fn alone(rank: usize, ranks: usize) -> Split<'a> {
        Split { rank, ranks, transport: None }
    }

    /// All ranks at once: a query is then part of the collective program.
    pub fn together(transport: &'a mut dyn Transport) -> Split<'a> {
        let (rank, ranks) = (transport.rank(), transport.ranks());
        Split { rank, ranks, transport: Some(transport).filter(|_| ranks > 1) }
    }

    /// The rank and their number.
    pub fn place(&self) -> (usize, usize) {
        (self.rank, self.ranks)
    }

    /// Those of `items` that this rank has to do before [`Split::share`] with [`even`] ranges.
    pub(super) fn part(&self, items: usize) -> Range<usize> {
        if self.transport.is_some() { even(self.rank, self.ranks, items) } else { 0..items }
    }

    /// True if other ranks do their part of what all need.
    pub(super) fn is_together(&self) -> bool {
        self.transport.is_some()
    }

    /// Completes a list of which every rank has made the range `of(rank)`. Items are whole 32-bit words. Moves every range
    /// once to every other rank.
    pub(super) fn share<T: Pod>(
        &mut self,
        all: &mut [T],
        of: impl Fn(usize) -> Range<usize>,
    ) -> Result<(), TransportError> {
        let Some(transport) = &mut self.transport else { return Ok(()) };
        let own = all[of(self.rank)].to_vec();
        let mut next: Vec<usize> = (0..self.ranks).map(|rank| of(rank).start).collect();
        share_lists(*transport, &own, &mut |source, part: &[T]| {
            all[next[source]..next[source] + part.len()].copy_from_slice(part);
            next[source] += part.len();
        })?;
        Ok(())
    }
}

/// An even share of `items`.
pub(super) fn even(rank: usize, ranks: usize, items: usize) -> Range<usize> {
    items * rank / ranks..items * (rank + 1) / ranks
}
