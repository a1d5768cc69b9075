//! A [`Transport`] with scripted faults, for tests of runs whose messages are lost, late, cut or refused. Faults affect
//! only messages and calls of the own rank.

use std::time::Duration;

use super::{Counts, Message, Pattern, Transport, TransportError};

/// Fault of an own message. Messages count from 0; exchanges without readers of the own message do not count.
#[allow(missing_docs, reason = "the line of a variant says what it carries")]
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Fault {
    /// The message is never published; its readers receive a later one in its place, or time out.
    Drop { message: u64 },
    /// The message is published late.
    Delay { message: u64, delay: Duration },
    /// Only the first `rows` rows are published.
    Truncate { message: u64, rows: usize },
    /// Publishing fails with a mechanism error.
    Refuse { message: u64 },
}

impl Fault {
    fn message(&self) -> u64 {
        match *self {
            Fault::Drop { message }
            | Fault::Delay { message, .. }
            | Fault::Truncate { message, .. }
            | Fault::Refuse { message } => message,
        }
    }
}

/// Passes all calls to `inner`, except for the faults of the script.
pub struct FaultyTransport<T> {
    inner: T,
    script: Vec<Fault>,
    published: u64,
}

impl<T: Transport> FaultyTransport<T> {
    /// Applies `script` to the messages of `inner`.
    pub fn new(inner: T, script: Vec<Fault>) -> FaultyTransport<T> {
        FaultyTransport { inner, script, published: 0 }
    }
}

impl<T: Transport> Transport for FaultyTransport<T> {
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
        if pattern.readers().is_empty() {
            return self.inner.start(pattern, width, fill);
        }
        let number = self.published;
        self.published += 1;
        let mut handed_over = pattern.message_rows();
        for fault in self.script.iter().filter(|fault| fault.message() == number) {
            match *fault {
                Fault::Drop { .. } => return self.inner.start(&pattern.spoiled(None), width, fill),
                Fault::Delay { delay, .. } => std::thread::sleep(delay),
                Fault::Truncate { rows, .. } => handed_over = handed_over.min(rows),
                Fault::Refuse { .. } => {
                    let message = format!("message {number} refused by the script");
                    return Err(TransportError::Mechanism { rank: self.inner.rank(), message });
                }
            }
        }
        if handed_over == pattern.message_rows() {
            return self.inner.start(pattern, width, fill);
        }
        let mut whole = vec![0.0; pattern.message_values(width)];
        fill(&mut whole);
        self.inner.start(&pattern.spoiled(Some(handed_over)), width, &mut |buffer| {
            buffer.copy_from_slice(&whole[..buffer.len()]);
        })
    }

    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        self.inner.finish(source, read)
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
        self.inner.all_gather(own, out)
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
    use crate::transport::{InProcessTransport, Neighbor, Rows};

    /// Rank 0 sends two values to rank 1 in every exchange.
    fn one_way() -> [Pattern; 2] {
        let to = |rank: usize| vec![Neighbor { rank, message_rows: 2, rows: Rows::All }];
        [Pattern::new(2, to(1), Vec::new()), Pattern::new(0, Vec::new(), to(0))]
    }

    /// Values that rank 1 receives in two exchanges if rank 0 follows `fault`.
    fn received(fault: Fault) -> Vec<Result<Vec<f32>, TransportError>> {
        let mut ranks = InProcessTransport::group(2);
        let (mut one, zero) = (ranks.pop().unwrap(), ranks.pop().unwrap());
        one.set_deadline(Duration::from_millis(50));
        let mut zero = FaultyTransport::new(zero, vec![fault]);
        let [to_one, from_zero] = one_way();
        let exchange = |value: u8| {
            one.start(&from_zero, 1, &mut |_| unreachable!("nobody reads it")).unwrap();
            zero.start(&to_one, 1, &mut |buffer| buffer.fill(f32::from(value)))?;
            let mut seen = Vec::new();
            one.finish(0, &mut |message| seen = message.values().to_vec()).map(|()| seen)
        };
        [1, 2].into_iter().map(exchange).collect()
    }

    #[test]
    fn the_script_is_followed() {
        let whole = [Ok(vec![1.0; 2]), Ok(vec![2.0; 2])];
        let delay = Duration::from_millis(20);
        let start = std::time::Instant::now();
        assert_eq!(received(Fault::Delay { message: 0, delay }), whole);
        assert!(start.elapsed() >= delay);
        assert_eq!(received(Fault::Drop { message: 7 }), whole);
        let dropped = received(Fault::Drop { message: 0 });
        assert!(matches!(dropped[0], Err(TransportError::TimedOut { source_rank: 0, .. })), "{dropped:?}");
        let text = |of: &Result<Vec<f32>, TransportError>| of.as_ref().unwrap_err().to_string();
        let refused = received(Fault::Refuse { message: 1 });
        assert!(refused[0] == whole[0] && text(&refused[1]).contains("message 1 refused"), "{refused:?}");
        let cut = received(Fault::Truncate { message: 1, rows: 1 });
        assert!(cut[0] == whole[0] && text(&cut[1]).contains("of rank 0 holds 1 values instead of 2"), "{cut:?}");
    }

    #[test]
    fn a_later_message_does_not_pass_for_a_lost_one() {
        let mut ranks = InProcessTransport::group(2);
        let (mut one, zero) = (ranks.pop().unwrap(), ranks.pop().unwrap());
        let mut zero = FaultyTransport::new(zero, vec![Fault::Drop { message: 0 }]);
        let [to_one, from_zero] = one_way();
        for _ in 0..2 {
            zero.start(&to_one, 1, &mut |buffer| buffer.fill(1.0)).unwrap();
            one.start(&from_zero, 1, &mut |_| unreachable!("nobody reads it")).unwrap();
        }
        let error = one.finish(0, &mut |_| panic!("this is not the message")).unwrap_err();
        assert_eq!(error, TransportError::OutOfOrder { rank: 1, source_rank: 0, expected: 0, got: 1 });
    }
}
