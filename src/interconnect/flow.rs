//! Maximum flow in a small graph by shortest augmenting levels (Dinic's algorithm), in f64: capacities are bytes.

use std::collections::VecDeque;

/// A directed graph with residual capacities.
pub(super) struct FlowGraph {
    /// Arcs in pairs: arc i and its reverse i ^ 1.
    to: Vec<usize>,
    left: Vec<f64>,
    arcs: Vec<Vec<usize>>,
}

impl FlowGraph {
    pub(super) fn new(nodes: usize) -> FlowGraph {
        FlowGraph { to: Vec::new(), left: Vec::new(), arcs: vec![Vec::new(); nodes] }
    }

    /// Joins two nodes with a capacity for each direction.
    pub(super) fn link(&mut self, a: usize, b: usize, forward: f64, backward: f64) {
        self.arcs[a].push(self.to.len());
        self.to.push(b);
        self.left.push(forward);
        self.arcs[b].push(self.to.len());
        self.to.push(a);
        self.left.push(backward);
    }

    /// Pushes as much as possible from `source` to `sink`; capacities up to `least` count as none. Returns how much.
    pub(super) fn maximum_flow(&mut self, source: usize, sink: usize, least: f64) -> f64 {
        let mut total = 0.0;
        loop {
            let levels = self.levels(source, least);
            if levels[sink] == usize::MAX {
                return total;
            }
            let mut next = vec![0; self.arcs.len()];
            loop {
                let pushed = self.augment(source, sink, f64::INFINITY, &levels, &mut next, least);
                if pushed <= least {
                    break;
                }
                total += pushed;
            }
        }
    }

    /// Nodes that `source` still reaches.
    pub(super) fn source_side(&self, source: usize, least: f64) -> Vec<bool> {
        self.levels(source, least).iter().map(|level| *level != usize::MAX).collect()
    }

    fn levels(&self, source: usize, least: f64) -> Vec<usize> {
        let mut levels = vec![usize::MAX; self.arcs.len()];
        levels[source] = 0;
        let mut queue = VecDeque::from([source]);
        while let Some(node) = queue.pop_front() {
            for &arc in &self.arcs[node] {
                let next = self.to[arc];
                if self.left[arc] > least && levels[next] == usize::MAX {
                    levels[next] = levels[node] + 1;
                    queue.push_back(next);
                }
            }
        }
        levels
    }

    /// Pushes along one path of the level graph; recursion is as deep as the graph has nodes at most.
    fn augment(
        &mut self,
        node: usize,
        sink: usize,
        most: f64,
        levels: &[usize],
        next: &mut [usize],
        least: f64,
    ) -> f64 {
        if node == sink {
            return most;
        }
        while next[node] < self.arcs[node].len() {
            let arc = self.arcs[node][next[node]];
            let to = self.to[arc];
            if self.left[arc] > least && levels[to] == levels[node] + 1 {
                let pushed = self.augment(to, sink, most.min(self.left[arc]), levels, next, least);
                if pushed > least {
                    self.left[arc] -= pushed;
                    self.left[arc ^ 1] += pushed;
                    return pushed;
                }
            }
            next[node] += 1;
        }
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flow_is_that_of_the_narrowest_cut() {
        // 0 -> {1, 2} -> 3 with a bridge 1 -> 2; the cut {0, 1} | {2, 3} holds 2 + 1 + 2.
        let mut graph = FlowGraph::new(4);
        graph.link(0, 1, 4.0, 0.0);
        graph.link(0, 2, 2.0, 0.0);
        graph.link(1, 2, 1.0, 0.0);
        graph.link(1, 3, 2.0, 0.0);
        graph.link(2, 3, 9.0, 0.0);
        assert_eq!(graph.maximum_flow(0, 3, 1e-12), 5.0);
        assert_eq!(graph.source_side(0, 1e-12), [true, true, false, false]);
    }
}
