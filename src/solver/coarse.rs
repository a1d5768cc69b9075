//! The coarse level of the Schwarz preconditioner: one displacement per group of chunks. Every rank factors P' A P in
//! f64 and applies the factor from a copy in f32.
//!
//! The restricted residual P' r follows its own recurrence from P' w. The all-reduce of the iteration carries P' w, so
//! the coarse level costs no message of its own. Groups are made of chunks, so nothing depends on ranks.

use std::ops::Range;

use crate::partition::RowPartition;
use crate::transport::{Transport, TransportError, gather_lists};

/// Limit of the products of a factorization, per row of the system. Contacts that join many distant groups can exceed
/// it; then pairs of groups are merged. The iterations of a solve need a few thousand products per row, but every rank
/// does the whole factorization.
const PRODUCTS_PER_ROW: u64 = 500;
/// Minimum rows of a group. Every rank solves the coarse level for itself: groups of 100 rows take a quarter of the
/// iteration's time where eight ranks share 25,000 rows, and save an eighth of the iterations.
const GROUP_ROWS: usize = 150;
/// Sums of blocks by the group of their column, for one chunk.
pub(super) type GroupSums = Vec<(u32, [f64; 9])>;
/// Floats of a sent entry: chunk and group packed into one, then the nine values of the block.
const ENTRY: usize = 10;
/// Independent partial sums of a sum of products.
const LANES: usize = 8;
/// A pivot smaller than this fraction of its diagonal value is rounding error.
const PIVOT_MIN: f64 = 1e-10;

/// Adds a block to the sum of its group.
pub(super) fn add_block(entries: &mut GroupSums, group: u32, block: [f32; 9]) {
    add_sums(entries, group, block.map(f64::from));
}

fn add_sums(entries: &mut GroupSums, group: u32, block: [f64; 9]) {
    match entries.iter_mut().find(|(other, _)| *other == group) {
        Some((_, sum)) => sum.iter_mut().zip(block).for_each(|(sum, v)| *sum += v),
        None => entries.push((group, block)),
    }
}

/// The sums of pairs of groups.
fn in_pairs(blocks: &[GroupSums]) -> Vec<GroupSums> {
    let mut pairs = vec![GroupSums::new(); blocks.len().div_ceil(2)];
    for (row, sums) in blocks.iter().enumerate() {
        sums.iter().for_each(|&(column, block)| add_sums(&mut pairs[row / 2], column / 2, block));
    }
    pairs
}

/// Coarse residual, its recurrence and the factor.
pub(super) struct Coarse {
    chunks: usize,
    own: Range<usize>,
    /// Chunks per group in the entries that ranks send.
    per_group: usize,
    /// Chunks per group in the coarse system: those of the entries times a power of two.
    per_unknown: usize,
    products_max: u64,
    factor: Option<Skyline>,
    residual: Vec<f64>,
    image: Vec<f64>,
    solution: Vec<f64>,
    /// Correction of the own chunks, three values per chunk.
    pub correction: Vec<f32>,
}

impl Coarse {
    pub(super) fn new(partition: &RowPartition, rank: usize) -> Coarse {
        let (chunks, own) = (partition.chunks(), partition.chunks_of(rank));
        let groups = (partition.rows() / GROUP_ROWS).max(1);
        // The row order bisects the mesh, so only groups of a power of two chunks are compact.
        let per_group = chunks.div_ceil(groups).next_power_of_two();
        let values = chunks.div_ceil(per_group) * 3;
        Coarse {
            chunks,
            per_group,
            per_unknown: per_group,
            products_max: partition.rows() as u64 * PRODUCTS_PER_ROW,
            factor: None,
            residual: vec![0.0; values],
            image: vec![0.0; values],
            solution: vec![0.0; values],
            correction: vec![0.0; own.len() * 3],
            own,
        }
    }

    /// Group of a chunk, as numbered in the entries.
    pub(super) fn group(&self, chunk: usize) -> usize {
        chunk / self.per_group
    }

