//! Recorded steps on another machine: every kernel lasts as long as the machine's device needs for its bytes and flops,
//! every transfer goes over the machine's links in the order of a schedule, and what waits for what is what the worker
//! does. Everything that comes out is modeled.
//!
//! As in the worker: a rank packs the rows that others read (a kernel), receipts run in the order of the work queue beside
//! its kernels; `halo` multiplies rows without halo, then, when all receipts are in, the others; `full` multiplies block
//! after block in the order of the queue; a reduction ends for all when the last rank has reached it and its numbers have
//! traveled the longest path. A step begins on all ranks together, because the coordinator waits for each.

use std::rc::Rc;

use super::clock::{Circle, Milestone, Program, TaskTimes, Work};
use super::cost::{REDUCTION_BYTES, all_reduce_on};
use super::network::Channels;
use super::product::{ProductKernels, add_product};
use super::queues::Plan;
use super::recorded::{Kernel, Phase, RecordedProduct, RecordedStep, Traffic};
use super::topology::Topology;
use super::transfers::TransferPlan;
use crate::telemetry::EventName;

/// Stages of a step, in order.
pub const STAGES: [&str; 6] = ["exchange", "elements", "fill", "solve", "advance", "collisions"];

/// Bytes of a row of a vector.
const ROW_BYTES: f64 = 12.0;
/// Where no block was recorded: three 3x3 blocks (36 B and a column of 4 B each) per halo row, as in a regular mesh.
const BLOCK_BYTES_PER_HALO_ROW: f64 = 3.0 * 40.0;
/// Floating point operations of these blocks.
const BLOCK_FLOPS_PER_HALO_ROW: f64 = 3.0 * 18.0;

/// Way in which products exchange vectors in the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProductExchange {
    /// Rows that are read.
    Halo,
    /// Whole sub-vectors, block by block [Li et al. 2020, Sec. 3.1].
    Full,
    /// Whole sub-vectors, all of them before the first kernel [Cevahir et al. 2009].
    GatherFirst,
}

/// Source of kernel times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KernelTimes {
    /// The topology's device model, from bytes and flops.
    Device,
    /// The times measured where the run was recorded.
    Recorded,
}

/// The machine and the way of exchanging that steps are re-timed for.
#[derive(Clone, Debug)]
pub struct Replay<'a> {
    /// As many GPUs as the run has ranks.
    pub topology: &'a Topology,
    /// Work queues of whole sub-vectors.
    pub plan: &'a Plan,
    /// What a matrix-vector product exchanges.
    pub exchange: ProductExchange,
    /// Where kernel times come from.
    pub kernels: KernelTimes,
    /// Rows of the whole vector.
    pub rows: usize,
}

/// One task of a replayed step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReplaySpan {
    /// Rank that computes or receives.
    pub rank: usize,
    /// Subject of the task.
    pub name: EventName,
    /// (sender, owner) of a transfer.
    pub from: Option<(usize, usize)>,
    /// Lane of a transfer.
    pub lane: usize,
    /// Times of the task, seconds from the start of the step.
    pub span: TaskTimes,
    /// Bytes moved by a kernel or a transfer.
    pub bytes: f64,
}

/// A step on the machine. All times are modeled.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplayedStep {
    /// Number of the step.
    pub step: u32,
    /// Length of the step, seconds.
    pub total_s: f64,
    /// Time of each of the [`STAGES`], seconds.
    pub stage_s: [f64; STAGES.len()],
    /// Per rank: time of its kernels, seconds.
    pub busy_s: Vec<f64>,
    /// Per link and direction (half-duplex links use the first): time that its bytes need at full speed.
    pub link_s: Vec<[f64; 2]>,
    /// The same kernels, added up over the ranks, on one device without exchange.
    pub one_gpu_s: f64,
    /// All tasks, if asked for.
    pub spans: Vec<ReplaySpan>,
}

/// Re-times a step; `keep_spans`: also return its tasks.
pub fn replay(step: &RecordedStep, how: &Replay<'_>, keep_spans: bool) -> Result<ReplayedStep, Circle> {
    let mut builder = Builder::new(how);
    step.phases.iter().for_each(|phase| builder.add(phase));
    builder.finish(step.step, keep_spans)
}

/// What a task is, beside its number.
#[derive(Clone, Copy)]
struct Tag {
    task: usize,
    rank: usize,
    name: EventName,
    from: Option<(usize, usize)>,
    lane: usize,
    bytes: f64,
}

