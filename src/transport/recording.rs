//! A [`Transport`] that records its calls, for tests of schedules and counts. It changes nothing.

use super::{Counts, Message, Pattern, Transport, TransportError};

/// Kind of a recorded call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// A message of the own rank with readers was published.
    Publish,
    /// A message was received.
    Receive,
    /// An all-gather was completed (a barrier is an all-gather of length 0).
    AllGather,
}

/// One successful call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// Kind of the call.
    pub action: Action,
    /// Source of the values: the own rank unless received.
    pub source: usize,
    /// Number of values: of the own message, of the rows read of another one, of the own contribution to an all-gather.
    pub len: usize,
}

/// Passes all calls to `inner` and keeps a log of those that succeeded.
pub struct RecordingTransport<T> {
    inner: T,
    log: Vec<Record>,
}

impl<T: Transport> RecordingTransport<T> {
    /// Records the calls of `inner`.
    pub fn new(inner: T) -> RecordingTransport<T> {
        RecordingTransport { inner, log: Vec::new() }
    }

    /// The calls so far, oldest first.
    pub fn log(&self) -> &[Record] {
        &self.log
    }

    /// Returns the log and begins a new one.
    pub fn take_log(&mut self) -> Vec<Record> {
        std::mem::take(&mut self.log)
    }

    /// Ends the recording.
    pub fn into_inner(self) -> T {
        self.inner
    }
}

impl<T: Transport> Transport for RecordingTransport<T> {
    fn rank(&self) -> usize {
        self.inner.rank()
    }

    fn ranks(&self) -> usize {
        self.inner.ranks()
    }

    fn start(
        &mut self,
        pattern: &Pattern,
        width: usize,
        fill: &mut dyn FnMut(&mut [f32]),
    ) -> Result<(), TransportError> {
        self.inner.start(pattern, width, fill)?;
        if !pattern.readers().is_empty() {
            let len = pattern.message_rows() * width;
            self.log.push(Record { action: Action::Publish, source: self.inner.rank(), len });
        }
        Ok(())
    }

    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        let mut bytes = 0;
        self.inner.finish(source, &mut |message| {
            bytes = message.bytes() as usize;
            read(message);
        })?;
        self.log.push(Record { action: Action::Receive, source, len: bytes / size_of::<f32>() });
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        self.inner.ready(source)
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        self.inner.wait(source)
    }

    fn alive(&mut self) -> Result<(), TransportError> {
        self.inner.alive()
    }

    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        self.inner.all_gather(own, out)?;
        self.log.push(Record { action: Action::AllGather, source: self.inner.rank(), len: own.len() });
        Ok(())
    }

    fn max_message_values(&self) -> usize {
        self.inner.max_message_values()
    }

    fn counts(&self) -> Counts {
        self.inner.counts()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::InProcessTransport;

    #[test]
    fn the_log_holds_the_calls_in_order() {
        let mut ranks = InProcessTransport::group(2);
        let (mut one, zero) = (ranks.pop().unwrap(), ranks.pop().unwrap());
        let mut zero = RecordingTransport::new(zero);
        let rows = [2, 3];
        one.start(&Pattern::whole(1, &rows), 1, &mut |buffer| buffer.fill(1.0)).unwrap();
        zero.start(&Pattern::whole(0, &rows), 1, &mut |buffer| buffer.fill(2.0)).unwrap();
        zero.finish(1, &mut |message| assert_eq!(message.values(), [1.0; 3])).unwrap();
        assert!(zero.finish(1, &mut |_| {}).is_err());
        zero.start(&Pattern::whole(0, &[0, 0]), 1, &mut |_| panic!("nobody reads it")).unwrap();
        let expected = [
            Record { action: Action::Publish, source: 0, len: 2 },
            Record { action: Action::Receive, source: 1, len: 3 },
        ];
        assert_eq!(zero.log(), expected);
        assert_eq!(zero.take_log(), expected);
        assert!(zero.log().is_empty());
        assert_eq!(zero.counts(), Counts { published: 1, bytes_published: 8, received: 1, bytes_received: 12 });
    }
}
