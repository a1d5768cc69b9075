//! Reorders the rows for locality, because files list rows in any order and the chunks of the preconditioner are ranges
//! of consecutive rows.
//!
//! The most strongly coupled rows are merged in pairs, then the pairs, until one cluster is left, as multilevel graph
//! partitioners coarsen [Karypis and Kumar 1998]. The order lists the leaves of that tree. Then rows are exchanged
//! between the two halves of the order, and recursively within each half down to single chunks, where this reduces the
//! coupling between halves [Kernighan and Lin 1970]. The matrix values decide which couplings are strong, so layers in
//! contact end up together.

use super::system::{BlockSystem, Values};
use crate::assembly::sell::BLOCK;
use crate::math::DIM;

/// Passes over the rows of two halves.
const PASSES: usize = 8;
/// A row is tried in the other half if its coupling to its own half exceeds its coupling to the other half by at most
/// this much (1 = a coupling as strong as the diagonal), because an exchange partner can gain more than the row loses.
const LOSS_TRIED: f32 = 0.3;
/// The order of a file counts as local if half of the coupled pairs are less than 1/CLOSE of all rows apart. On a grid
/// of n rows they are about sqrt(n) apart.
const CLOSE: usize = 50;
/// Least gain of an exchange. Without it rounding could move rows back and forth endlessly.
const GAIN_MIN: f32 = 1e-4;

/// Returns `old_from_new`, a permutation of the block rows for chunks of `chunk_rows` rows. It does not depend on the
/// number of ranks. Cost about O(blocks log chunks).
pub fn locality_order(system: &BlockSystem, chunk_rows: usize) -> Vec<u32> {
    let mut finest = Graph::of(system);
    let mut order = merged_order(finest.clone());
    // The square root gives the many weak couplings some weight beside the few strong ones.
    finest.weights.iter_mut().for_each(|weight| *weight = weight.sqrt());
    finest.refine(&mut order, chunk_rows, &mut vec![0; finest.nodes()]);
    if finest.is_local() {
        // The preconditioner sweeps in row order; sweeps along grid rows propagate farther than sweeps along merged
        // pairs.
        order.chunks_mut(chunk_rows).for_each(<[u32]>::sort_unstable);
    }
    order
}

/// The leaves of the merge tree in order.
fn merged_order(mut graph: Graph) -> Vec<u32> {
    let mut levels: Vec<Vec<[u32; 2]>> = Vec::new();
    while graph.nodes() > 1 {
        let pairs = graph.pairs();
        if pairs.len() * 20 > graph.nodes() * 19 {
            break;
        }
        graph = graph.merged(&pairs);
        levels.push(pairs);
    }
    let mut order: Vec<u32> = (0..graph.nodes() as u32).collect();
    for pairs in levels.iter().rev() {
        let children = order.iter().flat_map(|&node| pairs[node as usize]);
        order = children.filter(|&child| child != NONE).collect();
    }
    order
}

/// Fraction of the blocks that couple different chunks of `chunk_rows` rows when the rows are in this order.
pub fn share_between_chunks(system: &BlockSystem, order: &[u32], chunk_rows: usize) -> f64 {
    let mut chunk = vec![0; order.len()];
    order.iter().enumerate().for_each(|(new, &old)| chunk[old as usize] = new / chunk_rows);
    let mut between = 0usize;
    for row in 0..order.len() {
        let columns = &system.columns[system.offsets[row] as usize..system.offsets[row + 1] as usize];
        between += columns.iter().filter(|&&column| chunk[column as usize] != chunk[row]).count();
    }
    between as f64 / system.blocks().max(1) as f64
}

impl BlockSystem {
    /// Permutes rows and columns. Padding rows count as rows of the system afterwards.
    pub fn reordered(&self, order: &[u32]) -> BlockSystem {
        let mut place = vec![0u32; order.len()];
        order.iter().zip(0..).for_each(|(&old, new)| place[old as usize] = new);
        let (mut offsets, mut columns) = (vec![0u32], Vec::with_capacity(self.blocks()));
        let mut blocks = Vec::with_capacity(self.blocks());
        for &old in order {
            let range = self.offsets[old as usize] as usize..self.offsets[old as usize + 1] as usize;
            let mut row: Vec<(u32, usize)> = range.map(|k| (place[self.columns[k] as usize], k)).collect();
            row.sort_unstable();
            columns.extend(row.iter().map(|&(column, _)| column));
            blocks.extend(row.iter().map(|&(_, k)| k));
            offsets.push(columns.len() as u32);
        }
        let values = match &self.values {
            Values::F32(values) => {
                Values::F32(blocks.iter().flat_map(|&k| &values[k * BLOCK..][..BLOCK]).copied().collect())
            }
            Values::F64(values) => {
                Values::F64(blocks.iter().flat_map(|&k| &values[k * BLOCK..][..BLOCK]).copied().collect())
            }
        };
        let scalar_rows = order.len() * DIM;
        BlockSystem { scalar_rows, offsets, columns, values, largest_diagonal: self.largest_diagonal }
    }
}

/// Second entry of a pair that has one node only.
const NONE: u32 = u32::MAX;

