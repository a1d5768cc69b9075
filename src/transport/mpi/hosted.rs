//! [`Transport`] of ranks on several hosts: one transport inside the own host, and messages of MPI to the ranks of the
//! others. Every message takes the way to its reader; a whole-cloth all-gather crosses to every other host once.
//!
//! All ranks of a host make the same calls on the inner transport, because all ranks make the same calls here.

use std::sync::Arc;

use super::data::MpiTransport;
use crate::transport::pattern::Pending;
use crate::transport::{ALL_GATHER_MAX, Counts, Message, Neighbor, Pattern, Rows, Transport, TransportError};

/// Splits of patterns that are kept: a step uses a handful of patterns again and again.
const SPLITS_KEPT: usize = 16;

/// Who is on which host, as one rank sees it.
pub(super) struct Hosting {
    /// By host: its ranks, ascending. Hosts are in the order of their lowest ranks.
    hosts: Vec<Vec<usize>>,
    /// Own host.
    own: usize,
    /// By rank: host, and place among the ranks of that host.
    places: Vec<(usize, usize)>,
}

impl Hosting {
    /// `hosts`: by rank, a number of its host.
    pub(super) fn new(rank: usize, hosts: &[usize]) -> Hosting {
        let mut numbers: Vec<usize> = Vec::new();
        let mut of_host: Vec<Vec<usize>> = Vec::new();
        let places = hosts.iter().enumerate().map(|(rank, host)| {
            let at = numbers.iter().position(|number| number == host).unwrap_or_else(|| {
                numbers.push(*host);
                of_host.push(Vec::new());
                numbers.len() - 1
            });
            of_host[at].push(rank);
            (at, of_host[at].len() - 1)
        });
        let places: Vec<(usize, usize)> = places.collect();
        Hosting { hosts: of_host, own: places[rank].0, places }
    }

    /// Ranks of the own host.
    pub(super) fn locals(&self) -> &[usize] {
        &self.hosts[self.own]
    }

    /// Number of hosts.
    pub(super) fn count(&self) -> usize {
        self.hosts.len()
    }

    /// Place of a rank inside the own host, if it is there.
    fn inside(&self, rank: usize) -> Option<usize> {
        let (host, place) = self.places[rank];
        (host == self.own).then_some(place)
    }

    /// The rank of host `host` that takes what `rank`, of another host, has for all of them.
    fn taker(&self, rank: usize, host: usize) -> usize {
        let ranks = &self.hosts[host];
        ranks[self.places[rank].1 % ranks.len()]
    }

    /// Ranks of other hosts whose messages for the own host the rank at `place` of it takes, ascending.
    fn taken_by(&self, place: usize) -> impl Iterator<Item = usize> {
        let taker = self.locals()[place];
        let others = (0..self.places.len()).filter(|&rank| self.places[rank].0 != self.own);
        others.filter(move |&rank| self.taker(rank, self.own) == taker)
    }
}

/// A pattern cut in two.
struct Split {
    pattern: Pattern,
    inside: Pattern,
    outside: Pattern,
}

/// One rank of a group whose ranks are on several hosts.
pub(super) struct HostedTransport {
    rank: usize,
    hosting: Hosting,
    inside: Box<dyn Transport>,
    outside: MpiTransport,
    /// What is to be received, as the ranks of all hosts number it.
    pending: Pending,
    splits: Vec<Arc<Split>>,
    message: Vec<f32>,
    gathered: Vec<Vec<f64>>,
    counts: Counts,
}

impl HostedTransport {
    /// `inside` joins the ranks of the own host, in ascending order, `outside` all ranks.
    pub(super) fn new(hosting: Hosting, inside: Box<dyn Transport>, outside: MpiTransport) -> HostedTransport {
        let (rank, counts) = (outside.rank(), Counts::default());
        let pending = Pending::new(rank, outside.ranks());
        let (splits, message, gathered) = (Vec::new(), Vec::new(), Vec::new());
        HostedTransport { rank, hosting, inside, outside, pending, splits, message, gathered, counts }
    }