    /// Factors P' A P. `entries`: the entries of every own chunk.
    pub(super) fn set_up(
        &mut self,
        transport: &mut dyn Transport,
        entries: &[GroupSums],
    ) -> Result<(), TransportError> {
        let mut own = Vec::new();
        for (chunk, entries) in self.own.clone().zip(entries) {
            for (group, block) in entries {
                own.push((chunk * self.chunks + *group as usize) as f64);
                own.extend_from_slice(block);
            }
        }
        let all = gather_lists(transport, &own)?;
        let mut blocks: Vec<GroupSums> = vec![Vec::new(); self.chunks.div_ceil(self.per_group)];
        for entry in all.as_chunks::<ENTRY>().0 {
            let (chunk, column) = (entry[0] as usize / self.chunks, entry[0] as usize % self.chunks);
            add_sums(&mut blocks[self.group(chunk)], column as u32, std::array::from_fn(|c| entry[1 + c]));
        }
        self.per_unknown = self.per_group;
        let mut envelope = Envelope::of(&blocks);
        while envelope.products() > self.products_max && blocks.len() > 1 {
            blocks = in_pairs(&blocks);
            self.per_unknown *= 2;
            envelope = Envelope::of(&blocks);
        }
        let values = blocks.len() * 3;
        for vector in [&mut self.residual, &mut self.image, &mut self.solution] {
            vector.resize(values, 0.0);
        }
        self.factor = Skyline::new(&blocks, envelope);
        Ok(())
    }

    /// Begins a solve. `chunk_sums`: sums of the residual over all chunks, three values each.
    pub(super) fn start(&mut self, chunk_sums: &[f64]) {
        self.image.fill(0.0);
        self.residual.fill(0.0);
        self.add_chunks(chunk_sums, |coarse, at, v| coarse.residual[at] += v);
        self.correct();
    }

    /// s = w + beta s, r -= alpha s, then the next correction. `chunk_sums`: sums of w over all chunks, three values
    /// each.
    pub(super) fn update(&mut self, chunk_sums: &[f64], alpha: f64, beta: f64) {
        self.image.iter_mut().for_each(|s| *s *= beta);
        self.add_chunks(chunk_sums, |coarse, at, v| coarse.image[at] += v);
        for (r, s) in self.residual.iter_mut().zip(&self.image) {
            *r -= alpha * s;
        }
        self.correct();
    }

    fn add_chunks(&mut self, chunk_sums: &[f64], add: impl Fn(&mut Coarse, usize, f64)) {
        for (chunk, sums) in chunk_sums.as_chunks::<3>().0.iter().enumerate() {
            for (c, &sum) in sums.iter().enumerate() {
                add(self, chunk / self.per_unknown * 3 + c, sum);
            }
        }
    }

    fn correct(&mut self) {
        let Some(factor) = &mut self.factor else {
            self.correction.fill(0.0);
            return;
        };
        factor.solve(&self.residual, &mut self.solution);
        for (chunk, correction) in self.own.clone().zip(self.correction.as_chunks_mut::<3>().0) {
            let at = chunk / self.per_unknown * 3;
            *correction = std::array::from_fn(|c| self.solution[at + c] as f32);
        }
    }
}

/// Envelope of a Cholesky factor: the columns from the first nonzero of each row to the diagonal, with the rows in
/// reverse Cuthill-McKee order [George and Liu 1981].
struct Envelope {
    /// Old row of each new row, in blocks.
    nodes: Vec<usize>,
    /// First column of each row of the factor, in scalars.
    first: Vec<usize>,
    /// Start of each row's values.
    start: Vec<usize>,
}

impl Envelope {
    fn of(blocks: &[GroupSums]) -> Envelope {
        let nodes = cuthill_mckee(blocks);
        let place = inverse(&nodes);
        let n = nodes.len() * 3;
        let (mut first, mut start) = (vec![0; n], vec![0; n + 1]);
        for (new, &old) in nodes.iter().enumerate() {
            let lowest = blocks[old].iter().map(|(c, _)| place[*c as usize]).fold(new, usize::min);
            for c in 0..3 {
                let row = new * 3 + c;
                // Pads the row to a multiple of LANES to the left of the diagonal where there is room.
                first[row] = row.checked_sub((row - lowest * 3).next_multiple_of(LANES)).unwrap_or(lowest * 3);
                start[row + 1] = start[row] + row + 1 - first[row];
            }
        }
        Envelope { nodes, first, start }
    }