/// Couplings between rows, without the diagonal.
#[derive(Clone)]
struct Graph {
    offsets: Vec<u32>,
    columns: Vec<u32>,
    weights: Vec<f32>,
}

impl Graph {
    fn of(system: &BlockSystem) -> Graph {
        let rows = system.block_rows();
        let norm = |k: usize| (0..BLOCK).map(|c| system.values.get(k * BLOCK + c).powi(2)).sum::<f64>().sqrt();
        let mut diagonal = vec![1.0f64; rows];
        for row in 0..rows {
            for k in system.offsets[row] as usize..system.offsets[row + 1] as usize {
                if system.columns[k] as usize == row {
                    diagonal[row] = norm(k).max(f64::MIN_POSITIVE);
                }
            }
        }
        let (mut offsets, mut columns, mut weights) = (vec![0u32], Vec::new(), Vec::new());
        for row in 0..rows {
            for k in system.offsets[row] as usize..system.offsets[row + 1] as usize {
                let column = system.columns[k] as usize;
                if column != row {
                    columns.push(column as u32);
                    weights.push((norm(k) / (diagonal[row].sqrt() * diagonal[column].sqrt())) as f32);
                }
            }
            offsets.push(columns.len() as u32);
        }
        Graph { offsets, columns, weights }
    }

    fn nodes(&self) -> usize {
        self.offsets.len() - 1
    }

