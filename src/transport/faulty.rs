//! A [`Transport`] that goes wrong on purpose, by a script: for tests of what a run does when messages are lost, late,
//! cut or refused. It knows only faults of the own rank's messages and calls.

use std::time::Duration;

use super::{Transport, TransportError};

/// What goes wrong with a published message. Messages count from 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Fault {
    /// The message is never handed over; the others see the next one in its place, or time out.
    Drop { message: u64 },
    /// The message is handed over late.
    Delay { message: u64, delay: Duration },
    /// Only the first `len` values are handed over.
    Truncate { message: u64, len: usize },
    /// Publishing it fails as if the mechanism below had.
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

/// Passes everything on to `inner` except for what the script spoils.
pub struct FaultyTransport<T> {
    inner: T,
    script: Vec<Fault>,
    published: u64,
}

impl<T: Transport> FaultyTransport<T> {
    /// Spoils messages of `inner` by `script`.
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

    fn publish(&mut self, len: usize, fill: &mut dyn FnMut(&mut [f32])) -> Result<(), TransportError> {
        let number = self.published;
        self.published += 1;
        let mut handed_over = len;
        for fault in self.script.iter().filter(|fault| fault.message() == number) {
            match *fault {
                Fault::Drop { .. } => {
                    fill(&mut vec![0.0; len]);
                    return Ok(());
                }
                Fault::Delay { delay, .. } => std::thread::sleep(delay),
                Fault::Truncate { len, .. } => handed_over = handed_over.min(len),
                Fault::Refuse { .. } => {
                    let message = format!("message {number} refused by the script");
                    return Err(TransportError::Mechanism { rank: self.inner.rank(), message });
                }
            }
        }
        if handed_over == len {
            return self.inner.publish(len, fill);
        }
        let mut whole = vec![0.0; len];
        fill(&mut whole);
        self.inner.publish(handed_over, &mut |buffer| buffer.copy_from_slice(&whole[..handed_over]))
    }

    fn receive(&mut self, source: usize, read: &mut dyn FnMut(&[f32])) -> Result<(), TransportError> {
        self.inner.receive(source, read)
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
    fn the_script_is_followed() {
        let mut ranks = InProcessTransport::group(2);
        let (mut one, zero) = (ranks.pop().unwrap(), ranks.pop().unwrap());
        one.set_deadline(Duration::from_millis(50));
        let script = vec![
            Fault::Drop { message: 0 },
            Fault::Delay { message: 1, delay: Duration::from_millis(20) },
            Fault::Truncate { message: 2, len: 1 },
            Fault::Refuse { message: 3 },
        ];
        let mut zero = FaultyTransport::new(zero, script);
        let mut publish = |value: f32| zero.publish(2, &mut |buffer| buffer.fill(value));
        let mut receive = || {
            let mut seen = Vec::new();
            one.receive(0, &mut |values| seen = values.to_vec()).map(|()| seen)
        };
        publish(0.0).unwrap();
        assert!(matches!(receive(), Err(TransportError::TimedOut { source_rank: 0, .. })));
        let start = std::time::Instant::now();
        publish(1.0).unwrap();
        assert!(start.elapsed() >= Duration::from_millis(20));
        assert_eq!(receive().unwrap(), [1.0, 1.0]);
        publish(2.0).unwrap();
        assert_eq!(receive().unwrap(), [2.0]);
        assert!(publish(3.0).unwrap_err().to_string().contains("message 3 refused"));
        publish(4.0).unwrap();
        assert_eq!(receive().unwrap(), [4.0, 4.0]);
    }
}
