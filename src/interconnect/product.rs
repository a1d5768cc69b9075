//! Modeled time of one matrix-vector product on n ranks: the timelines of [Li et al. 2020, Fig. 3], and the same for
//! halo rows. Kernels of a rank follow one another on its device; transfers run beside them.
//!
//! With T_j the time of the j-th receipt and C_j that of its block, all-gather first gives Eq. 6, S = sum T + sum C, and
//! the pipelined product Eq. 7, S_j = max(S_{j-1}, sum T) + C_j, of which Eqs. 8 and 9 are the limits of free transfers and
//! of free kernels.

use super::clock::{Circle, Program, Work};
use super::topology::Topology;
use super::transfers::TransferPlan;

/// Seconds of the kernels of one product.
#[derive(Clone, Debug, PartialEq)]
pub enum ProductKernels {
    /// `[rank]`: the whole row block at once.
    Whole(Vec<f64>),
    /// `[rank][vector]`: block A_rank,vector.
    Blocks(Vec<Vec<f64>>),
    /// `[rank]`: rows that need no halo, then those that do.
    Halo(Vec<(f64, f64)>),
}

/// Adds one product to a program: receipts along `transfers` once `published[rank]` is done, kernels after `ready[rank]`
/// and the receipts that they need. Returns the task that ends it on every rank. Blocks are multiplied in the order of
/// `order[rank]` (sub-vectors, as the work queue names them), as the worker does.
pub fn add_product(
    program: &mut Program,
    transfers: &TransferPlan,
    kernels: &ProductKernels,
    order: &[Vec<usize>],
    published: &[usize],
) -> Vec<usize> {
    let receipts = transfers.add_to(program, Some(published));
    let ranks = published.len();
    let mut last = Vec::with_capacity(ranks);
    for rank in 0..ranks {
        let ready = published[rank];
        let end = match kernels {
            ProductKernels::Whole(seconds) => {
                let all = program.add_after(Work::Seconds(seconds[rank]), &receipts[rank]);
                program.after(all, ready, super::Milestone::Done);
                all
            }
            ProductKernels::Halo(seconds) => {
                let (local_s, remote_s) = seconds[rank];
                let local = program.add_after(Work::Seconds(local_s), &[ready]);
                let remote = program.add_after(Work::Seconds(remote_s), &receipts[rank]);
                program.after(remote, local, super::Milestone::Done);
                remote
            }
            ProductKernels::Blocks(seconds) => {
                let mut end = program.add_after(Work::Seconds(seconds[rank][rank]), &[ready]);
                for &vector in &order[rank] {
                    let block = program.add_after(Work::Seconds(seconds[rank][vector]), &[end]);
                    for (transfer, &task) in transfers.queues[rank].iter().zip(&receipts[rank]) {
                        if transfer.owner == vector {
                            program.after(block, task, super::Milestone::Done);
                        }
                    }
                    end = block;
                }
                end
            }
        };
        last.push(end);
    }
    last
}

/// Modeled time of one product, from the moment at which all ranks have their sub-vector to the end of the slowest.
pub fn product_s(
    topology: &Topology,
    transfers: &TransferPlan,
    kernels: &ProductKernels,
    order: &[Vec<usize>],
) -> Result<f64, Circle> {
    let mut program = Program::default();
    let published: Vec<usize> = (0..topology.gpus()).map(|_| program.add(Work::Seconds(0.0))).collect();
    let ends = add_product(&mut program, transfers, kernels, order, &published);
    let spans = program.run(topology)?;
    Ok(ends.iter().map(|&end| spans[end].done_s).fold(0.0, f64::max))
}
