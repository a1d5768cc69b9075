//! A [`Transport`] that notes what goes through it, for tests of schedules and counts. It changes nothing.

use super::{Transport, TransportError};

/// What a noted call did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// A message of the own rank was published.
    Publish,
    /// A message was received.
    Receive,
    /// An all-gather (a barrier is one of length 0) was completed.
    AllGather,
}

/// One successful call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// What happened.
    pub action: Action,
    /// Rank that the values came from: the own one unless received.
    pub source: usize,
    /// Number of values (of the own contribution to an all-gather).
    pub len: usize,
}

/// Passes everything on to `inner` and keeps a log of the calls that succeeded.
pub struct RecordingTransport<T> {
    inner: T,
    log: Vec<Record>,
}

impl<T: Transport> RecordingTransport<T> {
    /// Records what goes through `inner`.
    pub fn new(inner: T) -> RecordingTransport<T> {
        RecordingTransport { inner, log: Vec::new() }
    }

    /// The calls so far, oldest first.
    pub fn log(&self) -> &[Record] {
        &self.log
    }

    /// Hands the log over and begins a new one.
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

    fn publish(&mut self, len: usize, fill: &mut dyn FnMut(&mut [f32])) -> Result<(), TransportError> {
        self.inner.publish(len, fill)?;
        self.log.push(Record { action: Action::Publish, source: self.inner.rank(), len });
        Ok(())
    }

    fn receive(&mut self, source: usize, read: &mut dyn FnMut(&[f32])) -> Result<(), TransportError> {
        let mut len = 0;
        self.inner.receive(source, &mut |values| {
            len = values.len();
            read(values);
        })?;
        self.log.push(Record { action: Action::Receive, source, len });
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

    fn bytes_published(&self) -> u64 {
        self.inner.bytes_published()
    }

    fn bytes_received(&self) -> u64 {
        self.inner.bytes_received()
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
        one.publish(3, &mut |buffer| buffer.fill(1.0)).unwrap();
        zero.publish(2, &mut |buffer| buffer.fill(2.0)).unwrap();
        zero.receive(1, &mut |values| assert_eq!(values, [1.0; 3])).unwrap();
        assert!(zero.receive(0, &mut |_| {}).is_err());
        let expected = [
            Record { action: Action::Publish, source: 0, len: 2 },
            Record { action: Action::Receive, source: 1, len: 3 },
        ];
        assert_eq!(zero.log(), expected);
        assert_eq!(zero.take_log(), expected);
        assert!(zero.log().is_empty());
        assert_eq!((zero.bytes_published(), zero.bytes_received()), (8, 12));
    }
}
