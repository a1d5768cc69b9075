//! Ownership of rows: chunks of rows, row blocks of ranks, and the halo that each rank reads from the others.
//!
//! The chunks depend on the number of rows only, never on the number of ranks: dot products are summed per chunk and
//! then over a fixed tree, so that they have the same bits for every rank count (`solver::reduction`).

mod halo;

pub use halo::{HaloPlan, HaloSource, halo_plans};

use std::ops::Range;

/// Least and most chunks of a large system: enough that 16 ranks get equal shares within a few per cent; few enough that the
/// coarse level of the preconditioner, which has a displacement per chunk, stays small beside the rest of an iteration.
const CHUNKS: (usize, usize) = (128, 1024);

/// Rows per chunk of a system of `rows` rows; the last chunk may be shorter. The chunks are about as many as a chunk has rows,
/// which balances the preconditioner's levels, and nearly a power of two, so that halving the order never cuts one.
pub fn chunk_rows(rows: usize) -> usize {
    let chunks = (rows.isqrt() * 3 / 4).next_power_of_two().clamp(CHUNKS.0, CHUNKS.1);
    rows.div_ceil(chunks).max(1)
}

/// Most ranks that can share `rows` rows: each owns at least a chunk.
pub fn most_ranks(rows: usize) -> usize {
    rows.div_ceil(chunk_rows(rows))
}

/// Rows of the global order, cut into chunks; every rank owns a contiguous range of chunks, hence of rows (its row
/// block [Li et al. 2020, Eq. 4]).
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct RowPartition {
    rows: usize,
    chunk_rows: usize,
    ranks: usize,
}

impl RowPartition {
    /// Splits `rows` rows over `ranks` ranks. Panics unless `1 <= ranks <= most_ranks(rows)` (callers check user input
    /// first).
    pub fn new(rows: usize, ranks: usize) -> RowPartition {
        assert!(ranks >= 1 && ranks <= most_ranks(rows), "{ranks} ranks cannot share {rows} rows");
        RowPartition { rows, chunk_rows: chunk_rows(rows), ranks }
    }

    /// Rows of the whole system.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Ranks that share the rows.
    pub fn ranks(&self) -> usize {
        self.ranks
    }

    /// Rows per chunk (the last chunk may be shorter).
    pub fn chunk_rows(&self) -> usize {
        self.chunk_rows
    }

    /// Chunks of the whole system; the last one may be short.
    pub fn chunks(&self) -> usize {
        self.rows.div_ceil(self.chunk_rows)
    }

    /// The contiguous range of chunks that rank `rank` owns.
    pub fn chunks_of(&self, rank: usize) -> Range<usize> {
        let chunks = self.chunks();
        (chunks * rank / self.ranks)..(chunks * (rank + 1) / self.ranks)
    }

    /// The contiguous range of rows that rank `rank` owns: its row block.
    pub fn rows_of(&self, rank: usize) -> Range<usize> {
        let chunks = self.chunks_of(rank);
        (chunks.start * self.chunk_rows)..(chunks.end * self.chunk_rows).min(self.rows)
    }

    /// Length of every sub-vector, rows: the longest row block; shorter ones are padded with zeros [Li et al. 2020, Sec. 3.1].
    pub fn sub_vector_rows(&self) -> usize {
        (0..self.ranks).map(|r| self.rows_of(r).len()).max().unwrap_or(0)
    }

    /// The rank whose row block holds `row`.
    pub fn owner(&self, row: usize) -> usize {
        let chunk = row / self.chunk_rows;
        // Inverse of the rounding in `chunks_of`, at most one off.
        let mut rank = (chunk * self.ranks / self.chunks()).min(self.ranks - 1);
        while self.chunks_of(rank).end <= chunk {
            rank += 1;
        }
        rank
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn row_blocks_cover_every_row_once_and_know_their_owner() {
        for rows in [1, 2, 7, 16, 121, 127, 128, 129, 1000, 5000, 99_856] {
            let most = most_ranks(rows);
            assert!(most == rows.min(128) || most > 64, "{rows} rows: {most}");
            for ranks in (1..=16).chain([64, most - 1, most]).filter(|n| (1..=most).contains(n)) {
                let p = RowPartition::new(rows, ranks);
                let mut next = 0;
                for rank in 0..ranks {
                    let range = p.rows_of(rank);
                    assert_eq!(range.start, next);
                    assert!(!range.is_empty(), "rank {rank} of {ranks} has no rows of {rows}");
                    assert!(range.len() <= p.sub_vector_rows());
                    assert_eq!(p.owner(range.start), rank);
                    assert_eq!(p.owner(range.end - 1), rank);
                    next = range.end;
                }
                assert_eq!(next, rows);
            }
        }
    }

    #[test]
    fn chunks_do_not_depend_on_the_rank_count_for_systems_larger_than_the_chunk_bound() {
        let reference = RowPartition::new(50_000, 1).chunk_rows();
        for ranks in 2..=16 {
            assert_eq!(RowPartition::new(50_000, ranks).chunk_rows(), reference);
        }
    }

    #[test]
    fn row_blocks_are_balanced() {
        for ranks in 1..=16 {
            let p = RowPartition::new(600_000, ranks);
            let mean = 600_000.0 / ranks as f64;
            assert!(p.sub_vector_rows() as f64 <= 1.05 * mean, "{ranks} ranks: longest {}", p.sub_vector_rows());
        }
    }
}
