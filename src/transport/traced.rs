//! A [`Transport`] that records how work interleaved with exchanges spends its time: computing up to the next message,
//! publishing a message, waiting for one, reading it. It changes nothing else, and has no effect without a recording.

use super::{Counts, Message, Pattern, Transport, TransportError};
use crate::telemetry::{Activity, EventName, Moment, Recorder};

/// Passes all calls to a transport and records them as [`EventName::is_share`] describes.
pub struct TracedTransport<'a> {
    inner: &'a mut dyn Transport,
    recorder: &'a mut Recorder,
    work: EventName,
    share: EventName,
    /// End of the last exchange.
    since: Moment,
}

impl<'a> TracedTransport<'a> {
    /// Work begins now. Its parts become events called `work`, its exchanges events called `share`.
    pub fn new(
        inner: &'a mut dyn Transport,
        recorder: &'a mut Recorder,
        work: EventName,
        share: EventName,
    ) -> TracedTransport<'a> {
        let since = recorder.now();
        TracedTransport { inner, recorder, work, share, since }
    }

    /// Exchanges are called `share` from now on.
    pub fn shares(&mut self, share: EventName) {
        self.share = share;
    }

    /// Ends the work: records its last part, with the bytes that all parts together read and wrote.
    pub fn finish(self, bytes: u64) {
        self.recorder.end(self.work, Activity::Compute, self.since, bytes, 0);
    }

    /// Records a part of the work that ends because an exchange begins.
    fn pause(&mut self) -> Moment {
        self.recorder.end(self.work, Activity::Compute, self.since, 0, 0);
        self.recorder.now()
    }

    fn own(&self) -> (u32, u32, u32) {
        let rank = self.inner.rank() as u32;
        (0, rank, rank)
    }
}

impl Transport for TracedTransport<'_> {
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
        let start = self.pause();
        self.inner.start(pattern, width, fill)?;
        let read = if pattern.readers().is_empty() { 0 } else { pattern.message_rows() };
        let bytes = (read * width * size_of::<f32>()) as u64;
        self.recorder.end_transfer(self.share, Activity::Transfer, start, self.own(), bytes, 0);
        self.since = self.recorder.now();
        Ok(())
    }

    fn finish(&mut self, source: usize, read: &mut dyn FnMut(&Message<'_>)) -> Result<(), TransportError> {
        let route = (0, source as u32, source as u32);
        let mut start = self.recorder.now();
        if !self.inner.ready(source) {
            self.inner.wait(source)?;
            self.recorder.end_transfer(self.share, Activity::Wait, start, route, 0, 0);
            start = self.recorder.now();
        }
        let mut bytes = 0;
        self.inner.finish(source, &mut |message| {
            bytes = message.bytes();
            read(message);
        })?;
        self.recorder.end_transfer(self.share, Activity::Transfer, start, route, bytes, 0);
        self.since = self.recorder.now();
        Ok(())
    }

    fn ready(&mut self, source: usize) -> bool {
        self.inner.ready(source)
    }

    fn wait(&mut self, source: usize) -> Result<(), TransportError> {
        self.inner.wait(source)
    }

    fn share(
        &mut self,
        lengths: &[usize],
        own: &[f32],
        read: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<(), TransportError> {
        let mut since = self.pause();
        let (rank, recorder, share) = (self.inner.rank(), &mut *self.recorder, self.share);
        self.inner.share(lengths, own, &mut |source, values| {
            let (route, bytes) = ((0, source as u32, source as u32), size_of_val(values) as u64);
            if source != rank {
                recorder.end_transfer(share, Activity::Wait, since, route, 0, 0);
                since = recorder.now();
            }
            read(source, values);
            recorder.end_transfer(share, Activity::Transfer, since, route, bytes, 0);
            since = recorder.now();
        })?;
        self.since = since;
        Ok(())
    }

    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError> {
        let start = self.pause();
        self.inner.all_gather(own, out)?;
        let (route, bytes) = (self.own(), size_of_val(own) as u64);
        self.recorder.end_transfer(self.share, Activity::Wait, start, route, bytes, 0);
        self.since = self.recorder.now();
        Ok(())
    }

    fn alive(&mut self) -> Result<(), TransportError> {
        self.inner.alive()
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
    use std::time::Duration;

    use super::*;
    use crate::telemetry::Event;
    use crate::transport::{InProcessTransport, share_lists};

    const LATE: Duration = Duration::from_millis(60);

    /// Events of rank 0 while rank 1 works for [`LATE`] before each of its two exchanges.
    fn events() -> Vec<Event> {
        let mut ranks = InProcessTransport::group(2);
        let (mut one, mut zero) = (ranks.pop().unwrap(), ranks.pop().unwrap());
        let late = std::thread::spawn(move || {
            for _ in 0..2 {
                std::thread::sleep(LATE);
                share_lists(&mut one, &[7u32; 5], &mut |_, _: &[u32]| ()).unwrap();
            }
        });
        let mut recorder = Recorder::new(None);
        recorder.begin_step(1, true);
        let mut traced =
            TracedTransport::new(&mut zero, &mut recorder, EventName::ProximityQuery, EventName::ShareQuery);
        for _ in 0..2 {
            let mut got = Vec::new();
            share_lists(&mut traced, &[1u32, 2], &mut |_, part: &[u32]| got.extend_from_slice(part)).unwrap();
            assert_eq!(got, [1, 2, 7, 7, 7, 7, 7]);
        }
        traced.finish(4711);
        late.join().unwrap();
        recorder.take()
    }

    #[test]
    fn what_another_rank_takes_is_a_wait_and_no_work() {
        let events = events();
        let of = |name: EventName, activity: Activity| -> Vec<&Event> {
            events.iter().filter(|e| e.name == name as u32 && e.activity == activity as u32).collect()
        };
        let length = |events: &[&Event]| events.iter().map(|e| e.end_ns - e.start_ns).sum::<u64>();
        let work = of(EventName::ProximityQuery, Activity::Compute);
        let waits = of(EventName::ShareQuery, Activity::Wait);
        assert!(u128::from(length(&waits)) >= LATE.as_nanos(), "{waits:?}");
        let (first, last) = (events[0].start_ns, events[events.len() - 1].end_ns);
        assert!(length(&work) + length(&waits) <= last - first);
        for pair in events.windows(2) {
            assert!(pair[0].end_ns <= pair[1].start_ns, "{pair:?} overlap");
        }
        // Two exchanges of a length and a list each; the bytes of the work are recorded once.
        assert_eq!(work.iter().map(|e| e.bytes).collect::<Vec<_>>(), [0, 0, 0, 0, 4711]);
        let moved = of(EventName::ShareQuery, Activity::Transfer);
        let routes: Vec<_> = moved.iter().map(|e| (e.source, e.vector, e.bytes)).collect();
        assert_eq!(routes, [(0, 0, 8), (1, 1, 20), (0, 0, 8), (1, 1, 20)]);
    }
}
