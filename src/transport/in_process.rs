//! [`Transport`] between threads of one process, for tests and for runs with one rank. Order, limits of publishing
//! ahead, and errors are the same as between processes; it uses no shared-memory files.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::pattern::{DEPTH, Pending};
use super::wait::HOOK_INTERVAL;
use super::{ALL_GATHER_MAX, Counts, Message, Pattern, RANKS_MAX, Transport, TransportError};

/// One rank of a group of threads. It calls `Hook` during waits; a hook that cannot be sent binds the rank to a thread.
pub struct InProcessTransport<Hook = SendHook> {
    rank: usize,
    ranks: usize,
    shared: Arc<Shared>,
    deadline: Duration,
    on_wait: Option<Hook>,
    pending: Pending,
    gathers: u64,
    /// Buffers of own messages; one is written while readers hold the others.
    buffers: Vec<Arc<Vec<f32>>>,
    max_message_values: usize,
    counts: Counts,
}

/// A [`super::WaitHook`] that can be sent to another thread.
pub type SendHook = Box<dyn FnMut() -> bool + Send>;

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

struct State {
    /// By rank: its messages that still have readers, oldest first.
    messages: Vec<VecDeque<Unread>>,
    /// Contributions to the all-gathers: two slots by parity, each by rank with the number of the operation.
    gathers: [Vec<(u64, Vec<f64>)>; 2],
}

struct Unread {
    number: u64,
    /// Ranks that have yet to read it, ascending.
    readers: Vec<usize>,
    values: Arc<Vec<f32>>,
}

impl State {
    /// The next message of `source` that `rank` reads, which must be that of exchange `number`.
    fn next(&self, rank: usize, source: usize, number: u64) -> Option<Result<&Unread, TransportError>> {
        let unread = self.messages[source].iter().find(|unread| unread.readers.contains(&rank))?;
        let (source_rank, expected, got) = (source, number, unread.number);
        Some(if got == expected {
            Ok(unread)
        } else {
            Err(TransportError::OutOfOrder { rank, source_rank, expected, got })
        })
    }

    /// The first reader of a message of `rank` that prevents the next one.
    fn in_the_way(&self, rank: usize) -> Option<usize> {
        let oldest = self.messages[rank].front().filter(|_| self.messages[rank].len() >= DEPTH);
        oldest.and_then(|unread| unread.readers.first().copied())
    }
}

impl InProcessTransport {
    /// The transports of `ranks` ranks, by rank. A rank waits at most one minute, see
    /// [`InProcessTransport::set_deadline`].
    pub fn group(ranks: usize) -> Vec<InProcessTransport> {
        assert!(ranks <= RANKS_MAX, "{ranks} ranks, at most {RANKS_MAX} are possible");
        let state = State {
            messages: (0..ranks).map(|_| VecDeque::new()).collect(),
            gathers: [vec![(0, Vec::new()); ranks], vec![(0, Vec::new()); ranks]],
        };
        let shared = Arc::new(Shared { state: Mutex::new(state), changed: Condvar::new() });
        (0..ranks)
            .map(|rank| InProcessTransport {
                rank,
                ranks,
                shared: shared.clone(),
                deadline: Duration::from_secs(60),
                on_wait: None,
                pending: Pending::new(rank, ranks),
                gathers: 0,
                buffers: Vec::new(),
                max_message_values: usize::MAX,
                counts: Counts::default(),
            })
            .collect()
    }

    /// The same rank with a hook that is called at least every 50 ms during a wait; it returns true to give up.
    pub fn with_hook<Hook>(self, on_wait: Hook) -> InProcessTransport<Hook> {
        let on_wait = Some(on_wait);
        InProcessTransport {
            on_wait,
            rank: self.rank,
            ranks: self.ranks,
            shared: self.shared,
            deadline: self.deadline,
            pending: self.pending,
            gathers: self.gathers,
            buffers: self.buffers,
            max_message_values: self.max_message_values,
            counts: self.counts,
        }
    }
}

impl<Hook: FnMut() -> bool> InProcessTransport<Hook> {
    /// Longest wait of one call.
    pub fn set_deadline(&mut self, deadline: Duration) {
        self.deadline = deadline;
    }

    /// Value of [`Transport::max_message_values`]; longer messages are not refused. Unbounded by default.
    pub fn set_max_message_values(&mut self, values: usize) {
        self.max_message_values = values;
    }