struct Builder<'a> {
    how: &'a Replay<'a>,
    channels: Channels,
    program: Program,
    /// Last task of every rank's device.
    last: Vec<usize>,
    tags: Vec<Tag>,
    /// (stage, tasks that end the phase).
    ends: Vec<(usize, Vec<usize>)>,
    busy_s: Vec<f64>,
    link_s: Vec<[f64; 2]>,
    one_gpu_s: f64,
    /// Transfers of the last two kinds of exchange: positions with velocities, and vectors of the solve.
    plans: Vec<(Traffic, Rc<TransferPlan>)>,
    whole: Rc<TransferPlan>,
    /// Halo of products where only the exchange of states was recorded.
    state: Option<Traffic>,
}

impl<'a> Builder<'a> {
    fn new(how: &'a Replay<'a>) -> Builder<'a> {
        let ranks = how.topology.gpus();
        let mut program = Program::default();
        let last = (0..ranks).map(|_| program.add(Work::Seconds(0.0))).collect();
        let sub_vector_bytes = how.rows.div_ceil(ranks) as f64 * ROW_BYTES;
        Builder {
            how,
            channels: Channels::of(how.topology),
            program,
            last,
            tags: Vec::new(),
            ends: Vec::new(),
            busy_s: vec![0.0; ranks],
            link_s: vec![[0.0; 2]; how.topology.links().len()],
            one_gpu_s: 0.0,
            plans: Vec::new(),
            whole: Rc::new(how.plan.transfers(sub_vector_bytes)),
            state: None,
        }
    }

    fn seconds(&self, kernel: Kernel) -> f64 {
        match self.how.kernels {
            KernelTimes::Recorded => kernel.measured_s,
            KernelTimes::Device if kernel.bytes > 0.0 || kernel.flops > 0.0 => {
                self.how.topology.device().kernel_s(kernel.bytes, kernel.flops)
            }
            KernelTimes::Device => 0.0,
        }
    }

    fn add(&mut self, phase: &Phase) {
        let stage = stage_of(phase);
        match phase {
            Phase::Kernels(name, kernels) => {
                let all = kernels.iter().fold(Kernel::default(), |sum, kernel| sum.plus(*kernel));
                self.one_gpu_s += self.seconds(all);
                for (rank, kernel) in kernels.iter().enumerate() {
                    self.kernel(rank, *name, *kernel);
                }
            }
            Phase::Exchange(traffic) => {
                self.state.get_or_insert_with(|| traffic.clone());
                let published = self.publish(&traffic.published);
                let plan = self.halo_plan(traffic);
                self.exchange(&plan, &published);
            }
            Phase::Product(traffic, product) => self.product(traffic, product),
            Phase::AllReduce(_) | Phase::ShareCounts => self.all_reduce(),
            // As whole sub-vectors travel; what is told is contiguous, nothing to pack.
            Phase::Share(bytes) => {
                let plan = self.whole.scaled(|owner| bytes[owner] / self.sub_vector_bytes());
                let published = self.last.clone();
                self.exchange(&plan, &published);
            }
        }
        self.ends.push((stage, self.last.clone()));
    }

    /// Transfers that begin when the ranks' tasks `published` are done; the ranks go on when they have everything.
    fn exchange(&mut self, plan: &TransferPlan, published: &[usize]) {
        let receipts = plan.add_to(&mut self.program, Some(published));
        self.tag_receipts(plan, &receipts);
        for (rank, receipts) in receipts.iter().enumerate() {
            let end = self.program.add_after(Work::Seconds(0.0), receipts);
            self.program.after(end, published[rank], Milestone::Done);
            self.last[rank] = end;
        }
    }

    /// Bytes of the largest sub-vector.
    fn sub_vector_bytes(&self) -> f64 {
        self.how.rows.div_ceil(self.last.len()) as f64 * ROW_BYTES
    }

    fn kernel(&mut self, rank: usize, name: EventName, kernel: Kernel) {
        let seconds = self.seconds(kernel);
        let task = self.program.add_after(Work::Seconds(seconds), &[self.last[rank]]);
        self.busy_s[rank] += seconds;
        self.tags.push(Tag { task, rank, name, from: None, lane: 0, bytes: kernel.bytes });
        self.last[rank] = task;
    }

    /// Packs what others read: reads and writes it once.
    fn publish(&mut self, bytes: &[f64]) -> Vec<usize> {
        if self.last.len() > 1 && self.how.kernels == KernelTimes::Device {
            for (rank, bytes) in bytes.iter().enumerate().filter(|(_, bytes)| **bytes > 0.0) {
                self.kernel(rank, EventName::Publish, Kernel { bytes: 2.0 * bytes, ..Kernel::default() });
            }
        }
        self.last.clone()
    }

    fn all_reduce(&mut self) {
        let ranks = self.last.len();
        if ranks == 1 {
            return;
        }
        let seconds = all_reduce_on(&self.channels, ranks);
        let all = self.program.add_after(Work::Seconds(seconds), &self.last);
        for rank in 0..ranks {
            self.tags.push(Tag {
                task: all,
                rank,
                name: EventName::AllReduce,
                from: None,
                lane: 0,
                bytes: REDUCTION_BYTES,
            });
        }
        self.last.fill(all);
    }

    fn halo_plan(&mut self, traffic: &Traffic) -> Rc<TransferPlan> {
        if let Some((_, plan)) = self.plans.iter().find(|(known, _)| known == traffic) {
            return Rc::clone(plan);
        }
        let made = traffic.transfers(self.how.topology, self.how.plan);
        let made = Rc::new(made);
        self.plans.push((traffic.clone(), Rc::clone(&made)));
        made
    }

    fn product(&mut self, traffic: &Traffic, recorded: &RecordedProduct) {
        let ranks = self.last.len();
        let halo = self.product_halo(traffic, recorded);
        let all: Vec<Kernel> = match recorded {
            RecordedProduct::Halo(halves) => halves.iter().map(|(local, remote)| local.plus(*remote)).collect(),
            RecordedProduct::Full(blocks) => {
                blocks.iter().map(|row| row.iter().fold(Kernel::default(), |sum, block| sum.plus(*block))).collect()
            }
        };
        self.one_gpu_s += self.seconds(all.iter().fold(Kernel::default(), |sum, kernel| sum.plus(*kernel)));
        let (plan, kernels) = match self.how.exchange {
            ProductExchange::Halo => {
                let halves: Vec<(Kernel, Kernel)> = match recorded {
                    RecordedProduct::Halo(halves) => halves.clone(),
                    RecordedProduct::Full(_) => (0..ranks)
                        .map(|rank| {
                            let own_rows = (self.how.rows as f64 / ranks as f64).max(1.0);
                            let share = (halo.published[rank] / ROW_BYTES / own_rows).min(1.0);
                            (all[rank].times(1.0 - share), all[rank].times(share))
                        })
                        .collect(),
                };
                let seconds = |(local, remote): &(Kernel, Kernel)| (self.seconds(*local), self.seconds(*remote));
                let seconds = halves.iter().map(seconds).collect();
                (self.halo_plan(&halo), ProductKernels::Halo(seconds))
            }
            ProductExchange::Full => {
                let seconds = |row: &Vec<Kernel>| row.iter().map(|block| self.seconds(*block)).collect();
                let blocks = blocks_of(recorded, &halo, &all);
                (Rc::clone(&self.whole), ProductKernels::Blocks(blocks.iter().map(seconds).collect()))
            }
            ProductExchange::GatherFirst => {
                let seconds = all.iter().map(|kernel| self.seconds(*kernel)).collect();
                (Rc::clone(&self.whole), ProductKernels::Whole(seconds))
            }
        };
        let published = match self.how.exchange {
            ProductExchange::Halo => self.publish(&halo.published),
            // A sub-vector is contiguous: nothing to pack.
            _ => self.last.clone(),
        };
        let first = self.program.len();
        let vectors = |queue: &Vec<super::QueueNode>| queue.iter().map(|node| node.vector).collect();
        let order: Vec<Vec<usize>> = self.how.plan.schedule.queues.iter().map(vectors).collect();
        self.last = add_product(&mut self.program, &plan, &kernels, &order, &published);
        self.tag_product(first, &plan, &kernels, &order);
    }

    /// Halo traffic of a product: as recorded, or half of the first exchange of states (24 B rows).
    fn product_halo(&self, traffic: &Traffic, recorded: &RecordedProduct) -> Traffic {
        match (recorded, &self.state) {
            (RecordedProduct::Full(_), Some(state)) => Traffic {
                published: state.published.iter().map(|bytes| bytes / 2.0).collect(),
                received: state.received.iter().map(|row| row.iter().map(|bytes| bytes / 2.0).collect()).collect(),
            },
            _ => traffic.clone(),
        }
    }

    /// Names the tasks that `add_product` has added from `first` on: receipts queue by queue, then kernels rank by rank.
    fn tag_product(&mut self, first: usize, plan: &TransferPlan, kernels: &ProductKernels, order: &[Vec<usize>]) {
        let mut next = first;
        let receipts: Vec<Vec<usize>> = plan
            .queues
            .iter()
            .map(|queue| {
                let tasks = (next..next + queue.len()).collect();
                next += queue.len();
                tasks
            })
            .collect();
        self.tag_receipts(plan, &receipts);
        for rank in 0..self.last.len() {
            let names: Vec<(EventName, Option<usize>, f64)> = match kernels {
                ProductKernels::Whole(seconds) => vec![(EventName::SpmvRemote, None, seconds[rank])],
                ProductKernels::Halo(seconds) => {
                    vec![(EventName::SpmvLocal, None, seconds[rank].0), (EventName::SpmvRemote, None, seconds[rank].1)]
                }
                ProductKernels::Blocks(seconds) => std::iter::once(&rank)
                    .chain(&order[rank])
                    .map(|&vector| (EventName::SpmvBlock, Some(vector), seconds[rank][vector]))
                    .collect(),
            };
            for (name, vector, seconds) in names {
                self.busy_s[rank] += seconds;
                let from = vector.map(|vector| (vector, vector));
                self.tags.push(Tag { task: next, rank, name, from, lane: 0, bytes: 0.0 });
                next += 1;
            }
        }
    }

    fn tag_receipts(&mut self, plan: &TransferPlan, receipts: &[Vec<usize>]) {
        for (rank, (queue, tasks)) in plan.queues.iter().zip(receipts).enumerate() {
            for (transfer, &task) in queue.iter().zip(tasks) {
                for &channel in self.channels.path(transfer.source, rank) {
                    let seconds = transfer.bytes / self.channels.capacity[channel as usize];
                    self.link_s[channel as usize / 2][channel as usize % 2] += seconds;
                }
                let from = Some((transfer.source, transfer.owner));
                let (name, lane, bytes) = (EventName::Receive, transfer.lane, transfer.bytes);
                self.tags.push(Tag { task, rank, name, from, lane, bytes });
            }
        }
    }

    fn finish(self, step: u32, keep_spans: bool) -> Result<ReplayedStep, Circle> {
        let spans = self.program.run_on(&self.channels)?;
        let (mut stage_s, mut now_s) = ([0.0; STAGES.len()], 0.0f64);
        for (stage, ends) in &self.ends {
            let end_s = ends.iter().map(|&task| spans[task].done_s).fold(now_s, f64::max);
            stage_s[*stage] += end_s - now_s;
            now_s = end_s;
        }
        let kept = |tag: &Tag| {
            let Tag { task, rank, name, from, lane, bytes } = *tag;
            ReplaySpan { rank, name, from, lane, span: spans[task], bytes }
        };
        Ok(ReplayedStep {
            step,
            total_s: now_s,
            stage_s,
            busy_s: self.busy_s,
            link_s: self.link_s,
            one_gpu_s: self.one_gpu_s,
            spans: if keep_spans { self.tags.iter().map(kept).collect() } else { Vec::new() },
        })
    }
}

