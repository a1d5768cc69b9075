//! How ranks share a query. Alone, a rank computes everything that its share of the tests needs. Together, each rank
//! computes a part of it and sends that to the others. Both find the same pairs.

use std::ops::Range;

use bytemuck::Pod;

use crate::transport::{Transport, TransportError, share_lists, share_ranges};

/// One rank among others.
pub struct Split<'a> {
    rank: usize,
    ranks: usize,
    transport: Option<&'a mut dyn Transport>,
}

impl<'a> Split<'a> {
    /// A rank that exchanges nothing with the others; they need not run.
    pub fn alone(rank: usize, ranks: usize) -> Split<'a> {
        Split { rank, ranks, transport: None }
    }

    /// All ranks at once: a query is then part of the collective program.
    pub fn together(transport: &'a mut dyn Transport) -> Split<'a> {
        let (rank, ranks) = (transport.rank(), transport.ranks());
        Split { rank, ranks, transport: Some(transport).filter(|_| ranks > 1) }
    }

    /// The rank and the number of ranks.
    pub fn place(&self) -> (usize, usize) {
        (self.rank, self.ranks)
    }

    /// Those of `items` that this rank has to do before [`Split::share`] with [`even`] ranges.
    pub(super) fn part(&self, items: usize) -> Range<usize> {
        if self.transport.is_some() { even(self.rank, self.ranks, items) } else { 0..items }
    }

    /// As [`Split::part`] for items of uneven cost: every n-th item, so that ranks take turns.
    pub(super) fn every(&self, items: usize) -> impl Iterator<Item = usize> + use<> {
        let (first, stride) = if self.transport.is_some() { (self.rank, self.ranks) } else { (0, 1) };
        (first..items).step_by(stride)
    }

    /// The lists of all ranks that do their part, one after the other.
    pub(super) fn gather<T: Pod>(&mut self, own: Vec<T>) -> Result<Vec<T>, TransportError> {
        let Some(transport) = &mut self.transport else { return Ok(own) };
        let mut all = Vec::with_capacity(own.len() * self.ranks);
        share_lists(*transport, &own, &mut |_, part: &[T]| all.extend_from_slice(part))?;
        Ok(all)
    }

    /// True if the ranks share the work.
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
        share_ranges(*transport, all, of)
    }
}

/// An even share of `items`.
pub(super) fn even(rank: usize, ranks: usize, items: usize) -> Range<usize> {
    items * rank / ranks..items * (rank + 1) / ranks
}
