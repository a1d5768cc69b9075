//! Messages of any length between the coordinator and a worker, as messages of MPI: each begins with its length, and
//! long ones follow in parts. A message belongs to a crew, and what an earlier crew has left under way is skipped.

use std::collections::VecDeque;
use std::sync::Arc;

use super::library::{Library, Receiving, Sending};
use crate::transport::ControlError;

/// Most bytes of a part.
const PART: usize = 16 << 20;
/// Bytes before the first part: length of the message, crew, and kind.
const HEADER: usize = 16;
/// Parts under way that a sender lets pile up; the rest waits in its own memory.
const UNDER_WAY: usize = 8;

/// What a message is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// One of the control channel.
    Message,
    /// The last one of a worker, which has left.
    Left,
}

/// The sender of messages to one process.
pub(super) struct Outgoing {
    library: Library,
    to: usize,
    tag: i32,
    crew: u32,
    waiting: VecDeque<Arc<Vec<u8>>>,
    under_way: VecDeque<Sending<u8>>,
}

impl Outgoing {
    pub(super) fn new(library: &Library, to: usize, tag: i32, crew: u32) -> Outgoing {
        let (waiting, under_way) = (VecDeque::new(), VecDeque::new());
        Outgoing { library: library.clone(), to, tag, crew, waiting, under_way }
    }

    /// Accepts a message.
    pub(super) fn push(&mut self, kind: Kind, message: &[u8]) {
        let (first, rest) = message.split_at(message.len().min(PART - HEADER));
        let mut part = Vec::with_capacity(HEADER + first.len());
        part.extend_from_slice(&(message.len() as u64).to_le_bytes());
        part.extend_from_slice(&self.crew.to_le_bytes());
        part.extend_from_slice(&(kind as u32).to_le_bytes());
        part.extend_from_slice(first);
        self.waiting.push_back(Arc::new(part));
        self.waiting.extend(rest.chunks(PART).map(|part| Arc::new(part.to_vec())));
    }

    /// Sends what there is room for. Never waits.
    pub(super) fn pump(&mut self) -> Result<(), ControlError> {
        while let Some(oldest) = self.under_way.front_mut()
            && oldest.is_done()?
        {
            self.under_way.pop_front();
        }
        while self.under_way.len() < UNDER_WAY
            && let Some(part) = self.waiting.pop_front()
        {
            self.under_way.push_back(self.library.send(self.to, self.tag, &part)?);
        }
        Ok(())
    }

    /// Whether everything is under way.
    pub(super) fn is_sent(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Whether MPI is done with everything.
    pub(super) fn is_complete(&self) -> bool {
        self.waiting.is_empty() && self.under_way.is_empty()
    }
}

/// The receiver of messages of one process.
pub(super) struct Incoming {
    library: Library,
    from: usize,
    tag: i32,
    /// None: of any crew.
    crew: Option<u32>,
    part: Option<Receiving<u8>>,
    /// The message whose parts arrive.
    begun: Option<Begun>,
}

struct Begun {
    length: usize,
    crew: u32,
    is_last: bool,
    bytes: Vec<u8>,
}

impl Incoming {
    pub(super) fn new(library: &Library, from: usize, tag: i32, crew: u32) -> Incoming {
        Incoming { crew: Some(crew), ..Incoming::of_any_crew(library, from, tag) }
    }

    pub(super) fn of_any_crew(library: &Library, from: usize, tag: i32) -> Incoming {
        Incoming { library: library.clone(), from, tag, crew: None, part: None, begun: None }
    }

    /// The next message, if all of it is here. Never waits.
    pub(super) fn next(&mut self) -> Result<Option<(Kind, Vec<u8>)>, ControlError> {
        loop {
            if self.part.is_none() {
                self.part = self.library.take(Some(self.from), self.tag)?.map(|(_, request)| request);
            }
            let Some(mut part) = self.part.take() else { return Ok(None) };
            if !part.is_done()? {
                self.part = Some(part);
                return Ok(None);
            }
            let (bytes, _) = part.into_buffer();
            let begun = match self.begun.take() {
                Some(mut begun) => {
                    begun.bytes.extend_from_slice(&bytes);
                    begun
                }
                None => begin(bytes)?,
            };
            if begun.bytes.len() < begun.length {
                self.begun = Some(begun);
            } else if self.crew.is_none_or(|crew| crew == begun.crew) {
                let kind = if begun.is_last { Kind::Left } else { Kind::Message };
                return Ok(Some((kind, begun.bytes)));
            }
        }
    }
}

/// Reads the header of a first part.
fn begin(mut part: Vec<u8>) -> Result<Begun, ControlError> {
    if part.len() < HEADER {
        return Err(ControlError::Mechanism { message: format!("a message of {} bytes without a header", part.len()) });
    }
    let length = u64::from_le_bytes(std::array::from_fn(|at| part[at])) as usize;
    let word = |from: usize| u32::from_le_bytes(std::array::from_fn(|at| part[from + at]));
    let (crew, is_last) = (word(8), word(12) == Kind::Left as u32);
    part.drain(..HEADER);
    part.reserve_exact(length.saturating_sub(part.len()));
    Ok(Begun { length, crew, is_last, bytes: part })
}