    fn of_node(&self, node: usize) -> impl Iterator<Item = (u32, f32)> + '_ {
        let range = self.offsets[node] as usize..self.offsets[node + 1] as usize;
        self.columns[range.clone()].iter().copied().zip(self.weights[range].iter().copied())
    }

    /// True if the order of the file already puts most coupled nodes near each other; see `CLOSE`.
    fn is_local(&self) -> bool {
        let mut distances: Vec<u32> = Vec::with_capacity(self.columns.len());
        for node in 0..self.nodes() {
            distances.extend(self.of_node(node).map(|(column, _)| column.abs_diff(node as u32)));
        }
        let middle = distances.len() / 2;
        distances.len() > 1 && *distances.select_nth_unstable(middle).1 as usize * CLOSE < self.nodes()
    }

    /// Exchanges rows between the two halves of `order` (cut between whole chunks), then recursively within each half
    /// down to chunks, to reduce the coupling between them. `side`: zeros, one per node.
    fn refine(&self, order: &mut [u32], chunk_rows: usize, side: &mut [u8]) {
        let chunks = order.len().div_ceil(chunk_rows);
        if chunks <= 1 {
            return;
        }
        let middle = chunks / 2 * chunk_rows;
        for (at, &node) in order.iter().enumerate() {
            side[node as usize] = if at < middle { 1 } else { 2 };
        }
        for _ in 0..PASSES {
            if self.exchange(order, side) == 0 {
                break;
            }
        }
        let (first, second): (Vec<u32>, Vec<u32>) = order.iter().partition(|&&node| side[node as usize] == 1);
        order[..middle].copy_from_slice(&first);
        order[middle..].copy_from_slice(&second);
        order.iter().for_each(|&node| side[node as usize] = 0);
        let (first, second) = order.split_at_mut(middle);
        self.refine(first, chunk_rows, side);
        self.refine(second, chunk_rows, side);
    }

    /// Exchanges nodes of side 1 with as many nodes of side 2, those of largest gain first. Returns the number of
    /// pairs.
    fn exchange(&self, nodes: &[u32], side: &mut [u8]) -> usize {
        let candidates = |of: u8, side: &[u8]| {
            let own = nodes.iter().filter(|&&node| side[node as usize] == of);
            let mut found: Vec<(f32, u32)> = own.map(|&node| (self.gain(node, side), node)).collect();
            found.retain(|&(gain, _)| gain > -2.0 * LOSS_TRIED);
            found.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            found
        };
        let (first, second) = (candidates(1, side), candidates(2, side));
        let (mut i, mut j, mut pairs) = (0, 0, 0);
        while let (Some(&(_, a)), Some(&(_, b))) = (first.get(i), second.get(j)) {
            // The gains after the exchanges made so far.
            let gain_a = self.gain(a, side);
            if gain_a < -LOSS_TRIED {
                i += 1;
                continue;
            }
            side[a as usize] = 2;
            let gain_b = self.gain(b, side);
            if gain_a + gain_b > GAIN_MIN {
                side[b as usize] = 1;
                (i, j, pairs) = (i + 1, j + 1, pairs + 1);
                continue;
            }
            side[a as usize] = 1;
            if gain_b < gain_a {
                j += 1;
            } else {
                i += 1;
            }
        }
        pairs
    }

    /// Coupling of `node` with the other side minus its coupling with its own side. Nodes on neither side do not count.
    fn gain(&self, node: u32, side: &[u8]) -> f32 {
        let own = side[node as usize];
        self.of_node(node as usize)
            .map(|(column, weight)| match side[column as usize] {
                0 => 0.0,
                other if other == own => -weight,
                _ => weight,
            })
            .sum()
    }

    /// Matches every node with the unmatched neighbor it is coupled to most, if there is one. The pairs are in the
    /// order of their first nodes.
    fn pairs(&self) -> Vec<[u32; 2]> {
        let mut taken = vec![false; self.nodes()];
        let mut pairs = Vec::with_capacity(self.nodes() / 2 + 1);
        for node in 0..self.nodes() {
            if taken[node] {
                continue;
            }
            taken[node] = true;
            let mut best = (NONE, 0.0f32);
            for (column, weight) in self.of_node(node) {
                if !taken[column as usize] && (weight > best.1 || best.0 == NONE) {
                    best = (column, weight);
                }
            }
            if best.0 != NONE {
                taken[best.0 as usize] = true;
            }
            pairs.push([node as u32, best.0]);
        }
        pairs
    }

    /// The graph of the pairs. The weights of all couplings between two pairs are added.
    fn merged(&self, pairs: &[[u32; 2]]) -> Graph {
        let mut coarse = vec![0u32; self.nodes()];
        for (index, pair) in pairs.iter().enumerate() {
            pair.iter().filter(|&&node| node != NONE).for_each(|&node| coarse[node as usize] = index as u32);
        }
        let (mut offsets, mut columns, mut weights) = (vec![0u32], Vec::new(), Vec::new());
        let mut found: Vec<(u32, f32)> = Vec::new();
        for (index, pair) in pairs.iter().enumerate() {
            found.clear();
            for &node in pair.iter().filter(|&&node| node != NONE) {
                found.extend(self.of_node(node as usize).map(|(column, weight)| (coarse[column as usize], weight)));
            }
            found.retain(|&(column, _)| column != index as u32);
            found.sort_by_key(|&(column, _)| column);
            for same in found.chunk_by(|a, b| a.0 == b.0) {
                columns.push(same[0].0);
                weights.push(same.iter().map(|&(_, weight)| weight).sum());
            }
            offsets.push(columns.len() as u32);
        }
        Graph { offsets, columns, weights }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grid whose rows are scattered over the file. `coupling` is the weight between points (i, j) and (a, _).
    fn scattered_grid(n: usize, coupling: impl Fn(usize, usize, usize) -> f32) -> BlockSystem {
        let at = |i: usize, j: usize| (i * n + j) * 7919 % (n * n);
        let mut rows: Vec<Vec<(u32, f32)>> = vec![Vec::new(); n * n];
        for i in 0..n {
            for j in 0..n {
                rows[at(i, j)].push((at(i, j) as u32, 4.0));
                for (a, b) in [(i + 1, j), (i, j + 1)].into_iter().filter(|&(a, b)| a < n && b < n) {
                    rows[at(i, j)].push((at(a, b) as u32, -coupling(i, j, a)));
                    rows[at(a, b)].push((at(i, j) as u32, -coupling(i, j, a)));
                }
            }
        }
        let (mut offsets, mut columns, mut values) = (vec![0u32], Vec::new(), Vec::new());
        for row in &mut rows {
            row.sort_by_key(|entry| entry.0);
            for &(column, v) in row.iter() {
                columns.push(column);
                values.extend([v, 0.0, 0.0, 0.0, v, 0.0, 0.0, 0.0, v]);
            }
            offsets.push(columns.len() as u32);
        }
        let scalar_rows = n * n * 3;
        BlockSystem { scalar_rows, offsets, columns, values: Values::F32(values), largest_diagonal: 4.0 }
    }

    #[test]
    fn neighbors_come_together_and_every_row_comes_once() {
        let system = scattered_grid(40, |_, _, _| 0.9);
        let order = locality_order(&system, 100);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        let natural: Vec<u32> = (0..1600).collect();
        assert_eq!(sorted, natural);
        let (before, after) =
            (share_between_chunks(&system, &natural, 100), share_between_chunks(&system, &order, 100));
        assert!(after * 4.0 < before, "{before} {after}");
    }

    #[test]
    fn changing_places_cuts_less_coupling() {
        let system = scattered_grid(40, |i, j, a| 0.9 - 0.1 * ((i * 7 + j * 5 + a) % 7) as f32);
        let share = |order: &[u32]| share_between_chunks(&system, order, 50);
        let (merged, refined) = (merged_order(Graph::of(&system)), locality_order(&system, 50));
        println!("{} of the blocks between chunks, before {}", share(&refined), share(&merged));
        assert!(share(&refined) < 0.9 * share(&merged), "{} {}", share(&refined), share(&merged));
    }

    #[test]
    fn reordering_moves_every_block_with_its_row_and_column() {
        let system = scattered_grid(5, |_, _, _| 0.9);
        let order = locality_order(&system, 100);
        let new = system.reordered(&order);
        let entry = |s: &BlockSystem, row: u32, column: u32| {
            let range = s.offsets[row as usize] as usize..s.offsets[row as usize + 1] as usize;
            range.into_iter().find(|&k| s.columns[k] == column).map(|k| s.values.get(k * BLOCK))
        };
        for (i, &old_i) in order.iter().enumerate() {
            for (j, &old_j) in order.iter().enumerate() {
                assert_eq!(entry(&new, i as u32, j as u32), entry(&system, old_i, old_j));
            }
        }
    }
}