    /// Upper bound of the products of a factorization.
    fn products(&self) -> u64 {
        self.start.windows(2).map(|row| ((row[1] - row[0]) as u64).pow(2) / 2).sum()
    }
}

fn inverse(order: &[usize]) -> Vec<usize> {
    let mut place = vec![0; order.len()];
    order.iter().enumerate().for_each(|(new, &old)| place[old] = new);
    place
}

/// Cholesky factor of a symmetric matrix of 3x3 blocks.
struct Skyline {
    /// Old row of each new row, in scalars.
    order: Vec<usize>,
    /// First column of each row of the factor.
    first: Vec<usize>,
    /// Start of each row's values. The last value of a row is the reciprocal of the diagonal.
    start: Vec<usize>,
    /// f32 halves the bytes read. Both triangular solves use the same rounded factor, so the preconditioner stays
    /// symmetric.
    values: Vec<f32>,
    work: Vec<f64>,
}

impl Skyline {
    /// None if the matrix is not positive definite.
    fn new(blocks: &[GroupSums], envelope: Envelope) -> Option<Skyline> {
        let Envelope { nodes, first, start } = envelope;
        let place = inverse(&nodes);
        let n = first.len();
        let mut values = vec![0.0; start[n]];
        for (new, &old) in nodes.iter().enumerate() {
            for (column, block) in &blocks[old] {
                for (i, &v) in block.iter().enumerate() {
                    let (row, column) = (new * 3 + i / 3, place[*column as usize] * 3 + i % 3);
                    if column <= row {
                        values[start[row] + column - first[row]] += v;
                    }
                }
            }
        }
        let order = nodes.iter().flat_map(|&old| [old * 3, old * 3 + 1, old * 3 + 2]).collect();
        let mut factor = Skyline { order, first, start, values: Vec::new(), work: vec![0.0; n] };
        if !factor.factor(&mut values) {
            return None;
        }
        factor.values = values.iter().map(|&v| v as f32).collect();
        Some(factor)
    }

    fn factor(&self, values: &mut [f64]) -> bool {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: this processor has AVX2.
            return unsafe { self.factor_avx2(values) };
        }
        self.factor_lanes(values)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn factor_avx2(&self, values: &mut [f64]) -> bool {
        self.factor_lanes(values)
    }

    #[inline(always)]
    fn factor_lanes(&self, values: &mut [f64]) -> bool {
        for row in 0..self.first.len() {
            let (done, rest) = values.split_at_mut(self.start[row]);
            let own = &mut rest[..row + 1 - self.first[row]];
            for column in self.first[row]..row {
                let from = self.first[row].max(self.first[column]);
                let other = &done[self.start[column] + from - self.first[column]..self.start[column + 1]];
                let (other, diagonal) = other.split_at(column - from);
                let sum = dot(&own[from - self.first[row]..column - self.first[row]], other);
                own[column - self.first[row]] = (own[column - self.first[row]] - sum) * diagonal[0];
            }
            let last = own.len() - 1;
            let whole = own[last];
            let pivot = whole - dot(&own[..last], &own[..last]);
            // All values of a group of pinned rows are zero; its correction stays zero.
            own[last] = match whole {
                0.0 => 1.0,
                _ if pivot > PIVOT_MIN * whole => 1.0 / pivot.sqrt(),
                _ => return false,
            };
        }
        true
    }

