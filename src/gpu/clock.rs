//! Time stamps among the commands of a device, converted to the host's time axis.
//!
//! The host only asks for kernels; the device's own clock measures them. A device without time stamps is waited for
//! instead, so that the host's clock measures them.

use std::cell::{Cell, RefCell};
use std::sync::Arc;

use super::commands::{Commands, ReadPart};
use crate::telemetry::DeviceClock;

/// Features of a device that time stamps between passes need.
pub(super) const FEATURES: wgpu::Features =
    wgpu::Features::TIMESTAMP_QUERY.union(wgpu::Features::TIMESTAMP_QUERY_INSIDE_ENCODERS);

/// Time stamps of one query set, the most that WebGPU allows.
const SET: u32 = wgpu::QUERY_SET_MAX_QUERIES;

/// The clock of one device.
pub(super) struct StampClock {
    device: wgpu::Device,
    commands: Arc<Commands>,
    /// Nanoseconds of a tick; none if the device has no time stamps.
    tick_ns: Option<f64>,
    sets: RefCell<Vec<wgpu::QuerySet>>,
    used: Cell<u32>,
}

impl StampClock {
    pub(super) fn new(device: wgpu::Device, commands: Arc<Commands>) -> StampClock {
        let tick_ns = device.features().contains(FEATURES).then(|| commands.tick_ns()).filter(|&tick| tick > 0.0);
        StampClock { device, commands, tick_ns, sets: RefCell::default(), used: Cell::new(0) }
    }

    fn ticks(&self) -> Vec<u64> {
        let sets = self.sets.borrow();
        let stamps = self.used.replace(0);
        let mut bytes = vec![0; stamps as usize * wgpu::QUERY_SIZE as usize];
        if stamps == 0 {
            return Vec::new();
        }
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("time stamps"),
            size: bytes.len() as u64,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        self.commands.record(|encoder| {
            for (set, first) in sets.iter().zip((0..stamps).step_by(SET as usize)) {
                let at = u64::from(first) * u64::from(wgpu::QUERY_SIZE);
                encoder.resolve_query_set(set, 0..SET.min(stamps - first), &buffer, at);
            }
        });
        self.commands.read(&mut [ReadPart { buffer: &buffer, offset: 0, out: &mut bytes }]);
        bytes.as_chunks::<8>().0.iter().map(|&ticks| u64::from_ne_bytes(ticks)).collect()
    }
}

impl DeviceClock for StampClock {
    fn mark(&self) -> Option<u32> {
        if self.tick_ns.is_none() {
            self.commands.finish();
            return None;
        }
        let mark = self.used.replace(self.used.get() + 1);
        let mut sets = self.sets.borrow_mut();
        if mark as usize / SET as usize == sets.len() {
            let (ty, label) = (wgpu::QueryType::Timestamp, Some("time stamps"));
            sets.push(self.device.create_query_set(&wgpu::QuerySetDescriptor { label, ty, count: SET }));
        }
        let set = &sets[mark as usize / SET as usize];
        self.commands.record(|encoder| encoder.write_timestamp(set, mark % SET));
        Some(mark)
    }

    fn read(&self, host_ns: &dyn Fn() -> u64) -> Vec<u64> {
        let Some(tick_ns) = self.tick_ns else { return Vec::new() };
        // One more stamp, at a time that the host knows too, ties both clocks together.
        self.commands.finish();
        self.mark();
        let before = host_ns();
        self.commands.finish();
        let now = host_ns().midpoint(before);
        let mut ticks = self.ticks();
        let last = ticks.pop().unwrap_or(0);
        let ago = |&ticks: &u64| (last.saturating_sub(ticks) as f64 * tick_ns) as u64;
        ticks.iter().map(|ticks| now.saturating_sub(ago(ticks))).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use crate::gpu::{DeviceVec, primitives};
    use crate::test_support::device;

    #[test]
    fn stamps_stand_where_the_host_saw_the_work() {
        let Some(executor) = device::executor() else { return };
        let clock = executor.clock().expect("a device has a clock");
        let epoch = Instant::now();
        let host_ns = || epoch.elapsed().as_nanos() as u64;
        let values = DeviceVec::upload(&executor, &vec![1u32; 1 << 20]);
        let mut sums = DeviceVec::zeros(&executor, values.len());
        executor.finish();
        // More stamps than one set holds.
        let (mut marks, mut host) = (Vec::new(), vec![host_ns()]);
        for _ in 0..3 {
            for _ in 0..1500 {
                marks.push(clock.mark());
            }
            primitives::exclusive_scan(&executor, &values, &mut sums);
            executor.finish();
            host.push(host_ns());
        }
        let times = clock.read(&host_ns);
        if marks[0].is_none() {
            assert!(times.is_empty() && marks.iter().all(Option::is_none));
            return;
        }
        assert!(marks.iter().enumerate().all(|(i, mark)| *mark == Some(i as u32)));
        assert_eq!(times.len(), marks.len());
        assert!(times.is_sorted());
        // The stamps of a round lie between the host's looks before and after it, within what a wait may take.
        const SLACK_NS: u64 = 20_000_000;
        for (round, host) in times.chunks(1500).zip(host.windows(2)) {
            assert!(round[0] + SLACK_NS >= host[0] && round[1499] <= host[1] + SLACK_NS, "{:?} {host:?}", round[0]);
        }
        // All stamps are used again.
        assert_eq!(clock.mark(), Some(0));
        assert_eq!(clock.read(&host_ns).len(), 1);
    }
}
