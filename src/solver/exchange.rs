//! Exchange between ranks inside a step: halo rows of a vector, or whole sub-vectors. Both follow the order of the work
//! queue: stage by stage, at most one sub-vector received per stage [Li et al. 2020, Sec. 3.1.2]. On one host a rank
//! writes its message once and every reader reads it in place. Forwarding therefore costs nothing, and the source in a
//! queue entry only names the modeled route.

use std::ops::Range;

use super::gather::Gather;
use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::partition::HaloPlan;
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Message, Neighbor, Pattern, Rows, Transport, TransportError};

/// Exchange mode of SpMV: which columns of other ranks a rank receives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ExchangeMode {
    /// Only the rows that are read.
    #[default]
    Halo,
    /// Whole sub-vectors, as in [Li et al. 2020, Sec. 3.1].
    Full,
}

/// Bytes and messages that the own rank received, counted where they are read.
#[derive(Clone, Copy, Debug, Default)]
pub struct TrafficCounter {
    /// Bytes of vectors.
    pub received_bytes: u64,
    /// Number of messages.
    pub messages: u64,
}

/// Exchanges halo rows of local vectors.
pub struct HaloExchange {
    plan: HaloPlan,
    pattern: Pattern,
    queue: Vec<QueueNode>,
    gather: Gather,
    staging: Vec<f32>,
}

impl HaloExchange {
    /// An exchange along `plan` in the order of `queue` (the own rank's work queue).
    pub fn new(plan: HaloPlan, queue: Vec<QueueNode>) -> HaloExchange {
        HaloExchange { pattern: pattern_of(&plan), plan, queue, gather: Gather::default(), staging: Vec::new() }
    }

    /// The plan.
    pub fn plan(&self) -> &HaloPlan {
        &self.plan
    }

    /// The transport pattern: which rank reads which rank's message.
    pub fn pattern(&self) -> &Pattern {
        &self.pattern
    }

    /// Uses another plan from now on. All ranks must change at the same point.
    pub fn set_plan(&mut self, plan: HaloPlan) {
        if self.plan.publish_rows != plan.publish_rows {
            self.gather = Gather::default();
        }
        self.pattern = pattern_of(&plan);
        self.plan = plan;
    }

    /// Publishes the own rows that other ranks read. `vectors`: local vectors with 3 values per row; the message
    /// interleaves their rows.
    ///
    /// Messages: one per reader, at most 12 B per vector for each of its rows; in shared memory one, written once.
    pub fn start(
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
        transport.start(&self.pattern, width, &mut |out| {
            gather.apply(executor, &plan.publish_rows, plan.own.start, vectors, out);
        })?;
        // Publishes even if no rank reads it, because every rank records the beginning of every exchange.
        recorder.end(EventName::Publish, Activity::Transfer, start, len as u64 * 4, 0);
        Ok(())
    }

    /// Receives the halo rows of the ranks that own some into `vectors`, in the order of the work queue.
    pub fn finish(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        vectors: &mut [&mut DeviceVec<f32>],
        recorder: &mut Recorder,
        traffic: &mut TrafficCounter,
    ) -> Result<(), TransportError> {
        for (stage, node) in self.queue.iter().enumerate() {
            let source = &self.plan.sources[node.vector];
            if source.rows() == 0 {
                continue;
            }
            let start = recorder.now();
            let route = (stage as u32 + 1, node.source as u32, node.vector as u32);
            if !transport.ready(node.vector) {
                transport.wait(node.vector)?;
                recorder.end_transfer(EventName::Receive, Activity::Wait, start, route, 0, 0);
            }
            let (mut bytes, start) = (0, recorder.now());
            let staging = &mut self.staging;
            transport.finish(node.vector, &mut |message| {
                bytes = message.bytes();
                let mut first = 0;
                for (positions, local_start) in source.runs() {
                    let rows = first..first + positions.len();
                    place_rows(executor, message, rows.clone(), local_start as usize * 3, vectors, staging);
                    first = rows.end;
                }
            })?;
            traffic.received_bytes += bytes;
            traffic.messages += 1;
            recorder.end_transfer(EventName::Receive, Activity::Transfer, start, route, bytes, 0);
        }
        Ok(())
    }
}

/// The rows of `plan`: always those of both runs, in this order.
fn pattern_of(plan: &HaloPlan) -> Pattern {
    let own_rows = plan.publish_rows.len();
    let readers = plan.readers.iter().enumerate().map(|(rank, positions)| Neighbor {
        rank,
        message_rows: own_rows,
        rows: Rows::At(positions.clone()),
    });
    let sources = plan.sources.iter().enumerate().map(|(rank, source)| Neighbor {
        rank,
        message_rows: source.published_rows as usize,
        rows: Rows::At(source.positions()),
    });
    Pattern::new(own_rows, readers.collect(), sources.collect())
}

/// Copies `rows` of a message's rows, where the rows of all `vectors` are interleaved, to each vector, from value
/// `first` on. The cpu executor writes in place; a device gets one write per vector.
fn place_rows(
    executor: &Executor,
    message: &Message<'_>,
    rows: Range<usize>,
    first: usize,
    vectors: &mut [&mut DeviceVec<f32>],
    staging: &mut Vec<f32>,
) {
    for (plane, vector) in vectors.iter_mut().enumerate() {
        let copy = |out: &mut [f32]| {
            for (row, to) in rows.clone().zip(out.as_chunks_mut::<3>().0) {
                to.copy_from_slice(&message.row(row)[plane * 3..plane * 3 + 3]);
            }
        };
        match executor {
            Executor::Cpu(_) => copy(&mut vector.as_mut_slice()[first..first + rows.len() * 3]),
            Executor::Gpu(_) if rows.is_empty() => {}
            Executor::Gpu(_) => {
                staging.clear();
                staging.resize(rows.len() * 3, 0.0);
                copy(staging);
                vector.write_range(executor, first, staging);
            }
        }
    }
}
