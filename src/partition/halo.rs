//! Halo plan: which rows of other ranks a rank reads, and how they travel.
//!
//! Local numbering of a rank = its own rows and its halo rows together in ascending global order
//! `[halo below | own rows | halo above]`, so sorting by local index is sorting by global index.
//! A rank publishes one message per exchange: its rows that any other rank reads, ascending. A reader picks what it
//! needs by position in that message.

use std::ops::Range;

use super::RowPartition;

/// What one rank reads from one other rank.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct HaloSource {
    /// Positions in the source's message, ascending.
    pub message_rows: Vec<u32>,
    /// Local index of the first of them; halo rows of one source are contiguous in the local numbering.
    pub local_start: u32,
}

/// Halo of one rank.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct HaloPlan {
    /// Own rank.
    pub rank: usize,
    /// Own rows in local numbering.
    pub own: Range<usize>,
    /// Own rows + halo rows.
    pub local_rows: usize,
    /// Global index of every local row, ascending.
    pub global_from_local: Vec<u32>,
    /// Own rows (index within the row block) that other ranks read, ascending: the message.
    pub publish_rows: Vec<u32>,
    /// Per source rank (empty for the own rank).
    pub sources: Vec<HaloSource>,
}

impl HaloPlan {
    /// Rows received per exchange.
    pub fn halo_rows(&self) -> usize {
        self.local_rows - self.own.len()
    }

    /// Local index of a global row, if this rank holds it.
    pub fn local_from_global(&self, global: u32) -> Option<u32> {
        self.global_from_local.binary_search(&global).ok().map(|i| i as u32)
    }
}

/// Builds the plans of all ranks. `halos[r]` = global rows that rank r reads and does not own, ascending, no duplicates.
pub fn halo_plans(partition: &RowPartition, halos: &[Vec<u32>]) -> Vec<HaloPlan> {
    assert_eq!(halos.len(), partition.ranks());
    let mut published: Vec<Vec<u32>> = vec![Vec::new(); partition.ranks()];
    for halo in halos {
        for &row in halo {
            published[partition.owner(row as usize)].push(row);
        }
    }
    for rows in &mut published {
        rows.sort_unstable();
        rows.dedup();
    }
    halos.iter().enumerate().map(|(rank, halo)| plan_of(partition, rank, halo, &published)).collect()
}

fn plan_of(partition: &RowPartition, rank: usize, halo: &[u32], published: &[Vec<u32>]) -> HaloPlan {
    let rows = partition.rows_of(rank);
    let below = halo.partition_point(|&g| (g as usize) < rows.start);
    let mut global_from_local = Vec::with_capacity(halo.len() + rows.len());
    global_from_local.extend_from_slice(&halo[..below]);
    global_from_local.extend(rows.clone().map(|g| g as u32));
    global_from_local.extend_from_slice(&halo[below..]);

    let mut sources = vec![HaloSource::default(); partition.ranks()];
    for (i, &global) in halo.iter().enumerate() {
        let owner = partition.owner(global as usize);
        let source = &mut sources[owner];
        if source.message_rows.is_empty() {
            source.local_start = if i < below { i } else { i + rows.len() } as u32;
        }
        let position = published[owner].binary_search(&global).expect("halo rows were collected into `published`");
        source.message_rows.push(position as u32);
    }
    HaloPlan {
        rank,
        own: below..below + rows.len(),
        local_rows: global_from_local.len(),
        global_from_local,
        publish_rows: published[rank].iter().map(|&g| g - rows.start as u32).collect(),
        sources,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_ranks_of_a_chain_read_their_neighbours() {
        // Rows 0..6, two per rank; a tridiagonal matrix reads one row on either side.
        let partition = RowPartition::new(6, 3);
        let plans = halo_plans(&partition, &[vec![2], vec![1, 4], vec![3]]);
        assert_eq!(plans[0].global_from_local, [0, 1, 2]);
        assert_eq!(plans[0].own, 0..2);
        assert_eq!(plans[1].global_from_local, [1, 2, 3, 4]);
        assert_eq!(plans[1].own, 1..3);
        assert_eq!(plans[1].publish_rows, [0, 1]);
        assert_eq!(plans[2].sources[1], HaloSource { message_rows: vec![1], local_start: 0 });
        assert_eq!(plans[1].sources[2], HaloSource { message_rows: vec![0], local_start: 3 });
        assert_eq!(plans[1].halo_rows(), 2);
        assert_eq!(plans[1].local_from_global(4), Some(3));
        assert_eq!(plans[1].local_from_global(5), None);
    }
}
