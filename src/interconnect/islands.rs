//! Machines as islands of GPUs with slow links between: two sockets, several boxes. A ring over all GPUs would carry every
//! sub-vector over every slow link; here it carries foreign ones only.

use super::packing::Tree;
use super::topology::Topology;

/// Ways to see the machine as islands: the GPUs that remain connected without links slower than each bandwidth that
/// occurs. As island numbers of GPUs; only if there are several islands and one of them has several GPUs.
pub(super) fn all_islands(topology: &Topology) -> Vec<Vec<usize>> {
    let mut widths: Vec<f64> = topology.links().iter().map(|link| link.bandwidth_gb_s).collect();
    widths.sort_by(f64::total_cmp);
    widths.dedup();
    let mut found: Vec<Vec<usize>> = Vec::new();
    for width in widths.into_iter().skip(1) {
        let island = islands_of(topology, width);
        let mut numbers = island.clone();
        numbers.sort_unstable();
        numbers.dedup();
        if numbers.len() > 1 && numbers.len() < island.len() && !found.contains(&island) {
            found.push(island);
        }
    }
    found
}

/// The smallest node that every GPU reaches over links of at least `width`.
fn islands_of(topology: &Topology, width: f64) -> Vec<usize> {
    let mut island: Vec<usize> = (0..topology.nodes()).collect();
    let mut changed = true;
    while changed {
        changed = false;
        for link in topology.links().iter().filter(|link| link.bandwidth_gb_s >= width) {
            let [a, b] = link.ends;
            let least = island[a].min(island[b]);
            changed |= island[a] != island[b];
            (island[a], island[b]) = (least, least);
        }
    }
    island.truncate(topology.gpus());
    island
}

/// A ring in tree order over all GPUs, in which the first GPU of an island takes sub-vectors of its own island from the
/// island's last GPU and not from outside. The tree of chunk c of sub-vector v is number c n + v.
pub(super) fn island_rings(topology: &Topology, island: &[usize], chunks: usize) -> Vec<Tree> {
    let leaves = topology.leaf_order();
    // Leaves of an island stand together.
    let mut order = Vec::with_capacity(leaves.len());
    for &leaf in &leaves {
        if !order.contains(&leaf) {
            order.extend(leaves.iter().copied().filter(|other| island[*other] == island[leaf]));
        }
    }
    let gpus = order.len();
    let tree = |owner: usize| -> Tree {
        let start = order.iter().position(|gpu| *gpu == owner).unwrap_or(0);
        let ring: Vec<usize> = (0..gpus).map(|step| order[(start + step) % gpus]).collect();
        let last = ring.iter().position(|gpu| island[*gpu] != island[owner]).map_or(owner, |first| ring[first - 1]);
        let link = |pair: &[usize]| {
            let comes_back = island[pair[1]] == island[owner] && island[pair[0]] != island[owner];
            (if comes_back { last } else { pair[0] }, pair[1])
        };
        ring.windows(2).map(link).collect()
    };
    (0..chunks * gpus).map(|i| tree(i % gpus)).collect()
}
