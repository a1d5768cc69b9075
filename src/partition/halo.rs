//! Halo plan: which rows of other ranks a rank reads, and how they travel.
//!
//! Local numbering of a rank = its own rows and its halo rows together in ascending global order
//! `[halo below | own rows | halo above]`, so sorting by local index is sorting by global index.
//! A rank has one message per exchange: its rows that any other rank reads, ascending. A reader picks what it needs by
//! position in that message; source and reader both know these positions, so that either side can pick.

use std::ops::Range;

use super::RowPartition;

/// The rows that one rank reads from one other rank.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct HaloSource {
    /// Positions in the source's message, ascending.
    pub message_rows: Vec<u32>,
    /// Local index of the first of them; halo rows of one source are contiguous in the local numbering.
    pub local_start: u32,
    /// The same for the rows that this step's contacts add.
    pub extra_rows: Vec<u32>,
    /// Local index of the first of those.
    pub extra_start: u32,
    /// Rows of the source's whole message.
    pub published_rows: u32,
}

impl HaloSource {
    /// Runs of rows that are contiguous in the local numbering: positions in the message, first local index.
    pub fn runs(&self) -> [(&[u32], u32); 2] {
        [(&self.message_rows, self.local_start), (&self.extra_rows, self.extra_start)]
    }

    /// Positions in the source's message of all rows that are read.
    pub fn positions(&self) -> Vec<u32> {
        [&self.message_rows[..], &self.extra_rows].concat()
    }

    /// Number of rows read from this source.
    pub fn rows(&self) -> usize {
        self.message_rows.len() + self.extra_rows.len()
    }
}

/// Halo of one rank.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct HaloPlan {
    /// The rank that the plan is for.
    pub rank: usize,
    /// Local indices of the own rows.
    pub own: Range<usize>,
    /// Number of own and halo rows together.
    pub local_rows: usize,
    /// Global index of every local row: ascending, then (ascending for themselves) the rows that contacts add.
    pub global_from_local: Vec<u32>,
    /// Own rows (index within the row block) that other ranks read: the message. Ascending, then those that contacts add.
    pub publish_rows: Vec<u32>,
    /// Per source rank (empty for the own rank).
    pub sources: Vec<HaloSource>,
    /// Per reader: positions in the own message of the rows that it reads (empty for the own rank).
    pub readers: Vec<Vec<u32>>,
    /// Global rows that each rank publishes whatever the contacts are, ascending.
    pub published: Vec<Vec<u32>>,
}

impl HaloPlan {
    /// Rows received per exchange.
    pub fn halo_rows(&self) -> usize {
        self.local_rows - self.own.len()
    }

    /// Local index of a global row, if this rank holds it.
    pub fn local_from_global(&self, global: u32) -> Option<u32> {
        let (fixed, extra) = self.global_from_local.split_at(self.local_rows - self.extra_halo_rows());
        let found = fixed.binary_search(&global).ok();
        found.or_else(|| extra.binary_search(&global).ok().map(|i| fixed.len() + i)).map(|i| i as u32)
    }

    /// Halo rows that contacts added.
    pub fn extra_halo_rows(&self) -> usize {
        self.sources.iter().map(|source| source.extra_rows.len()).sum()
    }