    /// Waits until `look` finds a value in the shared state.
    fn wait_for<T>(
        &mut self,
        source_rank: usize,
        what: &'static str,
        mut look: impl FnMut(&mut State) -> Option<T>,
    ) -> Result<T, TransportError> {
        let rank = self.rank;
        let start = Instant::now();
        let mut state = self.shared.lock();
        loop {
            if let Some(found) = look(&mut state) {
                return Ok(found);
            }
            if self.on_wait.as_mut().is_some_and(|hook| hook()) {
                return Err(TransportError::Aborted { rank, source_rank, what });
            }
            let waited = start.elapsed();
            if waited >= self.deadline {
                let waited_s = waited.as_secs_f64();
                return Err(TransportError::TimedOut { rank, source_rank, what, waited_s });
            }
            let limit = HOOK_INTERVAL.min(self.deadline - waited);
            let woken = self.shared.changed.wait_timeout(state, limit);
            state = woken.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// A buffer that no reader holds any more.
    fn take_buffer(&mut self) -> Arc<Vec<f32>> {
        match self.buffers.iter().position(|buffer| Arc::strong_count(buffer) == 1) {
            Some(index) => self.buffers.swap_remove(index),
            None => Arc::default(),
        }
    }

    fn fail(&self, message: String) -> TransportError {
        TransportError::Mechanism { rank: self.rank, message }
    }
}

impl Shared {
    /// The state stays consistent if a rank panics while it holds the lock, because every change is one assignment.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<Hook: FnMut() -> bool> Transport for InProcessTransport<Hook> {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.ranks
    }

    fn start(
        &mut self,
        pattern: &Pattern,
        width: usize,
        fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError> {
        let number = self.pending.start(pattern, width)?;
        let readers: Vec<usize> = pattern.readers().iter().map(|reader| reader.rank).collect();
        if readers.is_empty() {
            return Ok(());
        }
        let rank = self.rank;
        while let Some(reader) = { self.shared.lock().in_the_way(rank) } {
            self.wait_for(reader, "room for the next message", |state| {
                (state.in_the_way(rank) != Some(reader)).then_some(())
            })?;
        }
        let mut buffer = self.take_buffer();
        // No reader holds the buffer, so this never copies.
        let values = Arc::make_mut(&mut buffer);
        values.resize(pattern.message_values(width), 0.0);
        fill(values);
        self.shared.lock().messages[rank].push_back(Unread { number, readers, values: buffer.clone() });
        self.shared.changed.notify_all();
        self.buffers.push(buffer);
        self.counts.publish(pattern, width);
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        let Some(due) = self.pending.next(source) else { return false };
        self.shared.lock().next(self.rank, source, due.number).is_some()
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        let (rank, number) = (self.rank, self.pending.expect(source)?.number);
        self.wait_for(source, "its next message", |state| {
            state.next(rank, source, number).map(|found| found.map(|_| ()))
        })?
    }

    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        let (rank, number) = (self.rank, self.pending.expect(source)?.number);
        let values = self.wait_for(source, "its next message", |state| {
            state.next(rank, source, number).map(|found| found.map(|unread| unread.values.clone()))
        })??;
        let due = self.pending.take(source)?;
        let message = due.message(rank, &values)?;
        read(&message);
        self.counts.receive(&message);
        drop(values);
        let mut state = self.shared.lock();
        let unread = &mut state.messages[source];
        if let Some(message) = unread.iter_mut().find(|unread| unread.number == number) {
            message.readers.retain(|&reader| reader != rank);
        }
        unread.retain(|unread| !unread.readers.is_empty());
        drop(state);
        self.shared.changed.notify_all();
        Ok(())
    }

    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        if own.len() > ALL_GATHER_MAX {
            return Err(self.fail(format!("all-gather of {} values, at most {ALL_GATHER_MAX}", own.len())));
        }
        out.resize_with(self.ranks, Vec::new);
        out[self.rank].clear();
        out[self.rank].extend_from_slice(own);
        let sequence = self.gathers + 1;
        self.gathers = sequence;
        if self.ranks == 1 {
            return Ok(());
        }
        let (rank, slot) = (self.rank, (sequence & 1) as usize);
        {
            // Two slots suffice: no rank writes operation k + 2 before all ranks have read operation k.
            let mut state = self.shared.lock();
            let (number, values) = &mut state.gathers[slot][rank];
            *number = sequence;
            values.clear();
            values.extend_from_slice(own);
        }
        self.shared.changed.notify_all();
        for source in (0..self.ranks).filter(|&source| source != rank) {
            let values = &mut out[source];
            self.wait_for(source, "its part of an all-gather", |state| {
                let (number, contributed) = &state.gathers[slot][source];
                (*number == sequence).then(|| values.clone_from(contributed))
            })?;
        }
        Ok(())
    }

    fn max_message_values(&self) -> usize {
        self.max_message_values
    }

    fn counts(&self) -> Counts {
        self.counts
    }
}
