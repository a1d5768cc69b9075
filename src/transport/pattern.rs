//! Pattern of an exchange: which rank reads which rows of which message. It is built once per plan and used for every
//! exchange along it. This module transfers no data.
//!
//! All ranks build their patterns from the same knowledge, so they agree: rank a names b as a reader exactly if b names
//! a as a source, with the same rows. A rank names only ranks that read at least one row. A rank that does not read a
//! message neither waits for it nor receives it.

use std::collections::VecDeque;
use std::sync::Arc;

use super::TransportError;

/// Number of unfinished exchanges at a time: a rank that starts exchange m has finished all up to m - `DEPTH`. A
/// publisher therefore has at most this many messages that still have readers.
pub(super) const DEPTH: usize = 2;

/// Buffers of a publisher in shared memory: those that readers hold or still have to read, and the one being written.
pub(super) const BUFFERS: usize = DEPTH + 1;

/// Rows of a message that one rank reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Rows {
    /// Every row, in the order of the message.
    All,
    /// The rows at these positions of the message, in the order in which the reader counts them.
    At(Vec<u32>),
}

/// The other end of a message: a rank that reads rows of the own message, or the source of a message that the own rank
/// reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Neighbor {
    /// The other rank.
    pub rank: usize,
    /// Rows of the whole message.
    pub message_rows: usize,
    /// The rows that are read.
    pub rows: Rows,
}

impl Neighbor {
    /// Number of rows that are read.
    pub fn rows_read(&self) -> usize {
        match &self.rows {
            Rows::All => self.message_rows,
            Rows::At(positions) => positions.len(),
        }
    }
}

/// One rank's part of an exchange. Copies share the lists.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern {
    lists: Arc<Lists>,
    /// Values after the rows, which every reader receives.
    tail: usize,
}

#[derive(Debug, Default, PartialEq, Eq)]
struct Lists {
    message_rows: usize,
    readers: Vec<Neighbor>,
    sources: Vec<Neighbor>,
}

impl Pattern {
    /// A pattern of `readers` of the own message, which has `message_rows` rows, and of `sources`. Neighbors that read
    /// no rows are left out.
    ///
    /// # Panics
    /// A position lies outside its message, or a reader's message is not the own one.
    pub fn new(message_rows: usize, readers: Vec<Neighbor>, sources: Vec<Neighbor>) -> Pattern {
        let reading = |mut neighbors: Vec<Neighbor>| {
            neighbors.retain(|neighbor| neighbor.rows_read() > 0);
            neighbors.sort_by_key(|neighbor| neighbor.rank);
            for Neighbor { rank, message_rows, rows } in &neighbors {
                let last = match rows {
                    Rows::All => None,
                    Rows::At(positions) => positions.iter().max(),
                };
                assert!(last.is_none_or(|&p| (p as usize) < *message_rows), "rank {rank}: a row outside the message");
            }
            neighbors
        };
        let (readers, sources) = (reading(readers), reading(sources));
        assert!(readers.iter().all(|reader| reader.message_rows == message_rows), "readers of another message");
        Pattern { lists: Arc::new(Lists { message_rows, readers, sources }), tail: 0 }
    }

    /// Pattern in which every rank reads the whole message of every other rank; `rows[r]`: number of rows of rank r.
    pub fn whole(rank: usize, rows: &[usize]) -> Pattern {
        let neighbors = |message_rows: &dyn Fn(usize) -> usize| {
            let others = (0..rows.len()).filter(|&other| other != rank);
            others.map(|other| Neighbor { rank: other, message_rows: message_rows(other), rows: Rows::All }).collect()
        };
        Pattern::new(rows[rank], neighbors(&|_| rows[rank]), neighbors(&|other| rows[other]))
    }

    /// The same pattern with `values` values after the rows of every message, which every reader receives.
    pub(super) fn with_tail(&self, values: usize) -> Pattern {
        Pattern { tail: values, ..self.clone() }
    }