    /// The parts of `pattern` inside the own host, by places in it, and outside.
    fn split(&mut self, pattern: &Pattern) -> Arc<Split> {
        if let Some(at) = self.splits.iter().position(|split| split.pattern.is_like(pattern)) {
            let split = self.splits.remove(at);
            self.splits.push(split.clone());
            return split;
        }
        let part = |neighbors: &[Neighbor], is_inside: bool| {
            let of_part =
                neighbors.iter().filter_map(|neighbor| match (self.hosting.inside(neighbor.rank), is_inside) {
                    (Some(place), true) => Some(Neighbor { rank: place, ..neighbor.clone() }),
                    (None, false) => Some(neighbor.clone()),
                    _ => None,
                });
            of_part.collect::<Vec<_>>()
        };
        let cut = |is_inside| {
            let (readers, sources) = (part(pattern.readers(), is_inside), part(pattern.sources(), is_inside));
            Pattern::new(pattern.message_rows(), readers, sources).with_tail_of(pattern)
        };
        let split = Arc::new(Split { pattern: pattern.clone(), inside: cut(true), outside: cut(false) });
        if self.splits.len() == SPLITS_KEPT {
            self.splits.remove(0);
        }
        self.splits.push(split.clone());
        split
    }

    /// Tells the ranks of this host the values in `out` of the ranks `taken`, and gets theirs.
    fn pass_on(
        &mut self,
        taken: &[usize],
        locals: &[usize],
        gathered: &mut Vec<Vec<f64>>,
        out: &mut [Vec<f64>],
    ) -> Result<(), TransportError> {
        // Each list after its length; before the first part, the length of all of them.
        let mut packed = Vec::new();
        for &source in taken {
            packed.push(out[source].len() as f64);
            packed.extend_from_slice(&out[source]);
        }
        let mut first = vec![packed.len() as f64];
        let begun = packed.len().min(ALL_GATHER_MAX - 1);
        first.extend_from_slice(&packed[..begun]);
        self.inside.all_gather(&first, gathered).map_err(|error| self.named(error))?;
        let lengths: Vec<usize> = gathered.iter().map(|values| values.first().map_or(0, |&n| n as usize)).collect();
        let mut lists: Vec<Vec<f64>> = gathered.iter().map(|values| values[1.min(values.len())..].to_vec()).collect();
        let rounds = lengths.iter().map(|&n| n.saturating_sub(ALL_GATHER_MAX - 1).div_ceil(ALL_GATHER_MAX)).max();
        for round in 0..rounds.unwrap_or(0) {
            let from = (begun + round * ALL_GATHER_MAX).min(packed.len());
            let part = &packed[from..(from + ALL_GATHER_MAX).min(packed.len())];
            self.inside.all_gather(part, gathered).map_err(|error| self.named(error))?;
            lists.iter_mut().zip(gathered.iter()).for_each(|(list, values)| list.extend_from_slice(values));
        }
        for (place, list) in lists.iter().enumerate().filter(|(place, _)| locals[*place] != self.rank) {
            let mut rest = &list[..];
            for source in self.hosting.taken_by(place) {
                let (Some(&length), values) = (rest.first(), rest.get(1..).unwrap_or_default()) else { break };
                let (values, after) = values.split_at((length as usize).min(values.len()));
                out[source].clear();
                out[source].extend_from_slice(values);
                rest = after;
            }
        }
        Ok(())
    }

