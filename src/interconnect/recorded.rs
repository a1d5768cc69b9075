//! A recorded step as phases that all ranks go through together: kernels, exchanges, products, reductions. Made from the
//! events of all ranks; what they say about times is kept only as "measured".

use super::packing::Demand;
use super::queues::{Plan, ScheduleKind};
use super::topology::Topology;
use super::transfers::TransferPlan;
use crate::telemetry::{Activity, Event, EventName};

/// A kernel of one rank.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Kernel {
    /// Bytes read and written.
    pub bytes: f64,
    /// Number of floating point operations.
    pub flops: f64,
    /// Measured time where it was recorded, seconds.
    pub measured_s: f64,
}

impl Kernel {
    fn of(event: &Event) -> Kernel {
        Kernel {
            bytes: event.bytes as f64,
            flops: event.flops as f64,
            measured_s: event.end_ns.saturating_sub(event.start_ns) as f64 * 1e-9,
        }
    }

    /// Sum of two kernels.
    pub fn plus(self, other: Kernel) -> Kernel {
        Kernel {
            bytes: self.bytes + other.bytes,
            flops: self.flops + other.flops,
            measured_s: self.measured_s + other.measured_s,
        }
    }

    /// A part of it.
    pub fn times(self, share: f64) -> Kernel {
        Kernel { bytes: self.bytes * share, flops: self.flops * share, measured_s: self.measured_s * share }
    }
}

/// Bytes that ranks send and receive in an exchange.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Traffic {
    /// Bytes that each rank publishes, `[rank]`.
    pub published: Vec<f64>,
    /// Bytes that each reader needs of each owner, `[owner][reader]`.
    pub received: Vec<Vec<f64>>,
}

impl Traffic {
    /// How `plan` moves it: along the work queues, or, with [`ScheduleKind::Best`], the cheapest way that is found.
    pub fn transfers(&self, topology: &Topology, plan: &Plan) -> TransferPlan {
        match plan.kind {
            ScheduleKind::Best => TransferPlan::best_for(topology, &self.demands()).0,
            _ => TransferPlan::halo_of_schedule(&plan.schedule, &self.received, &self.published),
        }
    }

    /// Pairs of ranks: which rows several readers share is not recorded.
    fn demands(&self) -> Vec<Demand> {
        let rows = self.received.iter().enumerate();
        let pairs =
            rows.flat_map(|(owner, row)| row.iter().enumerate().map(move |(reader, bytes)| (owner, reader, *bytes)));
        pairs
            .filter(|(owner, reader, bytes)| owner != reader && *bytes > 0.0)
            .map(|(owner, reader, bytes)| Demand { owner, bytes, readers: vec![reader] })
            .collect()
    }
}

/// The kernels of a product as they were recorded.
#[derive(Clone, Debug, PartialEq)]
pub enum RecordedProduct {
    /// `[rank]`: rows without halo, rows with it.
    Halo(Vec<(Kernel, Kernel)>),
    /// Kernels by blocks A_ij, `[rank][vector]`.
    Full(Vec<Vec<Kernel>>),
}

/// One part of a step that all ranks go through.
#[derive(Clone, Debug, PartialEq)]
pub enum Phase {
    /// Kernels of one name, `[rank]`.
    Kernels(EventName, Vec<Kernel>),
    /// Halo rows of positions and velocities, or whatever travels outside products.
    Exchange(Traffic),
    /// A matrix-vector product with its exchange.
    Product(Traffic, RecordedProduct),
    /// Everybody waits for everybody: bytes of every rank's message.
    AllReduce(Vec<f64>),
    /// Every rank sends data to every other rank, outside of products: bytes of every rank.
    Share(Vec<f64>),
    /// Everybody waits for everybody, outside of the solver.
    ShareCounts,
}

/// One step of all ranks.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedStep {
    /// Number of the step.
    pub step: u32,
    /// Phases of the step in order.
    pub phases: Vec<Phase>,
}

/// Events that do not make a step.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RecordFault {
    /// The ranks did not do the same things in the same order.
    #[error("step {step}: ranks 0 and {rank} recorded different things ({phase}. in order); the trace is incomplete")]
    Unlike {
        /// Number of the step.
        step: u32,
        /// The rank that differs from rank 0.
        rank: usize,
        /// Number of the phase, from 1.
        phase: usize,
    },
    /// A rank that does not exist.
    #[error("step {step}: rank {rank} received from rank {vector}, but there are only {ranks} ranks")]
    NoSuchRank {
        /// Number of the step.
        step: u32,
        /// Rank that receives.
        rank: usize,
        /// The sub-vector that the event names.
        vector: usize,
        /// Number of ranks.
        ranks: usize,
    },
}

/// A phase as one rank saw it.
enum Own {
    Kernel(EventName, Kernel),
    Exchange(Open),
    AllReduce(f64),
    Share(f64),
    ShareCounts,
}

/// An exchange or product under way.
#[derive(Default)]
struct Open {
    published: f64,
    received: Vec<f64>,
    local: Option<Kernel>,
    remote: Option<Kernel>,
    blocks: Option<Vec<Kernel>>,
}

impl Open {
    fn kind(&self) -> u8 {
        match (&self.local, &self.blocks) {
            (None, None) => 0,
            (Some(_), _) => 1,
            (None, Some(_)) => 2,
        }
    }
}