    /// The same pattern with as many values after the rows as `other` has.
    #[cfg(feature = "mpi")]
    pub(super) fn with_tail_of(&self, other: &Pattern) -> Pattern {
        self.with_tail(other.tail)
    }

    /// Whether `other` is a copy of this pattern. Equal patterns that were made one by one need not be alike.
    #[cfg(feature = "mpi")]
    pub(super) fn is_like(&self, other: &Pattern) -> bool {
        Arc::ptr_eq(&self.lists, &other.lists) && self.tail == other.tail
    }

    /// The same pattern with another length of the own message, `None`: without readers. For faults only, because other
    /// ranks do not know of it.
    pub(super) fn spoiled(&self, message_rows: Option<usize>) -> Pattern {
        let Lists { readers, sources, .. } = &*self.lists;
        let readers = if message_rows.is_some() { readers.clone() } else { Vec::new() };
        let lists = Lists { message_rows: message_rows.unwrap_or(0), readers, sources: sources.clone() };
        Pattern { lists: Arc::new(lists), tail: self.tail }
    }

    /// Rows of the own message.
    pub fn message_rows(&self) -> usize {
        self.lists.message_rows
    }

    /// Ranks that read rows of the own message, ascending.
    pub fn readers(&self) -> &[Neighbor] {
        &self.lists.readers
    }

    /// Ranks whose messages the own rank reads, ascending.
    pub fn sources(&self) -> &[Neighbor] {
        &self.lists.sources
    }

    /// Rows that the own rank reads of rank `rank`, if any.
    pub fn source(&self, rank: usize) -> Option<&Neighbor> {
        let sources = self.sources();
        sources.binary_search_by_key(&rank, |source| source.rank).ok().map(|at| &sources[at])
    }

    /// Number of values of the own message with `width` values per row.
    pub fn message_values(&self, width: usize) -> usize {
        self.message_rows() * width + self.tail
    }
}

/// A message as one reader sees it, in place.
#[derive(Clone, Copy, Debug)]
pub struct Message<'a> {
    values: &'a [f32],
    positions: Option<&'a [u32]>,
    width: usize,
    tail: usize,
}

impl<'a> Message<'a> {
    /// Number of rows that this rank reads.
    pub fn rows(&self) -> usize {
        self.positions.map_or_else(|| self.values().len() / self.width.max(1), <[u32]>::len)
    }

    /// Row `k` of the rows that this rank reads.
    pub fn row(&self, k: usize) -> &'a [f32] {
        let at = self.positions.map_or(k, |positions| positions[k] as usize) * self.width;
        &self.values[at..at + self.width]
    }

    /// All rows of the message, including those that only others read.
    pub fn values(&self) -> &'a [f32] {
        &self.values[..self.values.len() - self.tail]
    }

    /// The values after the rows.
    pub(super) fn tail(&self) -> &'a [f32] {
        &self.values[self.values.len() - self.tail..]
    }

    /// Bytes of the rows that this rank reads.
    pub fn bytes(&self) -> u64 {
        (self.rows() * self.width * size_of::<f32>()) as u64
    }
}

/// Total traffic of exchanges on one rank. All-gathers are not counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Own messages with readers, each counted once for any number of readers.
    pub published: u64,
    /// Bytes of those messages.
    pub bytes_published: u64,
    /// Messages received: those that would travel to this rank without shared memory.
    pub received: u64,
    /// Bytes of the rows read in them.
    pub bytes_received: u64,
}

impl Counts {
    pub(super) fn publish(&mut self, pattern: &Pattern, width: usize) {
        self.published += 1;
        self.bytes_published += (pattern.message_rows() * width * size_of::<f32>()) as u64;
    }

    pub(super) fn receive(&mut self, message: &Message<'_>) {
        self.received += 1;
        self.bytes_received += message.bytes();
    }
}

/// A message that the own rank has to receive.
pub(super) struct Due {
    /// Number of its exchange, counting from 0: the same on all ranks, because all start the same exchanges in the same
    /// order.
    pub number: u64,
    pattern: Pattern,
    width: usize,
    source: usize,
}