/// Blocks as recorded, or estimated from the halo rows.
fn blocks_of(recorded: &RecordedProduct, halo: &Traffic, all: &[Kernel]) -> Vec<Vec<Kernel>> {
    if let RecordedProduct::Full(blocks) = recorded {
        return blocks.clone();
    }
    let ranks = all.len();
    let row = |rank: usize| {
        let mut row: Vec<Kernel> = (0..ranks)
            .map(|vector| {
                let rows = halo.received[vector][rank] / ROW_BYTES;
                let share = (rows * BLOCK_BYTES_PER_HALO_ROW / all[rank].bytes.max(1.0)).min(1.0 / ranks as f64);
                let flops = rows * BLOCK_FLOPS_PER_HALO_ROW;
                Kernel { flops: flops.min(all[rank].flops), ..all[rank].times(share) }
            })
            .collect();
        let others = row.iter().enumerate().filter(|(vector, _)| *vector != rank);
        let moved = others.fold(Kernel::default(), |sum, (_, block)| sum.plus(*block));
        row[rank] = Kernel {
            bytes: all[rank].bytes - moved.bytes,
            flops: (all[rank].flops - moved.flops).max(0.0),
            measured_s: all[rank].measured_s - moved.measured_s,
        };
        row
    };
    (0..ranks).map(row).collect()
}

/// The place of a phase in [`STAGES`].
fn stage_of(phase: &Phase) -> usize {
    match phase {
        Phase::Exchange(_) => 0,
        Phase::Kernels(EventName::Elements, _) => 1,
        Phase::Kernels(EventName::IndexFill | EventName::ValueFill | EventName::Precondition, _) => 2,
        Phase::Kernels(EventName::VectorUpdate | EventName::Residual, _) | Phase::Product(..) | Phase::AllReduce(_) => {
            3
        }
        Phase::Kernels(EventName::Advance, _) => 4,
        Phase::Kernels(..) | Phase::Share(_) | Phase::ShareCounts => 5,
    }
}
