//! [`Transport`] between threads of one process: for tests and for runs with one rank. Same order, same bounds on how far
//! a publisher may run ahead, same errors as between processes; no shared-memory files.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::wait::HOOK_INTERVAL;
use super::{ALL_GATHER_MAX, Transport, TransportError};

/// Messages that a publisher may be ahead of its slowest reader.
const DEPTH: usize = 2;

/// One rank of a group of threads. `Hook` is called while it waits; it binds the rank to a thread if it cannot be sent.
pub struct InProcessTransport<Hook = SendHook> {
    rank: usize,
    ranks: usize,
    shared: Arc<Shared>,
    deadline: Duration,
    on_wait: Option<Hook>,
    /// Messages received so far, by source.
    received: Vec<u64>,
    gathers: u64,
    /// Buffers of own messages; one is written while readers hold the others.
    buffers: Vec<Arc<Vec<f32>>>,
    published: u64,
    max_message_values: usize,
    bytes_published: u64,
    bytes_received: u64,
}

/// A [`super::WaitHook`] that can be sent to another thread.
pub type SendHook = Box<dyn FnMut() -> bool + Send>;

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

struct State {
    sources: Vec<Source>,
    /// Contributions to the all-gathers: two slots by parity, each by rank with the number of the operation.
    gathers: [Vec<(u64, Vec<f64>)>; 2],
}

struct Source {
    /// Messages not yet received by everybody, oldest first.
    messages: VecDeque<Arc<Vec<f32>>>,
    /// Number of the oldest of them.
    first: u64,
    /// Messages given back, by reader.
    consumed: Vec<u64>,
}

impl Source {
    /// Notes that `reader` is through with `count` messages of this source, whose rank is `own`, and forgets those that
    /// everybody is through with.
    fn give_back(&mut self, own: usize, reader: usize, count: u64) {
        self.consumed[reader] = count;
        let others = self.consumed.iter().enumerate().filter(|(rank, _)| *rank != own);
        let slowest = others.map(|(_, &count)| count).min().unwrap_or(count);
        while self.first < slowest && self.messages.pop_front().is_some() {
            self.first += 1;
        }
    }
}

impl InProcessTransport {
    /// The transports of `ranks` ranks, by rank. A rank waits up to a minute, see [`InProcessTransport::set_deadline`].
    pub fn group(ranks: usize) -> Vec<InProcessTransport> {
        let source = || Source { messages: VecDeque::new(), first: 0, consumed: vec![0; ranks] };
        let state = State {
            sources: (0..ranks).map(|_| source()).collect(),
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
                received: vec![0; ranks],
                gathers: 0,
                buffers: Vec::new(),
                published: 0,
                max_message_values: usize::MAX,
                bytes_published: 0,
                bytes_received: 0,
            })
            .collect()
    }

    /// Called at least every 50 ms while waiting; true = give up.
    pub fn set_on_wait(&mut self, on_wait: SendHook) {
        self.on_wait = Some(on_wait);
    }

    /// The same rank with a hook of another type.
    pub fn with_hook<Hook>(self, on_wait: Hook) -> InProcessTransport<Hook> {
        let on_wait = Some(on_wait);
        InProcessTransport {
            on_wait,
            rank: self.rank,
            ranks: self.ranks,
            shared: self.shared,
            deadline: self.deadline,
            received: self.received,
            gathers: self.gathers,
            buffers: self.buffers,
            published: self.published,
            max_message_values: self.max_message_values,
            bytes_published: self.bytes_published,
            bytes_received: self.bytes_received,
        }
    }
}

impl<Hook: FnMut() -> bool> InProcessTransport<Hook> {
    /// Longest wait of one call.
    pub fn set_deadline(&mut self, deadline: Duration) {
        self.deadline = deadline;
    }

    /// What [`Transport::max_message_values`] answers; longer messages are not refused. No bound at first.
    pub fn set_max_message_values(&mut self, values: usize) {
        self.max_message_values = values;
    }

    /// Waits until `look` finds something in the shared state.
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
    /// A rank that panicked while it held the lock left the state consistent: every change is one assignment.
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

    fn publish(&mut self, len: usize, fill: &mut dyn FnMut(&mut [f32])) -> Result<(), TransportError> {
        let (rank, ranks, published) = (self.rank, self.ranks, self.published);
        for reader in (0..ranks).filter(|&reader| reader != rank) {
            self.wait_for(reader, "room for the next message", |state| {
                (published - state.sources[rank].consumed[reader] < DEPTH as u64).then_some(())
            })?;
        }
        let mut buffer = self.take_buffer();
        // Nobody else holds the buffer, so this never copies.
        let values = Arc::make_mut(&mut buffer);
        values.resize(len, 0.0);
        fill(values);
        if ranks > 1 {
            self.shared.lock().sources[rank].messages.push_back(buffer.clone());
            self.shared.changed.notify_all();
        }
        self.buffers.push(buffer);
        self.published += 1;
        self.bytes_published += (len * size_of::<f32>()) as u64;
        Ok(())
    }

    fn receive(&mut self, source: usize, read: &mut dyn FnMut(&[f32])) -> Result<(), TransportError> {
        let (rank, ranks) = (self.rank, self.ranks);
        if source >= ranks || source == rank {
            return Err(self.fail(format!("cannot receive from rank {source} of {ranks} ranks")));
        }
        let sequence = self.received[source];
        let message = self.wait_for(source, "its next message", |state| {
            let source = &state.sources[source];
            source.messages.get((sequence - source.first) as usize).cloned()
        })?;
        read(&message);
        self.bytes_received += std::mem::size_of_val(message.as_slice()) as u64;
        self.received[source] = sequence + 1;
        drop(message);
        let mut state = self.shared.lock();
        state.sources[source].give_back(source, rank, sequence + 1);
        drop(state);
        self.shared.changed.notify_all();
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        let Some(&sequence) = self.received.get(source) else { return false };
        let state = self.shared.lock();
        let source = &state.sources[source];
        source.messages.len() as u64 + source.first > sequence
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        let Some(&sequence) = self.received.get(source).filter(|_| source != self.rank) else {
            return Err(self.fail(format!("cannot wait for rank {source} of {} ranks", self.ranks)));
        };
        self.wait_for(source, "its next message", |state| {
            let source = &state.sources[source];
            (source.messages.len() as u64 + source.first > sequence).then_some(())
        })
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
            // Two slots suffice: nobody writes operation k + 2 before everybody has read operation k.
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

    fn bytes_published(&self) -> u64 {
        self.bytes_published
    }

    fn bytes_received(&self) -> u64 {
        self.bytes_received
    }
}