    fn solve(&mut self, b: &[f64], x: &mut [f64]) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: this processor has AVX2.
            return unsafe { self.solve_avx2(b, x) };
        }
        self.solve_lanes(b, x);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn solve_avx2(&mut self, b: &[f64], x: &mut [f64]) {
        self.solve_lanes(b, x);
    }

    #[inline(always)]
    fn solve_lanes(&mut self, b: &[f64], x: &mut [f64]) {
        let (first, start, values, work) = (&self.first, &self.start, &self.values, &mut self.work);
        let n = work.len();
        for row in 0..n {
            let (own, diagonal) = (&values[start[row]..start[row + 1] - 1], f64::from(values[start[row + 1] - 1]));
            work[row] = (b[self.order[row]] - dot(own, &work[first[row]..row])) * diagonal;
        }
        for row in (0..n).rev() {
            let value = work[row] * f64::from(values[start[row + 1] - 1]);
            work[row] = value;
            for (w, l) in work[first[row]..row].iter_mut().zip(&values[start[row]..start[row + 1] - 1]) {
                *w -= f64::from(*l) * value;
            }
        }
        self.order.iter().zip(work).for_each(|(&old, &mut v)| x[old] = v);
    }
}

/// Sum of products, accumulated in a fixed number of lanes.
#[inline(always)]
fn dot<T: Copy + Into<f64>>(a: &[T], b: &[f64]) -> f64 {
    let mut lanes = [0.0; LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for l in 0..LANES {
            lanes[l] += a[l].into() * b[l];
        }
    }
    a_rest.iter().zip(b_rest).zip(&mut lanes).for_each(|((&a, b), lane)| *lane += a.into() * b);
    let four: [f64; 4] = std::array::from_fn(|l| lanes[l] + lanes[l + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}

/// Reverse Cuthill-McKee order of the nodes: breadth first from a node of lowest degree, neighbors by ascending degree,
/// reversed.
fn cuthill_mckee(blocks: &[GroupSums]) -> Vec<usize> {
    let degree = |node: usize| (blocks[node].len(), node);
    let mut seen = vec![false; blocks.len()];
    let mut order = Vec::with_capacity(blocks.len());
    let mut roots: Vec<usize> = (0..blocks.len()).collect();
    roots.sort_unstable_by_key(|&node| degree(node));
    for root in roots {
        if std::mem::replace(&mut seen[root], true) {
            continue;
        }
        let mut next = order.len();
        order.push(root);
        while next < order.len() {
            let mut found: Vec<usize> = blocks[order[next]].iter().map(|(c, _)| *c as usize).collect();
            found.retain(|&node| !std::mem::replace(&mut seen[node], true));
            found.sort_unstable_by_key(|&node| degree(node));
            order.append(&mut found);
            next += 1;
        }
    }
    order.reverse();
    order
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::InProcessTransport;

    #[test]
    fn groups_that_contacts_join_all_over_are_solved_for_in_pairs() {
        let partition = RowPartition::new(1 << 16, 1);
        let groups = partition.chunks() as u32;
        let diagonal = |v: f64| std::array::from_fn(|c| if c % 4 == 0 { v } else { 0.0 });
        // Every row sums to 1, so equal residuals give equal displacements.
        let couple = |row: u32| move |column: u32| if row == column { f64::from(groups) } else { -1.0 };
        let joined =
            |row: u32| (0..groups).map(|column| (column, diagonal(couple(row)(column)))).collect::<GroupSums>();
        let alone = |row: u32| vec![(row, diagonal(1.0))];
        let solve = |entries: Vec<GroupSums>| {
            let mut coarse = Coarse::new(&partition, 0);
            coarse.set_up(&mut InProcessTransport::group(1).remove(0), &entries).expect("alone");
            coarse.start(&vec![3.0; groups as usize * 3]);
            (coarse.per_unknown, coarse.correction)
        };
        for (entries, per_unknown) in [((0..groups).map(alone).collect(), 1), ((0..groups).map(joined).collect(), 2)] {
            let (found, correction) = solve(entries);
            assert_eq!(found, per_unknown);
            assert!(correction.iter().all(|u| (u - 3.0).abs() < 1e-3), "{correction:?}");
        }
        let (_, correction) = solve((0..groups).map(|row| vec![(row, diagonal(-1.0))]).collect());
        assert!(correction.iter().all(|&u| u == 0.0), "an indefinite matrix corrects nothing");
    }
}
