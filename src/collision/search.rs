//! Chooses where a query is searched: in native code, or on a device with the rest of the narrow phase on host threads.

use std::sync::{Arc, Mutex};

use super::Candidate;
use super::broad::{Broad, BroadError, BroadStats, DeviceBroad, Search, Sink, Split};
use crate::gpu::{CpuExecutor, Executor};

/// Candidates per unit of work of the host's threads, and at most handed over at once.
const GRAIN: usize = 1024;

/// The threads and the device that run a query.
#[derive(Clone, Copy)]
pub struct RunsOn<'a> {
    /// Threads of native code.
    pub host: &'a CpuExecutor,
    /// Runs the broad phase and the first part of the narrow phase. None: native code runs them. A detector must always
    /// be given the same executor, because its arrays stay there.
    pub kernels: Option<&'a Executor>,
}

impl<'a> RunsOn<'a> {
    /// A device and the host's threads, or threads alone for a native executor, because the native search is faster
    /// than the twins of the kernels.
    pub fn new(executor: &'a Executor, host: &'a CpuExecutor) -> RunsOn<'a> {
        RunsOn { host, kernels: Some(executor).filter(|executor| executor.native().is_none()) }
    }
}

impl<'a> From<&'a CpuExecutor> for RunsOn<'a> {
    fn from(host: &'a CpuExecutor) -> RunsOn<'a> {
        RunsOn { host, kernels: None }
    }
}

/// Both ways to search one mesh.
pub(super) struct Searches {
    pub native: Broad,
    /// Made by the first query that runs on a device.
    device: Option<DeviceBroad>,
}

impl Searches {
    pub(super) fn new(native: Broad) -> Searches {
        Searches { native, device: None }
    }

    /// Bytes of what follows from the mesh alone.
    pub(super) fn mesh_bytes(&self) -> u64 {
        self.native.mesh_bytes() + self.device.as_ref().map_or(0, DeviceBroad::mesh_bytes)
    }

    /// As [`Broad::search`]; what the filter drops may be missing. A search among touched vertices is native: it costs
    /// a look at every triangle and the work near a few vertices, less than asking a device. So is one that does not
    /// fit a device, which is the same decision on all ranks.
    pub(super) fn search<S: Sink>(
        &mut self,
        on: RunsOn,
        search: &Search,
        split: &mut Split,
        start: &(dyn Fn() -> S + Sync),
        finish: &mut (dyn FnMut(S) + Send),
    ) -> Result<BroadStats, BroadError> {
        let is_for_device = search.choice.touched.is_none() && DeviceBroad::fits(self.native.mesh());
        if let Some(executor) = on.kernels.filter(|_| is_for_device) {
            let device = self.device.get_or_insert_with(|| DeviceBroad::new(executor, Arc::clone(self.native.mesh())));
            let finish = Mutex::new(&mut *finish);
            let emit = &mut |found: &[Candidate]| {
                on.host.for_ranges(found.len(), GRAIN, |range| {
                    let mut sink = start();
                    found[range].chunks(GRAIN).for_each(|part| sink.take(part));
                    if let Ok(mut finish) = finish.lock() {
                        finish(sink);
                    }
                });
            };
            if let Some(stats) = device.search((executor, on.host), search, split, emit)? {
                return Ok(stats);
            }
        }
        self.native.search(on.host, search, split, start, finish)
    }
}
