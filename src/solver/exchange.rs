//! What crosses between ranks inside a step: halo rows of a vector, or whole sub-vectors. Both travel in the order of the
//! work queue: stage by stage, one sub-vector received per stage [Li et al. 2020, Sec. 3.1.2]. On one host a rank publishes
//! once and every reader reads in place, so forwarding costs nothing and the node's source only names the modelled route.

use super::gather::Gather;
use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::partition::HaloPlan;
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Transport, TransportError};

/// How SpMV gets the columns of other ranks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExchangeMode {
    /// Only the rows that are read.
    Halo,
    /// Whole sub-vectors, the paper's way [Li et al. 2020, Sec. 3.1].
    Full,
}

/// Bytes that the own rank received, counted where they are read.
#[derive(Clone, Copy, Debug, Default)]
pub struct TrafficCounter {
    /// Vector bytes received.
    pub received_bytes: u64,
    /// Messages received.
    pub messages: u64,
}

/// Exchanges halo rows of local vectors.
pub struct HaloExchange {
    plan: HaloPlan,
    queue: Vec<QueueNode>,
    gather: Gather,
    staging: Vec<f32>,
}

impl HaloExchange {
    /// An exchange along `plan` in the order of `queue` (the own rank's work queue).
    pub fn new(plan: HaloPlan, queue: Vec<QueueNode>) -> HaloExchange {
        HaloExchange { plan, queue, gather: Gather::default(), staging: Vec::new() }
    }

    /// The plan.
    pub fn plan(&self) -> &HaloPlan {
        &self.plan
    }

    /// Exchanges along another plan from now on (on all ranks at once).
    pub fn set_plan(&mut self, plan: HaloPlan) {
        if self.plan.publish_rows != plan.publish_rows {
            self.gather = Gather::default();
        }
        self.plan = plan;
    }

    /// Publishes the own rows that others read. `vectors`: local vectors with 3 values per row; their rows are interleaved in
    /// the message.
    pub fn publish(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        vectors: &[&DeviceVec<f32>],
        recorder: &mut Recorder,
    ) -> Result<(), TransportError> {
        if transport.ranks() == 1 {
            return Ok(());
        }
        let start = recorder.now();
        let (plan, width) = (&self.plan, 3 * vectors.len());
        let len = plan.publish_rows.len() * width;
        let gather = &mut self.gather;
        transport.publish(len, &mut |out| gather.apply(executor, &plan.publish_rows, plan.own.start, vectors, out))?;
        recorder.end(EventName::Publish, Activity::Transfer, start, len as u64 * 4, 0);
        Ok(())
    }

    /// Receives the halo rows of all other ranks into `vectors`, in the order of the work queue.
    pub fn receive(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        vectors: &mut [&mut DeviceVec<f32>],
        recorder: &mut Recorder,
        traffic: &mut TrafficCounter,
    ) -> Result<(), TransportError> {
        let width = 3 * vectors.len();
        let rank = self.plan.rank;
        for (stage, node) in self.queue.iter().enumerate() {
            let source = &self.plan.sources[node.vector];
            let start = recorder.now();
            let route = (stage as u32 + 1, node.source as u32, node.vector as u32);
            let rows = source.rows();
            let bytes = (rows * width * 4) as u64;
            transport.expect_halo(node.vector, bytes);
            if !transport.ready(node.vector) {
                transport.wait(node.vector)?;
                recorder.end_transfer(EventName::Receive, Activity::Wait, start, route, 0, 0);
            }
            let start = recorder.now();
            let staging = &mut self.staging;
            let mut short = None;
            transport.receive(node.vector, &mut |message| {
                let last = source.runs().iter().filter_map(|(positions, _)| positions.last().copied()).max();
                if last.is_some_and(|last| (last as usize + 1) * width > message.len()) {
                    short = Some(message.len());
                    return;
                }
                for (positions, local_start) in source.runs() {
                    place_rows(executor, message, positions, local_start as usize * 3, vectors, staging);
                }
            })?;
            if let Some(got) = short {
                let message =
                    format!("message of rank {} holds {got} values, fewer than the halo plan needs", node.vector);
                return Err(TransportError::Mechanism { rank, message });
            }
            traffic.received_bytes += bytes;
            traffic.messages += 1;
            recorder.end_transfer(EventName::Receive, Activity::Transfer, start, route, bytes, 0);
        }
        Ok(())
    }
}

/// Copies the rows at `positions` of a message, where the rows of all `vectors` are interleaved, to values `first..` of each.
/// The cpu executor writes them straight into place; a device gets one write per vector.
fn place_rows(
    executor: &Executor,
    message: &[f32],
    positions: &[u32],
    first: usize,
    vectors: &mut [&mut DeviceVec<f32>],
    staging: &mut Vec<f32>,
) {
    let width = 3 * vectors.len();
    for (plane, vector) in vectors.iter_mut().enumerate() {
        let copy = |out: &mut [f32]| {
            for (&position, to) in positions.iter().zip(out.as_chunks_mut::<3>().0) {
                let at = position as usize * width + plane * 3;
                to.copy_from_slice(&message[at..at + 3]);
            }
        };
        match executor {
            Executor::Cpu(_) => copy(&mut vector.as_mut_slice()[first..first + positions.len() * 3]),
            Executor::Gpu(_) if positions.is_empty() => {}
            Executor::Gpu(_) => {
                staging.clear();
                staging.resize(positions.len() * 3, 0.0);
                copy(staging);
                vector.write_range(executor, first, staging);
            }
        }
    }
}
