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
            if !transport.ready(node.vector) {
                transport.wait(node.vector)?;
                recorder.end_transfer(EventName::Receive, Activity::Wait, start, route, 0, 0);
            }
            let start = recorder.now();
            let rows = source.message_rows.len();
            let staging = &mut self.staging;
            // The cpu executor reads the message straight into place; a device gets one write per vector.
            let mut in_place: Option<Vec<&mut [f32]>> = match executor {
                Executor::Cpu(_) => {
                    let (first, len) = (source.local_start as usize * 3, rows * 3);
                    Some(vectors.iter_mut().map(|v| &mut v.as_mut_slice()[first..first + len]).collect())
                }
                Executor::Gpu(_) => None,
            };
            let mut short = None;
            transport.receive(node.vector, &mut |message| {
                if source.message_rows.last().is_some_and(|&last| (last as usize + 1) * width > message.len()) {
                    short = Some(message.len());
                    return;
                }
                if let Some(vectors) = &mut in_place {
                    for (plane, vector) in vectors.iter_mut().enumerate() {
                        for (&position, to) in source.message_rows.iter().zip(vector.as_chunks_mut::<3>().0) {
                            let at = position as usize * width + plane * 3;
                            to.copy_from_slice(&message[at..at + 3]);
                        }
                    }
                    return;
                }
                staging.clear();
                staging.resize(rows * width, 0.0);
                // One plane per vector, so that each lands with one contiguous write.
                for (i, &position) in source.message_rows.iter().enumerate() {
                    let row = &message[position as usize * width..(position as usize + 1) * width];
                    for (plane, values) in row.chunks_exact(3).enumerate() {
                        staging[(plane * rows + i) * 3..(plane * rows + i + 1) * 3].copy_from_slice(values);
                    }
                }
            })?;
            if let Some(got) = short {
                let message =
                    format!("message of rank {} holds {got} values, fewer than the halo plan needs", node.vector);
                return Err(TransportError::Mechanism { rank, message });
            }
            if rows > 0 && matches!(executor, Executor::Gpu(_)) {
                for (plane, vector) in vectors.iter_mut().enumerate() {
                    vector.write_range(
                        executor,
                        source.local_start as usize * 3,
                        &staging[plane * rows * 3..(plane + 1) * rows * 3],
                    );
                }
            }
            let bytes = (rows * width * 4) as u64;
            traffic.received_bytes += bytes;
            traffic.messages += 1;
            recorder.end_transfer(EventName::Receive, Activity::Transfer, start, route, bytes, 0);
        }
        Ok(())
    }
}
