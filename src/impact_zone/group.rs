//! Connected components by union of sets; the smallest member stands for its set.

/// Disjoint sets of numbers 0, 1, ..
#[derive(Clone, Debug, Default)]
pub(super) struct DisjointSets {
    parent: Vec<u32>,
}

impl DisjointSets {
    /// `count` sets of one number each.
    pub(super) fn new(count: usize) -> DisjointSets {
        DisjointSets { parent: (0..count as u32).collect() }
    }

    /// One more set; its only number.
    pub(super) fn push(&mut self) -> u32 {
        let made = self.parent.len() as u32;
        self.parent.push(made);
        made
    }

    /// The smallest number of the set of `i`.
    pub(super) fn root(&mut self, mut i: u32) -> u32 {
        while self.parent[i as usize] != i {
            let above = self.parent[self.parent[i as usize] as usize];
            self.parent[i as usize] = above;
            i = above;
        }
        i
    }

    /// Joins the sets of `a` and `b`.
    pub(super) fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b) as usize] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_member_stands_for_its_set() {
        let mut sets = DisjointSets::new(5);
        assert_eq!(sets.push(), 5);
        for (a, b) in [(5, 4), (1, 3), (4, 1), (0, 0)] {
            sets.join(a, b);
        }
        let roots: Vec<u32> = (0..6).map(|i| sets.root(i)).collect();
        assert_eq!(roots, [0, 1, 2, 1, 1, 1]);
    }
}