impl RecordedStep {
    /// `events[rank]`: those of one step, in the order in which they began.
    pub fn of_events(step: u32, events: &[Vec<Event>]) -> Result<RecordedStep, RecordFault> {
        let ranks = events.len();
        let mut own = Vec::with_capacity(ranks);
        for (rank, events) in events.iter().enumerate() {
            let lost = |vector| RecordFault::NoSuchRank { step, rank, vector, ranks };
            own.push(phases_of(rank, ranks, events).map_err(lost)?);
        }
        let key = |own: &Own| match own {
            Own::Kernel(name, _) => (0, *name as u32),
            Own::Exchange(open) => (1, u32::from(open.kind())),
            Own::AllReduce(_) => (2, 0),
            Own::Share(_) => (3, 0),
            Own::ShareCounts => (4, 0),
        };
        for rank in 1..ranks {
            let differs =
                (0..own[0].len().max(own[rank].len())).find(|&i| own[0].get(i).map(key) != own[rank].get(i).map(key));
            if let Some(phase) = differs {
                return Err(RecordFault::Unlike { step, rank, phase: phase + 1 });
            }
        }
        let count = own.first().map_or(0, Vec::len);
        let mut rows: Vec<_> = own.into_iter().map(Vec::into_iter).collect();
        let phases = (0..count).map(|_| joined(rows.iter_mut().filter_map(Iterator::next).collect())).collect();
        Ok(RecordedStep { step, phases })
    }
}

/// The phases of one rank; Err: a rank that is not there.
fn phases_of(rank: usize, ranks: usize, events: &[Event]) -> Result<Vec<Own>, usize> {
    let mut phases = Vec::new();
    let mut open: Option<Open> = None;
    let begin = || Open { received: vec![0.0; ranks], ..Open::default() };
    for event in events {
        let Some(name) = EventName::from_number(event.name) else { continue };
        let vector = event.vector as usize;
        let waits = event.activity == Activity::Wait as u32;
        match name {
            // Frames around others, and what only the host asks for.
            EventName::Step | EventName::ExchangeState | EventName::ReadState => {}
            EventName::Publish => {
                phases.extend(open.replace(Open { published: event.bytes as f64, ..begin() }).map(Own::Exchange));
            }
            EventName::Receive if waits => {}
            EventName::Receive => {
                let received = &mut open.get_or_insert_with(begin).received;
                *received.get_mut(vector).ok_or(vector)? += event.bytes as f64;
            }
            EventName::SpmvLocal => {
                if open.as_ref().is_some_and(|open| open.kind() != 0) {
                    phases.extend(open.take().map(Own::Exchange));
                }
                open.get_or_insert_with(begin).local = Some(Kernel::of(event));
            }
            EventName::SpmvRemote => {
                let mut product = open.take().unwrap_or_else(begin);
                product.remote = Some(Kernel::of(event));
                product.local.get_or_insert_default();
                phases.push(Own::Exchange(product));
            }
            EventName::SpmvBlock => {
                if vector == rank && open.as_ref().is_some_and(|open| open.kind() != 0) {
                    phases.extend(open.take().map(Own::Exchange));
                }
                let blocks =
                    open.get_or_insert_with(begin).blocks.get_or_insert_with(|| vec![Kernel::default(); ranks]);
                *blocks.get_mut(vector).ok_or(vector)? = Kernel::of(event);
            }
            // Everybody reads all of what everybody hands over.
            name if name.is_share() && vector != rank => {}
            _ => {
                phases.extend(open.take().map(Own::Exchange));
                phases.push(match name {
                    name if name.is_share() && waits => Own::ShareCounts,
                    name if name.is_share() => Own::Share(event.bytes as f64),
                    EventName::AllReduce => Own::AllReduce(event.bytes as f64),
                    _ => Own::Kernel(name, Kernel::of(event)),
                });
            }
        }
    }
    phases.extend(open.map(Own::Exchange));
    Ok(phases)
}

/// The same phase of all ranks.
fn joined(own: Vec<Own>) -> Phase {
    let (mut kernels, mut opens, mut shared, mut reduced, mut named) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new(), None);
    let counts = own.iter().any(|phase| matches!(phase, Own::ShareCounts));
    for phase in own {
        match phase {
            Own::Kernel(name, kernel) => {
                named = Some(name);
                kernels.push(kernel);
            }
            Own::Exchange(open) => opens.push(open),
            Own::Share(bytes) => shared.push(bytes),
            Own::AllReduce(bytes) => reduced.push(bytes),
            Own::ShareCounts => {}
        }
    }
    if !shared.is_empty() {
        return Phase::Share(shared);
    }
    if counts {
        return Phase::ShareCounts;
    }
    if let Some(name) = named {
        return Phase::Kernels(name, kernels);
    }
    let Some(first) = opens.first() else { return Phase::AllReduce(reduced) };
    let kind = first.kind();
    let ranks = opens.len();
    let traffic = Traffic {
        published: opens.iter().map(|open| open.published).collect(),
        received: (0..ranks).map(|owner| opens.iter().map(|open| open.received[owner]).collect()).collect(),
    };
    let halves = |open: &Open| (open.local.unwrap_or_default(), open.remote.unwrap_or_default());
    match kind {
        0 => Phase::Exchange(traffic),
        1 => Phase::Product(traffic, RecordedProduct::Halo(opens.iter().map(halves).collect())),
        _ => {
            let blocks = opens.into_iter().map(|open| open.blocks.unwrap_or_default()).collect();
            Phase::Product(traffic, RecordedProduct::Full(blocks))
        }
    }
}