    /// This plan for a step whose contacts need more rows: `needs[r]` = global rows that rank r needs and does not hold,
    /// ascending. Every rank calls it with the same `needs`, so all agree on the messages: the rows that are always
    /// published, then the others that anybody needs, ascending. `self` has no extra rows.
    pub fn extended(&self, partition: &RowPartition, needs: &[Vec<u32>]) -> HaloPlan {
        let mut plan = self.clone();
        let mut extra: Vec<u32> = needs.concat();
        extra.sort_unstable();
        extra.dedup();
        extra.retain(|row| self.published[partition.owner(*row as usize)].binary_search(row).is_err());
        let of_rank = |rank: usize| {
            let rows = partition.rows_of(rank);
            let start = extra.partition_point(|&row| (row as usize) < rows.start);
            let end = extra.partition_point(|&row| (row as usize) < rows.end);
            &extra[start..end]
        };
        let own = partition.rows_of(self.rank);
        plan.publish_rows.extend(of_rank(self.rank).iter().map(|&row| row - own.start as u32));
        let position = |owner: usize, row: u32| {
            let fixed = &self.published[owner];
            let position = fixed.binary_search(&row).unwrap_or_else(|_| {
                fixed.len() + of_rank(owner).binary_search(&row).expect("needs are part of the extra rows")
            });
            position as u32
        };
        for (readers, needs) in plan.readers.iter_mut().zip(needs) {
            let owned = needs.iter().filter(|row| own.contains(&(**row as usize)));
            readers.extend(owned.map(|&row| position(self.rank, row)));
        }
        for (owner, source) in plan.sources.iter_mut().enumerate() {
            source.published_rows += of_rank(owner).len() as u32;
        }
        for &row in &needs[self.rank] {
            let owner = partition.owner(row as usize);
            let source = &mut plan.sources[owner];
            if source.extra_rows.is_empty() {
                source.extra_start = plan.local_rows as u32;
            }
            source.extra_rows.push(position(owner, row));
            plan.global_from_local.push(row);
            plan.local_rows += 1;
        }
        plan
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
    let mut plans: Vec<HaloPlan> =
        halos.iter().enumerate().map(|(rank, halo)| plan_of(partition, rank, halo, &published)).collect();
    for rank in 0..plans.len() {
        plans[rank].readers = plans.iter().map(|reader| reader.sources[rank].message_rows.clone()).collect();
    }
    plans
}

/// All but `readers`, for which the other plans are needed.

fn plan_of(partition: &RowPartition, rank: usize, halo: &[u32], published: &[Vec<u32>]) -> HaloPlan {
    let rows = partition.rows_of(rank);
    let below = halo.partition_point(|&g| (g as usize) < rows.start);
    let mut global_from_local = Vec::with_capacity(halo.len() + rows.len());
    global_from_local.extend_from_slice(&halo[..below]);
    global_from_local.extend(rows.clone().map(|g| g as u32));
    global_from_local.extend_from_slice(&halo[below..]);

    let source = |rows: &Vec<u32>| HaloSource { published_rows: rows.len() as u32, ..HaloSource::default() };
    let mut sources: Vec<HaloSource> = published.iter().map(source).collect();
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
        readers: Vec::new(),
        published: published.to_vec(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_ranks_of_a_chain_read_their_neighbors() {
        // Rows 0..6, two per rank; a tridiagonal matrix reads one row on either side.
        let partition = RowPartition::new(6, 3);
        let plans = halo_plans(&partition, &[vec![2], vec![1, 4], vec![3]]);
        assert_eq!(plans[0].global_from_local, [0, 1, 2]);
        assert_eq!(plans[0].own, 0..2);
        assert_eq!(plans[1].global_from_local, [1, 2, 3, 4]);
        assert_eq!(plans[1].own, 1..3);
        assert_eq!(plans[1].publish_rows, [0, 1]);
        let rest = HaloSource::default();
        assert_eq!(plans[2].sources[1], HaloSource { message_rows: vec![1], published_rows: 2, ..rest.clone() });
        assert_eq!(
            plans[1].sources[2],
            HaloSource { message_rows: vec![0], local_start: 3, published_rows: 1, ..rest }
        );
        assert_eq!(plans[1].readers, [vec![0], vec![], vec![1]]);
        agree(&plans);
        assert_eq!(plans[1].halo_rows(), 2);
        assert_eq!(plans[1].local_from_global(4), Some(3));
        assert_eq!(plans[1].local_from_global(5), None);
    }

    #[test]
    fn contacts_add_rows_behind_the_others() {
        // As above, but rank 0 also needs rows 3 (nobody reads it otherwise), 4 (published anyway) and 5, rank 2 row 0.
        let partition = RowPartition::new(6, 3);
        let plans = halo_plans(&partition, &[vec![2], vec![1, 4], vec![3]]);
        let needs = [vec![3, 4, 5], vec![], vec![0]];
        let plans: Vec<_> = plans.iter().map(|plan| plan.extended(&partition, &needs)).collect();
        assert_eq!(plans[0].global_from_local, [0, 1, 2, 3, 4, 5]);
        assert_eq!(plans[0].publish_rows, [1, 0], "row 1 always, row 0 for rank 2");
        assert_eq!(plans[0].sources[1].runs(), [(&[0u32][..], 2), (&[1u32][..], 3)], "row 3 is published anyway");
        assert_eq!(plans[0].sources[2].runs(), [(&[][..], 0), (&[0u32, 1][..], 4)]);
        assert_eq!(plans[2].publish_rows, [0, 1]);
        assert_eq!(plans[2].sources[0].runs(), [(&[][..], 0), (&[1u32][..], 3)]);
        assert_eq!((plans[0].local_from_global(4), plans[2].local_from_global(0)), (Some(4), Some(3)));
        assert_eq!((plans[0].extra_halo_rows(), plans[0].halo_rows()), (3, 4));
        assert_eq!(plans[1].sources[0].runs()[1].0.len(), 0);
        assert_eq!(plans[1].readers, [vec![0, 1], vec![], vec![1]], "rank 0 reads row 3 too");
        agree(&plans);
    }

    /// Source and reader know the same of every message.
    fn agree(plans: &[HaloPlan]) {
        for (rank, plan) in plans.iter().enumerate() {
            for (owner, source) in plan.sources.iter().enumerate() {
                assert_eq!(plans[owner].readers[rank], source.positions());
                assert_eq!(plans[owner].publish_rows.len(), source.published_rows as usize);
            }
        }
    }
}