    /// An error of the inner transport, which numbers the ranks of this host.
    fn named(&self, error: TransportError) -> TransportError {
        let of_place = |place: usize| self.hosting.locals().get(place).copied().unwrap_or(place);
        let rank = self.rank;
        match error {
            TransportError::TimedOut { source_rank, what, waited_s, .. } => {
                TransportError::TimedOut { rank, source_rank: of_place(source_rank), what, waited_s }
            }
            TransportError::Aborted { source_rank, what, .. } => {
                TransportError::Aborted { rank, source_rank: of_place(source_rank), what }
            }
            TransportError::OutOfOrder { source_rank, expected, got, .. } => {
                TransportError::OutOfOrder { rank, source_rank: of_place(source_rank), expected, got }
            }
            TransportError::Mechanism { message, .. } => TransportError::Mechanism { rank, message },
        }
    }
}

impl Transport for HostedTransport {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.outside.ranks()
    }

    fn start(
        &mut self,
        pattern: &Pattern,
        width: usize,
        fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError> {
        self.pending.start(pattern, width)?;
        let split = self.split(pattern);
        let readers = [&split.inside, &split.outside].map(|part| !part.readers().is_empty());
        if readers == [true, true] {
            self.message.resize(pattern.message_values(width), 0.0);
            fill(&mut self.message);
            let message = &self.message;
            self.outside.start(&split.outside, width, &mut |out| out.copy_from_slice(message))?;
            let started = self.inside.start(&split.inside, width, &mut |out| out.copy_from_slice(message));
            started.map_err(|error| self.named(error))?;
        } else {
            // A part without readers does not ask for the message.
            self.outside.start(&split.outside, width, fill)?;
            self.inside.start(&split.inside, width, fill).map_err(|error| self.named(error))?;
        }
        if !pattern.readers().is_empty() {
            self.counts.publish(pattern, width);
        }
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        if self.pending.next(source).is_none() {
            return false;
        }
        match self.hosting.inside(source) {
            Some(place) => self.inside.ready(place),
            None => self.outside.ready(source),
        }
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        self.pending.expect(source)?;
        match self.hosting.inside(source) {
            Some(place) => self.inside.wait(place).map_err(|error| self.named(error)),
            None => self.outside.wait(source),
        }
    }

    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        self.pending.take(source)?;
        let mut counts = self.counts;
        let mut read = |message: &Message<'_>| {
            counts.receive(message);
            read(message);
        };
        match self.hosting.inside(source) {
            Some(place) => self.inside.finish(place, &mut read).map_err(|error| self.named(error))?,
            None => self.outside.finish(source, &mut read)?,
        }
        self.counts = counts;
        Ok(())
    }

    /// Every message crosses to each other host once, to one of its ranks, which passes it on inside. So a host of L
    /// ranks takes each message of the others once and not L times.
    fn share(
        &mut self,
        lengths: &[usize],
        own: &[f32],
        read: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<(), TransportError> {
        let (rank, ranks) = (self.rank, self.ranks());
        if lengths.len() != ranks || lengths[rank] != own.len() {
            let message = format!("{} values of rank {rank} to share where {lengths:?} were announced", own.len());
            return Err(TransportError::Mechanism { rank, message });
        }
        let neighbor = |other: usize, rows: usize| Neighbor { rank: other, message_rows: rows, rows: Rows::All };
        let others = (0..self.hosting.count()).filter(|&host| host != self.hosting.own);
        let takers = others.map(|host| neighbor(self.hosting.taker(rank, host), own.len())).collect();
        let own_place = self.hosting.places[rank].1;
        let taken: Vec<usize> = self.hosting.taken_by(own_place).filter(|&source| lengths[source] > 0).collect();
        let sources = taken.iter().map(|&source| neighbor(source, lengths[source])).collect();
        let across = Pattern::new(own.len(), takers, sources);
        self.outside.start(&across, 1, &mut |out| out.copy_from_slice(own))?;

        let locals = self.hosting.locals().to_vec();
        let inner: Vec<usize> = locals.iter().map(|&local| lengths[local]).collect();
        let shared = self.inside.share(&inner, own, &mut |place, values| read(locals[place], values));
        shared.map_err(|error| self.named(error))?;

        // In round k every rank of the host passes on the k-th message that it has taken.
        let all_taken: Vec<Vec<usize>> = (0..locals.len())
            .map(|place| self.hosting.taken_by(place).filter(|&source| lengths[source] > 0).collect())
            .collect();
        let rounds = all_taken.iter().map(Vec::len).max().unwrap_or(0);
        for round in 0..rounds {
            let mut message = std::mem::take(&mut self.message);
            message.clear();
            if let Some(&source) = taken.get(round) {
                self.outside.finish(source, &mut |values| message.extend_from_slice(values.values()))?;
            }
            let source_of = |place: usize| all_taken[place].get(round).copied();
            let inner: Vec<usize> =
                (0..locals.len()).map(|place| source_of(place).map_or(0, |source| lengths[source])).collect();
            let passed = self.inside.share(&inner, &message, &mut |place, values| {
                if let Some(source) = source_of(place) {
                    read(source, values);
                }
            });
            self.message = message;
            passed.map_err(|error| self.named(error))?;
        }
        let received = (0..ranks).filter(|&source| source != rank && lengths[source] > 0);
        for source in received {
            self.counts.received += 1;
            self.counts.bytes_received += (lengths[source] * size_of::<f32>()) as u64;
        }
        if !own.is_empty() && ranks > 1 {
            self.counts.publish(&Pattern::whole(rank, lengths), 1);
        }
        Ok(())
    }

    /// One message from every rank to one rank of every other host, at the same time as the all-gather inside; then
    /// all-gathers inside of what has come, one unless it is long.
    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        let rank = self.rank;
        out.resize_with(self.ranks(), Vec::new);
        let others = (0..self.hosting.count()).filter(|&host| host != self.hosting.own);
        let to: Vec<usize> = others.map(|host| self.hosting.taker(rank, host)).collect();
        let from: Vec<usize> = self.hosting.taken_by(self.hosting.places[rank].1).collect();
        let begun = self.outside.begin_gather(own, &to, &from)?;
        let mut gathered = std::mem::take(&mut self.gathered);
        self.inside.all_gather(own, &mut gathered).map_err(|error| self.named(error))?;
        let locals = self.hosting.locals().to_vec();
        for (values, &local) in gathered.iter().zip(&locals) {
            out[local].clone_from(values);
        }
        self.outside.end_gather(begun, out)?;
        if locals.len() > 1 {
            self.pass_on(&from, &locals, &mut gathered, out)?;
        }
        self.gathered = gathered;
        Ok(())
    }

    fn alive(&mut self) -> Result<(), TransportError> {
        self.outside.alive()
    }

    fn max_message_values(&self) -> usize {
        self.outside.max_message_values()
    }

    fn counts(&self) -> Counts {
        self.counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_message_crosses_to_a_host_once() {
        // Hosts of three, two and one ranks, placed in turn.
        let hosts = [7, 3, 7, 3, 5, 7];
        for rank in 0..hosts.len() {
            let hosting = Hosting::new(rank, &hosts);
            assert_eq!(hosting.count(), 3);
            let others = (0..hosts.len()).filter(|&other| hosts[other] != hosts[rank]);
            for other in others {
                let takers = (0..hosting.locals().len())
                    .filter(|&place| hosting.taken_by(place).any(|taken| taken == other))
                    .map(|place| hosting.locals()[place]);
                let takers: Vec<usize> = takers.collect();
                let seen_from_there = Hosting::new(other, &hosts).taker(other, hosting.own);
                assert_eq!(takers, [seen_from_there], "what rank {other} sends to the host of rank {rank}");
            }
        }
        assert_eq!(Hosting::new(2, &hosts).locals(), [0, 2, 5]);
        assert_eq!((Hosting::new(2, &hosts).inside(5), Hosting::new(2, &hosts).inside(1)), (Some(2), None));
    }
}
