//! Paths between GPUs, found once per topology. A path is fixed: transfers do not choose another one under load.

use super::parts::Graph;

/// One link of a path, and the direction in which it is used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Hop {
    /// Index of the link in `Topology::links`.
    pub link: usize,
    /// True from the link's first end to its second.
    pub forward: bool,
}

/// The path of every ordered pair of GPUs.
#[derive(Clone, Debug)]
pub(super) struct Routes {
    gpus: usize,
    paths: Vec<Vec<Hop>>,
}

impl Routes {
    /// Finds for every pair the widest path (largest bandwidth of its narrowest link), among those the one with fewest
    /// links, among those the first in file order. GPUs with a link between them never go through a third one. Err: two
    /// GPUs without a path.
    pub(super) fn find(graph: &Graph) -> Result<Routes, (usize, usize)> {
        let mut widths: Vec<f64> = graph.links.iter().map(|link| link.bandwidth_gb_s).collect();
        widths.sort_by(|a, b| b.total_cmp(a));
        widths.dedup();
        let mut neighbors = vec![Vec::new(); graph.nodes];
        for (index, link) in graph.links.iter().enumerate() {
            let [a, b] = link.ends;
            neighbors[a].push((b, Hop { link: index, forward: true }));
            neighbors[b].push((a, Hop { link: index, forward: false }));
        }
        let mut paths = vec![Vec::new(); graph.gpus * graph.gpus];
        for from in 0..graph.gpus {
            let mut missing = graph.gpus - 1;
            let around = widths.iter().map(|width| (*width, false));
            let through = widths.iter().map(|width| (*width, true)).filter(|_| graph.gpus_forward);
            for (width, through_gpus) in around.chain(through) {
                if missing == 0 {
                    break;
                }
                let arrival = breadth_first(graph, &neighbors, from, width, through_gpus);
                for to in 0..graph.gpus {
                    let path = &mut paths[from * graph.gpus + to];
                    let linked = || neighbors[from].iter().any(|(next, _)| *next == to);
                    let may_go = through_gpus || !graph.gpus_forward || linked();
                    if to != from && path.is_empty() && arrival[to].is_some() && may_go {
                        *path = trace_back(&arrival, from, to);
                        missing -= 1;
                    }
                }
            }
            if let Some(to) = (0..graph.gpus).find(|to| *to != from && paths[from * graph.gpus + to].is_empty()) {
                return Err((from, to));
            }
        }
        Ok(Routes { gpus: graph.gpus, paths })
    }

    /// The links from `from` to `to` in order.
    pub(super) fn path(&self, from: usize, to: usize) -> &[Hop] {
        assert!(from < self.gpus && to < self.gpus, "no path from GPU {from} to {to} of {}", self.gpus);
        &self.paths[from * self.gpus + to]
    }
}

/// For every node reached from `from` over links of at least `width`: the node before it and the link between.
fn breadth_first(
    graph: &Graph,
    neighbors: &[Vec<(usize, Hop)>],
    from: usize,
    width: f64,
    through_gpus: bool,
) -> Vec<Option<(usize, Hop)>> {
    let mut arrival = vec![None; graph.nodes];
    let mut queue = std::collections::VecDeque::from([from]);
    while let Some(node) = queue.pop_front() {
        // A GPU ends a path unless it passes transfers on.
        if node != from && node < graph.gpus && !through_gpus {
            continue;
        }
        for &(next, hop) in &neighbors[node] {
            let wide_enough = graph.links[hop.link].bandwidth_gb_s >= width;
            if wide_enough && next != from && arrival[next].is_none() {
                arrival[next] = Some((node, hop));
                queue.push_back(next);
            }
        }
    }
    arrival
}

fn trace_back(arrival: &[Option<(usize, Hop)>], from: usize, to: usize) -> Vec<Hop> {
    let mut path = Vec::new();
    let mut node = to;
    while node != from {
        let Some((before, hop)) = arrival[node] else { break };
        path.push(hop);
        node = before;
    }
    path.reverse();
    path
}
