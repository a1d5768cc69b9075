//! Lower bounds on the time of an exchange. Every GPU must receive what it lacks over its own links, and every cut of
//! the machine must carry what one side has and the other side needs. Maximum flows find the worst cut, so the bound is
//! the best of its kind. It allows for forwarding, chunking and splitting over links.

use super::flow::FlowGraph;
use super::network::Channels;
use super::packing::Demand;
use super::parts::Duplex;
use super::topology::Topology;

/// Lower bounds on the time until every GPU holds every sub-vector, seconds. All modeled from the topology file.
#[derive(Clone, Debug, PartialEq)]
pub struct LowerBound {
    /// Longest time that any one GPU needs to take in what it lacks over its own links.
    pub ingress_s: f64,
    /// The GPU of [`LowerBound::ingress_s`].
    pub ingress_gpu: usize,
    /// Longest time that any cut of the machine needs; never less than `ingress_s`.
    pub cut_s: f64,
    /// GPUs on the receiving side of the worst cut, ascending.
    pub cut_gpus: Vec<usize>,
    /// The shortest latency before the first byte can arrive.
    pub latency_s: f64,
}

impl LowerBound {
    /// The bound: the worst cut and one latency.
    pub fn total_s(&self) -> f64 {
        self.cut_s + self.latency_s
    }
}

/// Relative accuracy of maximum flows.
const CLOSE: f64 = 1e-9;

/// The bound for sub-vectors of `sub_vector_bytes` bytes that every GPU of `topology` must get from all others.
pub fn lower_bound(topology: &Topology, sub_vector_bytes: f64) -> LowerBound {
    let gpus = topology.gpus();
    if gpus == 1 || sub_vector_bytes <= 0.0 {
        return LowerBound { ingress_s: 0.0, ingress_gpu: 0, cut_s: 0.0, cut_gpus: vec![0], latency_s: 0.0 };
    }
    let mut bound = LowerBound { ingress_s: 0.0, ingress_gpu: 0, cut_s: 0.0, cut_gpus: vec![0], latency_s: 0.0 };
    for gpu in 0..gpus {
        let seconds = cut_time_s(topology, &single(topology, gpu), sub_vector_bytes);
        if seconds > bound.ingress_s {
            (bound.ingress_s, bound.ingress_gpu) = (seconds, gpu);
        }
    }
    (bound.cut_s, bound.cut_gpus) = (bound.ingress_s, vec![bound.ingress_gpu]);
    // A cut that needs longer than the bound so far shows up as a flow that is too small; its own time then is the next
    // bound. Ends, because every round finds a strictly worse cut and there are finitely many.
    let mut worse = true;
    while worse {
        worse = false;
        for gpu in 0..gpus {
            let inside = smallest_cut(topology, gpu, bound.cut_s, sub_vector_bytes);
            let seconds = cut_time_s(topology, &inside, sub_vector_bytes);
            if seconds > bound.cut_s * (1.0 + CLOSE) {
                bound.cut_s = seconds;
                bound.cut_gpus = (0..gpus).filter(|gpu| inside[*gpu]).collect();
                worse = true;
            }
        }
    }
    bound.latency_s = shortest_latency_s(topology);
    bound
}

/// A lower bound for any demands, seconds: what every GPU must take in, and what must cross every link whose loss would
/// cut the machine in two. No general cuts.
pub fn demand_bound_s(topology: &Topology, demands: &[Demand]) -> f64 {
    let sides = (0..topology.gpus()).map(|gpu| single(topology, gpu)).chain(bridges(topology));
    let time_s = |inside: Vec<bool>| {
        let (mut into, mut out, mut capacity) = (0.0, 0.0, 0.0);
        for demand in demands {
            let inwards = demand.readers.iter().any(|reader| inside[*reader]);
            let outwards = demand.readers.iter().any(|reader| !inside[*reader]);
            into += if inwards && !inside[demand.owner] { demand.bytes } else { 0.0 };
            out += if outwards && inside[demand.owner] { demand.bytes } else { 0.0 };
        }
        for link in topology.links().iter().filter(|link| inside[link.ends[0]] != inside[link.ends[1]]) {
            capacity += link.bandwidth_gb_s * 1e9;
        }
        into.max(out) / capacity
    };
    sides.map(time_s).filter(|seconds| seconds.is_finite()).fold(0.0, f64::max)
}

fn single(topology: &Topology, gpu: usize) -> Vec<bool> {
    let mut inside = vec![false; topology.nodes()];
    inside[gpu] = true;
    inside
}

/// One side of every link without which the machine falls apart.
fn bridges(topology: &Topology) -> impl Iterator<Item = Vec<bool>> {
    let side = |lost: usize| {
        let links = topology.links();
        let mut inside = vec![false; topology.nodes()];
        inside[links[lost].ends[0]] = true;
        let mut changed = true;
        while changed {
            changed = false;
            for (_, link) in links.iter().enumerate().filter(|(index, _)| *index != lost) {
                let [a, b] = link.ends;
                changed |= inside[a] != inside[b];
                (inside[a], inside[b]) = (inside[a] || inside[b], inside[a] || inside[b]);
            }
        }
        (!inside[links[lost].ends[1]]).then_some(inside)
    };
    (0..topology.links().len()).filter_map(side)
}

/// Time that the links between `inside` and the rest need for what must go in and what must go out.
fn cut_time_s(topology: &Topology, inside: &[bool], sub_vector_bytes: f64) -> f64 {
    let gpus = topology.gpus();
    let within = (0..gpus).filter(|gpu| inside[*gpu]).count();
    if within == 0 || within == gpus {
        return 0.0;
    }
    let (mut full, mut half) = (0.0, 0.0);
    for link in topology.links().iter().filter(|link| inside[link.ends[0]] != inside[link.ends[1]]) {
        match link.duplex {
            Duplex::Full => full += link.bandwidth_gb_s * 1e9,
            Duplex::Half => half += link.bandwidth_gb_s * 1e9,
        }
    }
    let (into, out) = ((gpus - within) as f64 * sub_vector_bytes, within as f64 * sub_vector_bytes);
    (into.max(out) / (full + half)).max((into + out) / (2.0 * full + half))
}

/// The receiving side of the narrowest cut between all owners and `gpu` if links carry what they can in `seconds`.
fn smallest_cut(topology: &Topology, gpu: usize, seconds: f64, sub_vector_bytes: f64) -> Vec<bool> {
    let (nodes, gpus) = (topology.nodes(), topology.gpus());
    let mut graph = FlowGraph::new(nodes + 1);
    for link in topology.links() {
        let bytes = link.bandwidth_gb_s * 1e9 * seconds;
        graph.link(link.ends[0], link.ends[1], bytes, bytes);
    }
    for owner in 0..gpus {
        graph.link(nodes, owner, sub_vector_bytes, 0.0);
    }
    graph.maximum_flow(nodes, gpu, gpus as f64 * sub_vector_bytes * CLOSE);
    let reached = graph.source_side(nodes, gpus as f64 * sub_vector_bytes * CLOSE);
    (0..nodes).map(|node| !reached[node]).collect()
}

/// The bytes that come last must come from somewhere: no GPU is complete before the latency of its nearest neighbor.
fn shortest_latency_s(topology: &Topology) -> f64 {
    let (channels, gpus) = (Channels::of(topology), topology.gpus());
    let nearest = |to: usize| {
        let others = (0..gpus).filter(|from| *from != to);
        others.map(|from| channels.latency_s(from, to)).fold(f64::INFINITY, f64::min)
    };
    (0..gpus).map(nearest).fold(f64::INFINITY, f64::min)
}