impl Due {
    /// The rows that are read of it.
    pub(super) fn neighbor(&self) -> &Neighbor {
        &self.pattern.sources()[self.source]
    }

    /// Bytes of the rows that are read.
    pub(super) fn bytes(&self) -> u64 {
        (self.neighbor().rows_read() * self.width * size_of::<f32>()) as u64
    }

    /// Checks the number of `values` against the pattern and returns the message; Err: the numbers differ.
    pub(super) fn message<'a>(&'a self, rank: usize, values: &'a [f32]) -> Result<Message<'a>, TransportError> {
        let Neighbor { message_rows, rows, .. } = self.neighbor();
        let (width, tail) = (self.width, self.pattern.tail);
        self.check(rank, values, message_rows * width + tail)?;
        let positions = match rows {
            Rows::All => None,
            Rows::At(positions) => Some(&positions[..]),
        };
        Ok(Message { values, positions, width, tail })
    }

    /// Number of values of the message if only the rows that are read are sent.
    #[cfg(feature = "mpi")]
    pub(super) fn packed_values(&self) -> usize {
        self.neighbor().rows_read() * self.width + self.pattern.tail
    }

    /// As [`Due::message`], of `values` that hold only the rows that are read.
    #[cfg(feature = "mpi")]
    pub(super) fn packed_message<'a>(&self, rank: usize, values: &'a [f32]) -> Result<Message<'a>, TransportError> {
        self.check(rank, values, self.packed_values())?;
        Ok(Message { values, positions: None, width: self.width, tail: self.pattern.tail })
    }

    fn check(&self, rank: usize, values: &[f32], expected: usize) -> Result<(), TransportError> {
        if values.len() == expected {
            return Ok(());
        }
        let (source, found) = (self.neighbor().rank, values.len());
        let message = format!("a message of rank {source} holds {found} values instead of {expected}");
        Err(TransportError::Mechanism { rank, message })
    }
}

pub(super) struct Pending {
    rank: usize,
    started: u64,
    /// By source, oldest first.
    due: Vec<VecDeque<Due>>,
}

impl Pending {
    pub(super) fn new(rank: usize, ranks: usize) -> Pending {
        Pending { rank, started: 0, due: (0..ranks).map(|_| VecDeque::new()).collect() }
    }

    /// Records that an exchange begins; returns its number.
    pub(super) fn start(&mut self, pattern: &Pattern, width: usize) -> Result<u64, TransportError> {
        let fail = |message: String| Err(TransportError::Mechanism { rank: self.rank, message });
        for end in pattern.sources().iter().chain(pattern.readers()) {
            if end.rank >= self.due.len() || end.rank == self.rank {
                return fail(format!("a pattern names rank {} of {} ranks", end.rank, self.due.len()));
            }
        }
        let number = self.started;
        if let Some(due) = self.due.iter().flatten().find(|due| due.number + DEPTH as u64 <= number) {
            let (late, source) = (due.number, due.neighbor().rank);
            return fail(format!(
                "exchange {number} must not begin before message {late} of rank {source} is received"
            ));
        }
        for (source, neighbor) in pattern.sources().iter().enumerate() {
            self.due[neighbor.rank].push_back(Due { number, pattern: pattern.clone(), width, source });
        }
        self.started += 1;
        Ok(number)
    }

    /// The next message to receive of `source`.
    pub(super) fn next(&self, source: usize) -> Option<&Due> {
        self.due.get(source)?.front()
    }

    /// The last message to receive of `source`.
    #[cfg(feature = "mpi")]
    pub(super) fn newest(&self, source: usize) -> Option<&Due> {
        self.due.get(source)?.back()
    }

    /// As [`Pending::next`]; an error if there is none.
    pub(super) fn expect(&self, source: usize) -> Result<&Due, TransportError> {
        self.next(source).ok_or_else(|| {
            let message = format!("there is nothing to receive of rank {source} of {} ranks", self.due.len());
            TransportError::Mechanism { rank: self.rank, message }
        })
    }

    /// Removes the next message of `source`, which is being received.
    pub(super) fn take(&mut self, source: usize) -> Result<Due, TransportError> {
        self.expect(source)?;
        Ok(self.due[source].pop_front().expect("looked at above"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn neighbor(rank: usize, message_rows: usize, rows: &[u32]) -> Neighbor {
        Neighbor { rank, message_rows, rows: Rows::At(rows.to_vec()) }
    }

    #[test]
    fn only_those_that_read_are_neighbors() {
        let readers = vec![neighbor(3, 4, &[0, 3]), neighbor(1, 4, &[])];
        let pattern = Pattern::new(4, readers, vec![neighbor(2, 9, &[8]), neighbor(3, 9, &[])]);
        assert_eq!(pattern.readers(), [neighbor(3, 4, &[0, 3])]);
        assert_eq!(pattern.sources(), [neighbor(2, 9, &[8])]);
        assert_eq!((pattern.source(2).map(Neighbor::rows_read), pattern.source(3)), (Some(1), None));
        assert_eq!((pattern.message_values(6), pattern.with_tail(2).message_values(6)), (24, 26));
        let whole = Pattern::whole(1, &[5, 0, 7]);
        assert!(whole.readers().is_empty(), "nobody reads an empty message");
        let sources = whole.sources().iter().map(|source| (source.rank, source.rows_read()));
        assert_eq!(sources.collect::<Vec<_>>(), [(0, 5), (2, 7)]);
    }

    #[test]
    #[should_panic(expected = "rank 2: a row outside the message")]
    fn a_row_outside_the_message_is_refused() {
        Pattern::new(0, Vec::new(), vec![neighbor(2, 3, &[0, 3])]);
    }

    #[test]
    fn messages_show_the_rows_that_are_read() {
        let mut pending = Pending::new(0, 2);
        let pattern = Pattern::new(0, Vec::new(), vec![neighbor(1, 3, &[2, 0])]).with_tail(1);
        assert_eq!(pending.start(&pattern, 2), Ok(0));
        let due = pending.take(1).unwrap();
        let message = due.message(0, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]).unwrap();
        assert_eq!((message.rows(), message.row(0), message.row(1)), (2, &[5.0, 6.0][..], &[1.0, 2.0][..]));
        assert_eq!((message.values().len(), message.tail(), message.bytes()), (6, &[7.0][..], 16));
        let error = due.message(0, &[0.0; 6]).unwrap_err().to_string();
        assert!(error.contains("a message of rank 1 holds 6 values instead of 7"), "{error}");
        assert!(pending.take(1).is_err() && pending.take(5).is_err());
    }

    #[test]
    fn an_exchange_begins_when_the_one_before_the_last_is_finished() {
        let mut pending = Pending::new(0, 3);
        let from_one = Pattern::new(0, Vec::new(), vec![neighbor(1, 1, &[0])]);
        let alone = Pattern::new(0, Vec::new(), Vec::new());
        assert_eq!([&from_one, &alone].map(|pattern| pending.start(pattern, 1)), [Ok(0), Ok(1)]);
        let error = pending.start(&alone, 1).unwrap_err().to_string();
        assert!(error.contains("exchange 2 must not begin before message 0 of rank 1 is received"), "{error}");
        assert_eq!(pending.take(1).map(|due| due.number), Ok(0));
        assert_eq!([&from_one, &from_one].map(|pattern| pending.start(pattern, 1)), [Ok(2), Ok(3)]);
        assert_eq!([pending.take(1), pending.take(1)].map(|due| due.map(|due| due.number)), [Ok(2), Ok(3)]);
        let itself = Pattern::new(0, Vec::new(), vec![neighbor(0, 1, &[0])]);
        assert!(pending.start(&itself, 1).unwrap_err().to_string().contains("names rank 0 of 3"));
    }
}
